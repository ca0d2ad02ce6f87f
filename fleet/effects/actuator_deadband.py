"""Backlash in a linkage: at each reversal the surface stays until the servo has crossed the gap."""

import numpy as np

from fleet.effects import SURFACES, Effect, Parameter, Stage
from fleet.physics.kernel import kernel


@kernel
def act(u: np.ndarray, memory: np.ndarray, dt: float, par: np.ndarray) -> None:
    """Apply backlash; memory[0] is the surface position."""
    for i in range(len(u)):
        half_width = max(par[0, i], 0.0)
        u[i] = min(max(memory[0], u[i] - half_width), u[i] + half_width)
        memory[0] = u[i]


EFFECT = Effect(
    name="actuator_deadband",
    stage=Stage.DELTA,
    channel="actuator",
    equation="delta = min(max(delta, delta_c - half_width), delta_c + half_width)",
    source="Nordin & Gutman 2002, Automatica 38, section 2 (backlash)",
    parameters=(Parameter("half_width", "-", "half the backlash", step=0.02, low=0.0, high=0.6),),
    act=act,
    targets=SURFACES,
    initial_guesses=((0.02,), (0.04,), (0.08,), (0.15,)),
    examples=((0.03,), (0.06,), (0.12,)),
    confusable_with={
        "actuator_lag": "a lag attenuates fast movements, backlash small ones",
        "actuator_rate_limit": "a rate limit attenuates large movements, backlash small ones",
        "control_effectiveness_loss": "the same fraction of small and large movements is lost",
    },
)
