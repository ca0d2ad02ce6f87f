"""Surface with a constant offset: bent rod, spline one tooth off, lost trim."""

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
    targets=SURFACES,
    examples=((0.05,), (-0.1,), (0.18,)),
    confusable_with={
        "actuator_stuck": "a stuck surface does not respond: fly inputs",
        "cg_shift": "its moment does not grow with dynamic pressure: fly at two speeds",
        "cg_shift_side": "its moment does not grow with dynamic pressure: fly at two speeds",
        "thrust_asymmetry": "its moment follows the throttle",
        "prop_torque": "its moment follows the throttle",
    },
)
