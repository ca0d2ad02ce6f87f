"""Wind gradient: wind change proportional to the height difference from 100 m."""

from typing import Any

import numpy as np

from fleet.effects import Body, Effect, Flow, Onset, Parameter, Stage

REFERENCE_HEIGHT = 100.0  # height of zero change, so that a mean wind is not counted twice [m]


def act(flow: Flow, w_n: Any, w_e: Any) -> dict[str, Any]:
    """Add wind in proportion to height."""
    height_ratio = (flow.height - REFERENCE_HEIGHT) / 100.0
    return {"w_n": w_n * height_ratio, "w_e": w_e * height_ratio}


def reported(effect: Effect, par: np.ndarray, body: Body) -> dict[str, float]:
    """Return the change per 100 m and the direction from which the wind added above blows."""
    w_n, w_e = map(float, par[:2])
    return {"mps_per_100m": float(np.hypot(w_n, w_e)), "from_deg": float(np.degrees(np.arctan2(-w_e, -w_n)) % 360.0)}


EFFECT = Effect(
    name="wind_shear",
    stage=Stage.AIR,
    channel="air",
    equation="w = w_per_100m (height - 100 m) / 100 m",
    source="MIL-F-8785C 1980, section 3.7.3 (wind shear), to first order about 100 m",
    parameters=(
        Parameter("w_n", "m/s", "change of north wind per 100 m of height", step=0.5, low=-20.0, high=20.0),
        Parameter("w_e", "m/s", "change of east wind per 100 m of height", step=0.5, low=-20.0, high=20.0),
    ),
    act=act,
    reported=reported,
    onsets=(Onset.ALWAYS,),
    examples=((1.5, -1.0), (0.7, -4.0), (5.0, 4.0)),
    confusable_with={
        "wind_steady": "a mean wind is the same at every height: climb and descend",
    },
)
