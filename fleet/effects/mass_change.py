"""More or less mass: a payload dropped, fuel burnt, water taken in."""

from typing import Any

import numpy as np

from fleet.effects import Body, Effect, Flow, Parameter, Stage


def act(flow: Flow, share: Any) -> dict[str, Any]:
    """Change the mass by a share."""
    return {"mass": share}


def told(effect: Effect, par: np.ndarray, body: Body) -> dict[str, float]:
    """Return the mass added; a share where there is no card."""
    return {"dmass_kg": float(par[0]) * body.mass}


EFFECT = Effect(
    name="mass_change",
    stage=Stage.MASS,
    channel="mass",
    equation="m = (1 + share) m_card",
    source="Beard & McLain 2012, eq. 3.16 (translational dynamics)",
    parameters=(Parameter("share", "-", "mass added", step=0.02, low=-0.6, high=1.0),),
    act=act,
    told=told,
    examples=((0.05,), (-0.09,), (0.15,)),
    confused={
        "cg_shift": "pitches, and leaves lift as it is; what drops out often does both",
        "icing": "ice takes drag along",
        "air_density": "thin air takes moments along",
        "accel_bias": "a bias does not follow the load: fly turns",
    },
)
