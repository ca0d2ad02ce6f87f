"""Servos and engine: first-order lags between command and actuator state.

delta' = (delta_c - delta) / tau
"""

import numpy as np

from fleet.physics.kernel import kernel

TAU = np.array([0.05, 0.05, 0.05, 0.25])  # delta_a delta_e delta_r delta_t of a small aircraft [s]


@kernel
def lagged(commands: np.ndarray, dt: float, tau: np.ndarray) -> np.ndarray:
    """Return the mean actuator state in each interval, (n, 4), from the commands at its start, (n, 4).

    Args:
        commands: delta_a delta_e delta_r delta_t, constant over each interval [-]
        dt: sample time [s]
        tau: time constants, (4,) [s]
    """
    gain = 1.0 - np.exp(-dt / tau)
    out, state = np.empty_like(commands), commands[0].copy()
    for k in range(len(commands)):
        for i in range(4):
            step = gain[i] * (commands[k, i] - state[i])
            out[k, i] = state[i] + 0.5 * step
            state[i] += step
    return out
