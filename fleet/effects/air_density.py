"""Air thinner or denser than the standard day's: heat, low pressure, a field that lies high."""

from typing import Any

import numpy as np

from fleet.effects import Body, Effect, Flow, Onset, Parameter, Stage


def act(flow: Flow, share: Any) -> dict[str, Any]:
    """Change the density by a share."""
    return {"rho": share}


def told(effect: Effect, par: np.ndarray, body: Body) -> dict[str, float]:
    """Return the ratio to the standard day."""
    return {"density_ratio": 1.0 + float(par[0])}


EFFECT = Effect(
    name="air_density",
    stage=Stage.AIR,
    channel="air",
    equation="rho = (1 + share) rho_standard(h), rho = pressure / (R temperature)",
    source="ICAO Doc 7488 1993 (the standard atmosphere); Beard & McLain 2012, section 7.3",
    parameters=(Parameter("share", "-", "density added", step=0.02, low=-0.5, high=0.5),),
    act=act,
    told=told,
    onsets=(Onset.ALWAYS,),
    examples=((-0.05,), (0.08,), (-0.2,)),
    confused={
        "airspeed_scale": "a wrong sensor leaves moments and forces as they are",
        "thrust_loss": "thin air takes lift and moments along",
        "icing": "thin air takes moments along, and shows in indicated airspeed against that over ground",
    },
)
