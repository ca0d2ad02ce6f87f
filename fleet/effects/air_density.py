"""Air density different from the standard atmosphere: heat, low pressure, high airfield."""

from typing import Any

import numpy as np

from fleet.effects import Body, Effect, Flow, Onset, Parameter, Stage


def act(flow: Flow, share: Any) -> dict[str, Any]:
    """Return the relative increment of density."""
    return {"rho": share}


def reported(effect: Effect, par: np.ndarray, body: Body) -> dict[str, float]:
    """Return the density ratio to the standard atmosphere."""
    return {"density_ratio": 1.0 + float(par[0])}


EFFECT = Effect(
    name="air_density",
    stage=Stage.AIR,
    channel="air",
    equation="rho = (1 + share) rho_standard(h), rho = pressure / (R temperature)",
    source="ICAO Doc 7488 1993 (the standard atmosphere); Beard & McLain 2012, section 7.3",
    parameters=(Parameter("share", "-", "relative increment of density", step=0.02, low=-0.5, high=0.5),),
    act=act,
    reported=reported,
    onsets=(Onset.ALWAYS,),
    examples=((-0.05,), (0.08,), (-0.2,)),
    confusable_with={
        "airspeed_scale": "a sensor error leaves moments and forces unchanged",
        "thrust_loss": "low density reduces lift and moments too",
        "icing": "low density reduces moments too and changes indicated airspeed relative to ground speed",
    },
)
