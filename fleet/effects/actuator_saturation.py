"""Reduced travel at both ends: loose stop, binding horn, end points set too narrow."""

import numpy as np

from fleet.effects import SURFACES, Effect, Parameter, Stage
from fleet.physics.kernel import kernel


@kernel
def act(u: np.ndarray, memory: np.ndarray, dt: float, par: np.ndarray) -> None:
    """Clip the commands to the remaining travel."""
    for i in range(len(u)):
        if par[0, i] > 0.0:
            u[i] = min(max(u[i], par[0, i] - 1.0), 1.0 - par[0, i])


EFFECT = Effect(
    name="actuator_saturation",
    stage=Stage.DELTA,
    channel="actuator",
    equation="|delta| <= 1 - lost",
    source="Stevens, Lewis & Johnson 2016, section 3.5 (limits of actuators)",
    parameters=(Parameter("lost", "-", "travel lost at each end", step=0.1, low=0.0, high=0.99),),
    act=act,
    targets=SURFACES,
    initial_guesses=((0.5,), (0.6,), (0.7,), (0.8,), (0.88,), (0.94,)),
    examples=((0.6,), (0.75,), (0.85,)),
    confusable_with={
        "control_effectiveness_loss": "the same fraction of small and large movements is lost",
        "actuator_rate_limit": "a travel limit affects slow inputs too",
        "actuator_stuck": "a stuck surface does not follow small movements either",
    },
)
