"""Change of mass: dropped payload, burnt fuel, absorbed water."""

from typing import Any

import numpy as np

from fleet.effects import Body, Effect, Flow, Parameter, Stage


def act(flow: Flow, share: Any) -> dict[str, Any]:
    """Return the relative increment of mass."""
    return {"mass": share}


def reported(effect: Effect, par: np.ndarray, body: Body) -> dict[str, float]:
    """Return the added mass; a relative value without an airframe file."""
    return {"dmass_kg": float(par[0]) * body.mass}


EFFECT = Effect(
    name="mass_change",
    stage=Stage.MASS,
    channel="mass",
    equation="m = (1 + share) m_card",
    source="Beard & McLain 2012, eq. 3.16 (translational dynamics)",
    parameters=(Parameter("share", "-", "relative increment of mass", step=0.02, low=-0.6, high=1.0),),
    act=act,
    of_airframe=("dmass_kg",),
    reported=reported,
    examples=((0.05,), (-0.09,), (0.15,)),
    confusable_with={
        "cg_shift": "changes the pitching moment, not lift; a dropped payload often causes both",
        "icing": "ice adds drag too",
        "air_density": "low density reduces moments too",
        "accel_bias": "a bias does not follow the load factor: fly turns",
    },
)
