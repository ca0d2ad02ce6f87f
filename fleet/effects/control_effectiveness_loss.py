"""Surface with reduced effectiveness: part torn off, soft rod, hinge gap."""

import numpy as np

from fleet.effects import SURFACES, Effect, Parameter, Stage
from fleet.physics.kernel import kernel


@kernel
def act(u: np.ndarray, memory: np.ndarray, dt: float, par: np.ndarray) -> None:
    """Reduce the commands by a fraction."""
    for i in range(len(u)):
        u[i] -= par[0, i] * u[i]


EFFECT = Effect(
    name="control_effectiveness_loss",
    stage=Stage.DELTA,
    channel="actuator",
    equation="delta = (1 - loss) delta_c",
    source="Ducard 2009, Fault-tolerant Flight Control and Guidance Systems (loss of effectiveness)",
    parameters=(Parameter("loss", "-", "fraction lost; below zero: more effective", step=0.1, low=-0.5, high=1.0),),
    act=act,
    targets=SURFACES,
    examples=((0.2,), (0.35,), (0.5,)),
    confusable_with={
        "actuator_stuck": "a stuck surface does not respond at all: fly inputs",
        "actuator_saturation": "lost travel affects large inputs only",
        "actuator_lag": "a lag attenuates fast movements only",
        "slipstream_tail": "the slipstream effect follows the throttle",
    },
)
