"""Compass with a constant error: iron, electric current, wrong declination."""

from typing import Any

import numpy as np

from fleet.effects import Body, Effect, Onset, Parameter, Stage


def act(readings: dict[str, Any], bias: Any) -> dict[str, Any]:
    """Add the bias."""
    return {"psi": readings["psi"] + bias}


def reported(effect: Effect, par: np.ndarray, body: Body) -> dict[str, float]:
    """Return the bias in degrees."""
    return {"bias_deg": float(np.degrees(par[0]))}


EFFECT = Effect(
    name="heading_bias",
    stage=Stage.SENSOR,
    channel="heading",
    equation="psi_reported = psi + bias",
    source="Beard & McLain 2012, section 7.4 (digital compasses)",
    parameters=(Parameter("bias", "rad", "heading added", step=0.02, low=-1.0, high=1.0),),
    act=act,
    reported=reported,
    onsets=(Onset.ALWAYS, Onset.STEP, Onset.RAMP),
    examples=((0.05,), (-0.12,), (0.25,)),
    confusable_with={
        "wind_steady": "wind keeps its direction over ground, a heading error turns with the aircraft: fly a full turn",
        "actuator_offset": "real sideslip causes lateral acceleration, a heading error does not",
        "gyro_bias": "a rate, not a constant angle",
    },
)
