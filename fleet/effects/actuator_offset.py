"""A surface beside where it should be: a bent rod, a spline set one tooth wrong, a trim lost."""

import numpy as np

from fleet.effects import SURFACES, Effect, Parameter, Stage
from fleet.physics.kernel import kernel


@kernel
def act(u: np.ndarray, memory: np.ndarray, dt: float, par: np.ndarray) -> None:
    """Add the offset."""
    for i in range(len(u)):
        u[i] += par[0, i]


EFFECT = Effect(
    name="actuator_offset",
    stage=Stage.DELTA,
    channel="actuator",
    equation="delta = delta_c + offset",
    source="Klein & Morelli 2006, section 10.2 (control surface bias)",
    parameters=(Parameter("offset", "-", "travel added", step=0.03, low=-0.6, high=0.6),),
    act=act,
    of=SURFACES,
    examples=((0.05,), (-0.1,), (0.18,)),
    confused={
        "actuator_stuck": "a stuck surface no longer answers: fly inputs",
        "cg_shift": "an offset grows with dynamic pressure, weight does not: fly at two speeds",
        "cg_shift_side": "an offset grows with dynamic pressure, weight does not: fly at two speeds",
        "thrust_asymmetry": "a moment of thrust follows the throttle",
        "prop_torque": "a moment of the propeller follows the throttle",
    },
)
