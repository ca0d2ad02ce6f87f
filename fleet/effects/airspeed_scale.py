"""Airspeed sensor with a scale error: wrong ratio, leak, ice on the pitot tube."""

from math import exp
from typing import Any

import numpy as np

from fleet.effects import Body, Effect, Onset, Parameter, Stage


def act(readings: dict[str, Any], log_scale: Any) -> dict[str, Any]:
    """Scale the reading by exp(log_scale), so that the negated parameter is the inverse."""
    return {"Va": readings["Va"] * np.exp(log_scale)}


def reported(effect: Effect, par: np.ndarray, body: Body) -> dict[str, float]:
    """Return the scale."""
    return {"scale": exp(float(par[0]))}


EFFECT = Effect(
    name="airspeed_scale",
    stage=Stage.SENSOR,
    channel="airspeed",
    equation="Va_reported = scale Va",
    source="Beard & McLain 2012, section 7.3 (differential pressure)",
    parameters=(Parameter("log_scale", "-", "logarithm of the scale", step=0.02, low=-0.7, high=0.7),),
    act=act,
    reported=reported,
    onsets=(Onset.ALWAYS, Onset.STEP, Onset.RAMP),
    examples=((-0.05,), (0.1,), (-0.2,)),
    confusable_with={
        "airspeed_bias": "a scale error grows with speed: fly at two speeds",
        "air_density": "low density reduces moments and forces too, a sensor error does not",
    },
)
