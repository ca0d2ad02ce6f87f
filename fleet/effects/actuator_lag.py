"""Slow servo: an additional first-order lag between command and surface."""

from math import exp

import numpy as np

from fleet.effects import ALL_SURFACES, SURFACES, Body, Effect, Parameter, Stage
from fleet.physics.kernel import kernel


@kernel
def act(u: np.ndarray, memory: np.ndarray, dt: float, par: np.ndarray) -> None:
    """Apply a first-order lag to linearly interpolated commands; memory: surface position, previous command."""
    for i in range(len(u)):
        tau, command = par[0, i], u[i]
        if tau > 0.0:
            decay = exp(-dt / tau)
            mean = (1.0 - decay) * tau / dt
            u[i] = decay * memory[0] + (1.0 - mean) * command + (mean - decay) * memory[1]
        memory[0], memory[1] = u[i], command


def reported(effect: Effect, par: np.ndarray, body: Body) -> dict[str, float]:
    """Return the total lag, including that of the healthy servo."""
    return {"tau_s": float(par[0]) + body.lag}


EFFECT = Effect(
    name="actuator_lag",
    stage=Stage.DELTA,
    channel="actuator",
    equation="delta' = (delta_c - delta) / tau",
    source="Stevens, Lewis & Johnson 2016, section 3.5 (first-order actuators)",
    parameters=(Parameter("tau_s", "s", "time constant added", step=0.02, low=0.0, high=2.0),),
    act=act,
    reported=reported,
    takes_lag=True,
    targets=(*SURFACES, ALL_SURFACES),
    initial_guesses=((0.06,), (0.12,), (0.2,), (0.3,), (0.45,), (0.7,)),
    examples=((0.15,), (0.25,), (0.5,)),
    confusable_with={
        "actuator_delay": "equal at low frequency: fly sharp inputs",
        "actuator_rate_limit": "affects large inputs",
    },
)
