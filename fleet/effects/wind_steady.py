"""Uniform mean wind, or a change of it from an onset on."""

from typing import Any

import numpy as np

from fleet.effects import Body, Effect, Flow, Onset, Parameter, Stage


def act(flow: Flow, w_n: Any, w_e: Any) -> dict[str, Any]:
    """Add uniform wind."""
    return {"w_n": w_n, "w_e": w_e}


def reported(effect: Effect, par: np.ndarray, body: Body) -> dict[str, float]:
    """Return speed and the direction from which the wind blows."""
    w_n, w_e = map(float, par[:2])
    return {"speed_mps": float(np.hypot(w_n, w_e)), "from_deg": float(np.degrees(np.arctan2(-w_e, -w_n)) % 360.0)}


EFFECT = Effect(
    name="wind_steady",
    stage=Stage.AIR,
    channel="air",
    equation="v_a = v_g - w",
    source="Beard & McLain 2012, eq. 2.6 (the wind triangle)",
    parameters=(
        Parameter("w_n", "m/s", "wind to the north", step=0.5, low=-40.0, high=40.0),
        Parameter("w_e", "m/s", "wind to the east", step=0.5, low=-40.0, high=40.0),
    ),
    act=act,
    reported=reported,
    onsets=(Onset.ALWAYS, Onset.STEP, Onset.RAMP),
    examples=((2.0, -1.0), (-3.0, 4.0), (6.0, 6.0)),
    confusable_with={
        "airspeed_bias": "wind depends on heading: fly a full turn",
        "heading_bias": "a heading error turns with the aircraft: fly a full turn",
    },
)
