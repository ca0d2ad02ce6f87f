"""A surface that does less: part of it torn off, a soft rod, a hinge with a gap."""

import numpy as np

from fleet.effects import SURFACES, Effect, Parameter, Stage
from fleet.physics.kernel import kernel


@kernel
def act(u: np.ndarray, memory: np.ndarray, dt: float, par: np.ndarray) -> None:
    """Lessen the commands by a share."""
    for i in range(len(u)):
        u[i] -= par[0, i] * u[i]


EFFECT = Effect(
    name="control_effectiveness_loss",
    stage=Stage.DELTA,
    channel="actuator",
    equation="delta = (1 - loss) delta_c",
    source="Ducard 2009, Fault-tolerant Flight Control and Guidance Systems (loss of effectiveness)",
    parameters=(Parameter("loss", "-", "share lost; below zero: it does more", step=0.1, low=-0.5, high=1.0),),
    act=act,
    of=SURFACES,
    examples=((0.2,), (0.35,), (0.5,)),
    confused={
        "actuator_stuck": "a stuck surface does not answer at all: fly inputs",
        "actuator_saturation": "lost travel shows in large inputs alone",
        "actuator_lag": "a lag loses fast movements alone",
        "slipstream_tail": "what a slipstream does follows the throttle",
    },
)
