"""Servo with a delay: slow link, busy flight controller, bus with a queue."""

import numpy as np

from fleet.effects import ALL_SURFACES, SURFACES, Effect, Parameter, Stage
from fleet.physics.kernel import kernel


@kernel
def act(u: np.ndarray, memory: np.ndarray, dt: float, par: np.ndarray) -> None:
    """Delay the commands with linear interpolation; memory[k] is the command k samples ago."""
    last = len(memory) - 1
    for i in range(len(u)):
        for k in range(last, 0, -1):
            memory[k] = memory[k - 1]
        memory[0] = u[i]
        steps = min(max(par[0, i] / dt, 0.0), float(last))  # limited to the buffer length
        k = min(int(steps), last - 1)
        u[i] = memory[k] + (steps - k) * (memory[k + 1] - memory[k])


EFFECT = Effect(
    name="actuator_delay",
    stage=Stage.DELTA,
    channel="actuator",
    equation="delta(t) = delta_c(t - delay)",
    source="Stevens, Lewis & Johnson 2016, section 3.5; Klein & Morelli 2006, section 11.1 (time skew)",
    parameters=(Parameter("delay_s", "s", "delay added", step=0.02, low=0.0, high=1.0),),
    act=act,
    targets=(*SURFACES, ALL_SURFACES),
    initial_guesses=((0.06,), (0.12,), (0.2,), (0.3,), (0.45,)),
    examples=((0.08,), (0.15,), (0.3,)),
    confusable_with={
        "actuator_lag": "equal at low frequency: fly sharp inputs",
        "actuator_rate_limit": "a delay is the same for small and large inputs",
    },
)
