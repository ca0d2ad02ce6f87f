"""Track of an aircraft from positions and velocities alone, which every vehicle sends; hover detection."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fleet.airframes.airframe import SERVO_COUNT
from fleet.frames import Origin, to_ned, wrap
from twin_worker.numerics.interpolation import interpolate_rows
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.telemetry.resample import interpolate_samples

STEP = 0.1  # grid of every track [s]
_MAX_GAP_S = 2.5  # longer gaps are not filled: 1 Hz with a lost row [s]
_SLOPE_S = 1.0  # half-width of the position slope that replaces velocity [s]
_STALE_S = 3.0  # attitude or velocity this much older than the newest position is considered lost [s]


@dataclass(frozen=True)
class Track:
    """Segment of one flight on an equal grid of `STEP`.

    Attributes:
        t: fleet time, (n,) [s since 1970]
        p: position, NED from the twin's origin, (n, 3) [m]
        v: velocity over ground, NED, (n, 3) [m/s]
        euler: phi theta psi, nan without attitude, (n, 3) [rad]
        ok: measured or interpolated across a short gap, (n,) bool
        sentence: missing telemetry, or empty
    """

    t: np.ndarray
    p: np.ndarray
    v: np.ndarray
    euler: np.ndarray
    ok: np.ndarray
    sentence: str

    def __len__(self) -> int:
        return len(self.t)

    def part(self, start: int, stop: int) -> "Track":
        """Return rows `start` to `stop`."""
        s = slice(start, stop)
        return Track(self.t[s], self.p[s], self.v[s], self.euler[s], self.ok[s], self.sentence)

    def unbroken_tail(self, since: float = -np.inf) -> "Track":
        """Return the gap-free tail from `since` on."""
        bad = np.flatnonzero(~self.ok)
        return self.part(max(int(bad[-1]) + 1 if len(bad) else 0, int(np.searchsorted(self.t, since))), len(self))

    def with_attitude(self, history: TelemetryHistory) -> "Track":
        """Return the track with attitude."""
        return replace(self, euler=_attitude(history, self.t))


def resample_track(
    history: TelemetryHistory, origin: Origin, *, until: float, seconds: float, with_attitude: bool = True
) -> Track | None:
    """Resample the newest `seconds` before `until` on one grid; differentiate positions if velocity is missing.

    Without `with_attitude` the attitude is nan: its interpolation takes longer than the rest.

    Returns:
        the track, or None with less than 1.5 s of positions
    """
    t_p, position = history.rows_since("position", until - seconds - 2.0)
    if len(t_p) < 3:
        return None
    t_v, velocity = history.rows_since("velocity", until - seconds - 2.0)
    velocity_sent = len(t_v) >= 4 and t_v[-1] > t_p[-1] - _STALE_S
    stop = min(until, float(t_p[-1]), float(t_v[-1]) if velocity_sent else np.inf)
    start = max(until - seconds, float(t_p[0]), float(t_v[0]) if velocity_sent else -np.inf)
    n = int((stop - start) / STEP) + 1
    if n < 1.5 / STEP:
        return None
    grid = stop - STEP * np.arange(n)[::-1]
    p, ok = _interpolate(t_p, to_ned(origin, *position.T), grid)
    if velocity_sent:
        v, velocity_ok = _interpolate(t_v, velocity, grid)
        ok &= velocity_ok
    else:
        v = _slope(grid, p)
    sentence = (
        "" if velocity_sent else "no velocity rows: velocity is differentiated from positions, with less precision"
    )
    result = Track(grid, p, v, np.full((n, 3), np.nan), ok, sentence)
    return result.with_attitude(history) if with_attitude else result


def _interpolate(t: np.ndarray, x: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate rows on the grid, linearly if there are fewer than four."""
    if len(t) < 4:
        return interpolate_rows(grid, t, x), np.ones(len(grid), bool)
    values, ok, _ = interpolate_samples(t, x, grid, _MAX_GAP_S)
    return values, ok


def _slope(t: np.ndarray, p: np.ndarray) -> np.ndarray:
    left, right = np.maximum(t - _SLOPE_S, t[0]), np.minimum(t + _SLOPE_S, t[-1])
    ends = [interpolate_rows(query_t, t, p) for query_t in (left, right)]
    return (ends[1] - ends[0]) / (right - left)[:, None]


def _attitude(history: TelemetryHistory, grid: np.ndarray) -> np.ndarray:
    """Return phi theta psi on the grid; nan where the nearest row is too far away."""
    t, x = history.rows_since("attitude", grid[0] - 2.0)
    if len(t) < 2 or t[-1] < grid[-1] - _STALE_S:
        return np.full((len(grid), 3), np.nan)
    euler = np.column_stack([np.interp(grid, t, np.unwrap(x[:, i])) for i in range(3)])
    euler[:, 2] = wrap(euler[:, 2])
    right = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    euler[(t[right] - t[right - 1] > _MAX_GAP_S) | (grid < t[0] - 1.0)] = np.nan
    return euler


SETTLING_S = 3.0  # settling time of the air flow after a transition [s]
_MOTOR_FUNCTIONS = (*range(33, 41), *range(82, 86))  # SERVOn_FUNCTION of motors 1 to 12
_SPIN_THRESHOLD = 0.08  # fraction of the pulse range above which a lift motor spins [-]


def lift_channels(params: Mapping[str, float]) -> list[tuple[int, float]]:
    """Return the servo outputs of the lift motors: (column, pulse above which the motor spins [us])."""
    channels = []
    for n in range(1, SERVO_COUNT + 1):
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
        sent = [pulses[:, column] > threshold for column, threshold in channels if column < pulses.shape[1]]
        spinning = np.any([np.zeros(len(t_s), bool), *sent], axis=0)
        hovering |= spinning[np.clip(np.searchsorted(t_s, t, side="right") - 1, 0, None)]
    return hovering
