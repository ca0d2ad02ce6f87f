"""A surface that no longer follows: jammed, its rod lost, its servo without power."""

import numpy as np

from fleet.effects import SURFACES, Effect, Parameter, Stage
from fleet.physics.kernel import kernel


@kernel
def act(u: np.ndarray, memory: np.ndarray, dt: float, par: np.ndarray) -> None:
    """Pull the commands to the position, wholly when share is 1."""
    for i in range(len(u)):
        u[i] += par[0, i] * (par[1, i] - u[i])


EFFECT = Effect(
    name="actuator_stuck",
    stage=Stage.DELTA,
    channel="actuator",
    equation="delta = delta_c + share (position - delta_c), share 1 when stuck",
    source="Ducard 2009, Fault-tolerant Flight Control and Guidance Systems (actuator faults: lock in place)",
    parameters=(
        Parameter("share", "-", "how far it is stuck: 0 free, 1 wholly", step=0.2, low=0.0, high=1.0, least=0.5),
        Parameter("position", "-", "where it is stuck", step=0.05, low=-1.0, high=1.0),
    ),
    act=act,
    of=SURFACES,
    starts=tuple((1.0, position / 25.0) for position in range(-8, 9, 2)),
    examples=((1.0, 0.0), (1.0, 0.04), (1.0, -0.08)),
    confused={
        "actuator_offset": "a shifted surface still answers: fly inputs",
        "control_effectiveness_loss": "a weak surface still answers in part: fly inputs",
    },
)
