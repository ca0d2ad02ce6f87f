"""Surface that does not follow its command: jammed, rod lost, servo without power."""

import numpy as np

from fleet.effects import SURFACES, Effect, Parameter, Stage
from fleet.physics.kernel import kernel


@kernel
def act(u: np.ndarray, memory: np.ndarray, dt: float, par: np.ndarray) -> None:
    """Interpolate from the command to the stuck position; share 1 is fully stuck."""
    for i in range(len(u)):
        u[i] += par[0, i] * (par[1, i] - u[i])


EFFECT = Effect(
    name="actuator_stuck",
    stage=Stage.DELTA,
    channel="actuator",
    equation="delta = delta_c + share (position - delta_c), share 1 when stuck",
    source="Ducard 2009, Fault-tolerant Flight Control and Guidance Systems (actuator faults: lock in place)",
    parameters=(
        Parameter("share", "-", "degree of jamming: 0 free, 1 stuck", step=0.2, low=0.0, high=1.0, least=0.5),
        Parameter("position", "-", "stuck position", step=0.05, low=-1.0, high=1.0),
    ),
    act=act,
    targets=SURFACES,
    initial_guesses=tuple((1.0, position / 25.0) for position in range(-8, 9, 2)),
    examples=((1.0, 0.0), (1.0, 0.04), (1.0, -0.08)),
    confusable_with={
        "actuator_offset": "a surface with an offset responds: fly inputs",
        "control_effectiveness_loss": "a surface with reduced effectiveness responds in part: fly inputs",
    },
)
