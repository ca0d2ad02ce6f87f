"""Play in a linkage: the surface waits until the servo has crossed it, at every turn."""

import numpy as np

from fleet.effects import SURFACES, Effect, Parameter, Stage
from fleet.physics.kernel import kernel


@kernel
def act(u: np.ndarray, memory: np.ndarray, dt: float, par: np.ndarray) -> None:
    """Let the surface be dragged along by the play's two ends; memory[0] is the surface."""
    for i in range(len(u)):
        half = max(par[0, i], 0.0)
        u[i] = min(max(memory[0], u[i] - half), u[i] + half)
        memory[0] = u[i]


EFFECT = Effect(
    name="actuator_deadband",
    stage=Stage.DELTA,
    channel="actuator",
    equation="delta = min(max(delta, delta_c - half_width), delta_c + half_width)",
    source="Nordin & Gutman 2002, Automatica 38, section 2 (backlash)",
    parameters=(Parameter("half_width", "-", "half the play", step=0.02, low=0.0, high=0.6),),
    act=act,
    of=SURFACES,
    starts=((0.02,), (0.04,), (0.08,), (0.15,)),
    examples=((0.03,), (0.06,), (0.12,)),
    confused={
        "actuator_lag": "a lag loses fast movements, play small ones",
        "actuator_rate_limit": "a limit loses large movements, play small ones",
        "control_effectiveness_loss": "a share is lost of small and large movements alike",
    },
)
