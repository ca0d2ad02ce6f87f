"""Servo with a low maximum rate: low voltage, heavy load, worn gear."""

import numpy as np

from fleet.effects import SURFACES, Body, Effect, Parameter, Stage
from fleet.physics.kernel import kernel


@kernel
def act(u: np.ndarray, memory: np.ndarray, dt: float, par: np.ndarray) -> None:
    """Limit the change per sample; memory[0] is the surface position."""
    for i in range(len(u)):
        travel_time = par[0, i]
        if travel_time > 0.0:
            u[i] = min(max(u[i], memory[0] - dt / travel_time), memory[0] + dt / travel_time)
        memory[0] = u[i]


def reported(effect: Effect, par: np.ndarray, body: Body) -> dict[str, float]:
    """Return the maximum rate."""
    return {"rate_per_s": 1.0 / float(par[0]) if par[0] > 0.0 else float("inf")}


EFFECT = Effect(
    name="actuator_rate_limit",
    stage=Stage.DELTA,
    channel="actuator",
    equation="|delta'| <= 1 / slow",
    source="Stevens, Lewis & Johnson 2016, section 3.5 (rate limits of actuators)",
    parameters=(Parameter("slow_s", "s", "time for one unit of travel", step=0.5, low=0.0, high=50.0),),
    act=act,
    reported=reported,
    targets=SURFACES,
    initial_guesses=((1.0,), (1.7,), (2.9,), (5.0,), (10.0,), (20.0,)),
    examples=((1.5,), (3.0,), (6.0,)),
    confusable_with={
        "actuator_lag": "a lag slows small inputs as much as large ones",
        "actuator_delay": "a delay is the same for small and large inputs",
        "actuator_deadband": "backlash attenuates small movements, a rate limit large ones",
    },
)
