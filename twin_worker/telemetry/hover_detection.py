"""Hover detection of a quadplane: lift motors spin, or the flight mode is a hover mode."""

from collections.abc import Mapping, Sequence

import numpy as np

from twin_worker.telemetry.history import TelemetryHistory

SETTLING_S = 3.0  # settling time of the air flow after a transition [s]
_MOTOR_FUNCTIONS = (*range(33, 41), *range(82, 86))  # SERVOn_FUNCTION of motors 1 to 12
_SPIN_THRESHOLD = 0.08  # fraction of the pulse range above which a lift motor spins [-]
_N_SERVOS = 8


def lift_channels(params: Mapping[str, float]) -> list[tuple[int, float]]:
    """Return the servo outputs of the lift motors: (column, pulse above which the motor spins [us])."""
    channels = []
    for n in range(1, _N_SERVOS + 1):
        if params.get(f"SERVO{n}_FUNCTION") in _MOTOR_FUNCTIONS:
            low, high = params.get("Q_M_PWM_MIN", 0.0), params.get("Q_M_PWM_MAX", 0.0)
            low, high = (low, high) if 500 < low < high else (1000.0, 2000.0)
            channels.append((n - 1, low + _SPIN_THRESHOLD * (high - low)))
    return channels


def hovering_mask(
    t: np.ndarray, history: TelemetryHistory, params: Mapping[str, float], modes: Sequence[tuple[float, str]]
) -> np.ndarray:
    """Return the mask of hovering flight, (n,) bool.

    Args:
        t: requested times, rising, (n,) [s since 1970]
        history: telemetry as received
        params: autopilot parameters, which define the outputs of the lift motors
        modes: mode changes, (time, name), in order
    """
    hovering = np.zeros(len(t), bool)
    ends = [since for since, _ in list(modes)[1:]] + [np.inf]
    for (since, mode), until in zip(modes, ends, strict=False):
        if mode.startswith("Q"):
            hovering |= (t >= since) & (t < until)
    channels = lift_channels(params)
    t_s, pulses = history.rows_since("servo", t[0] - 5.0)
    if channels and len(t_s):
        spinning = np.any([pulses[:, column] > threshold for column, threshold in channels], axis=0)
        hovering |= spinning[np.clip(np.searchsorted(t_s, t, side="right") - 1, 0, None)]
    return hovering
