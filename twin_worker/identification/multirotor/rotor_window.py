"""`RotorWindow`: motor inputs, attitude, commanded attitude and velocity of one multirotor on one time grid."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fleet.window import LONGEST_GAP
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.telemetry.motors import motor_inputs, rotor_frame
from twin_worker.telemetry.resample import interpolate_samples

DT = 0.1  # grid [s]
MIN_INPUT = 0.08  # mean motor input of a flying multirotor [-]
MIN_HEIGHT_M = 2.0  # lower rows are on or near the ground
_AROUND_S = 0.5  # rows this close to a gap or to the ground are not used
_CONTEXT_S = 2.0  # rows before the window that the interpolation uses [s]
_MIN_ROWS = 8
_COMMAND_GAP_S = 1.0  # longest gap between commanded attitudes that is filled [s]


@dataclass(frozen=True)
class RotorWindow:
    """Section of one flight on an equal grid of `DT`.

    Attributes:
        t: fleet time, (n,) [s since 1970]
        velocity: over ground, NED, (n, 3) [m/s]
        attitude: phi theta psi, psi unwrapped, (n, 3) [rad]
        rates: of phi and theta, (n, 2) [rad/s]
        command: commanded phi and theta, nan where not reported, (n, 2) [rad]
        inputs: of the motors 0..1, mean over each grid interval, (n, m) [-]
        ok: measured in flight or interpolated across a short gap, (n,) bool
    """

    t: np.ndarray
    velocity: np.ndarray
    attitude: np.ndarray
    rates: np.ndarray
    command: np.ndarray
    inputs: np.ndarray
    ok: np.ndarray

    def __len__(self) -> int:
        return len(self.t)

    @property
    def seconds(self) -> float:
        """Return the flight time of the measured rows [s]."""
        return float(self.ok.sum() * DT)

    @property
    def states(self) -> np.ndarray:
        """Return velocity, phi and theta, (n, 5) [m/s, rad]."""
        return np.concatenate([self.velocity, self.attitude[:, :2]], axis=1)

    @property
    def duration(self) -> float:
        """Return the time from the first to the last row [s]."""
        return float(self.t[-1] - self.t[0])

    @property
    def has_command(self) -> bool:
        """Return whether the commanded attitude is known in most of the flight."""
        return bool(np.isfinite(self.command[self.ok]).all(axis=1).mean() > 0.9) if self.ok.any() else False

    def part(self, start: int, stop: int) -> "RotorWindow":
        """Return rows `start` to `stop` as a window."""
        s = slice(start, stop)
        parts = (self.t, self.velocity, self.attitude, self.rates, self.command, self.inputs, self.ok)
        return RotorWindow(*(x[s] for x in parts))

    def runs(self, length: int) -> np.ndarray:
        """Return the first rows of consecutive runs of `length` steps without a gap, (k,)."""
        needed = self.ok & np.isfinite(self.command).all(axis=1) if self.has_command else self.ok
        bad, starts, k = np.flatnonzero(~needed), [], 0
        while k + length < len(self):
            following = bad[np.searchsorted(bad, k) :]
            if len(following) and following[0] <= k + length:
                k = int(following[0]) + 1
            else:
                starts.append(k)
                k += length
        return np.array(starts, int)


def missing_telemetry(history: TelemetryHistory, params: Mapping[str, float]) -> str:
    """Describe what the rotor model needs and does not have; empty if nothing is missing."""
    if rotor_frame(params) is None:
        return "the frame in the parameters is none of a quadrotor or hexarotor"
    words = {"attitude": "attitude", "velocity": "velocity", "servo": "motor outputs"}
    absent = [word for kind, word in words.items() if len(history.rows_since(kind)[0]) < _MIN_ROWS]
    return f"no {', '.join(absent)} yet" if absent else ""


def rotor_window(
    history: TelemetryHistory, params: Mapping[str, float], *, seconds: float, ground_mm: float
) -> RotorWindow | None:
    """Resample the newest `seconds` of flight; None if a required kind of row is missing.

    Args:
        history: telemetry as received
        params: autopilot parameters: frame, range of the motor outputs
        seconds: length [s]
        ground_mm: height of home above mean sea level [mm]
    """
    if missing_telemetry(history, params):
        return None
    frame = rotor_frame(params)
    assert frame is not None
    since = history.newest - seconds - _CONTEXT_S
    rows = {kind: history.rows_since(kind, since) for kind in ("attitude", "velocity", "servo", "position")}
    if min(len(t) for t, _ in rows.values()) < _MIN_ROWS:
        return None
    stop = min(float(t[-1]) for t, _ in rows.values())
    start = max(stop - seconds, *(float(t[0]) for t, _ in rows.values()))
    grid = stop - DT * np.arange(int((stop - start) / DT) + 1)[::-1]
    if len(grid) < _MIN_ROWS:
        return None
    attitude_t, attitude = rows["attitude"]
    angles = np.column_stack([attitude[:, :2], np.unwrap(attitude[:, 2]), attitude[:, 3:6]])
    angles, ok, _ = interpolate_samples(attitude_t, angles, grid, LONGEST_GAP["attitude"])
    velocity, velocity_ok, _ = interpolate_samples(*rows["velocity"], grid, LONGEST_GAP["velocity"])
    servo_t, pulses = rows["servo"]
    inputs, inputs_ok = _interval_means(servo_t, motor_inputs(pulses[:, : frame.places.shape[1]], params), grid)
    position_t, position = rows["position"]
    height = np.interp(grid, position_t, position[:, 2]) - ground_mm
    ok &= velocity_ok & inputs_ok & (inputs.mean(axis=1) > MIN_INPUT) & (height > 1e3 * MIN_HEIGHT_M)
    phi, theta = angles[:, 0], angles[:, 1]
    turn = np.sin(phi) * angles[:, 4] + np.cos(phi) * angles[:, 5]
    rates = np.column_stack(
        [angles[:, 3] + np.tan(theta) * turn, np.cos(phi) * angles[:, 4] - np.sin(phi) * angles[:, 5]]
    )
    command = _command(*history.rows_since("command", since), grid)
    return RotorWindow(grid, velocity, np.ascontiguousarray(angles[:, :3]), rates, command, inputs, _eroded(ok))


def _interval_means(t: np.ndarray, x: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the means of (n, m) samples from half a step before each grid time to half a step after it.

    Motor outputs follow the attitude control: a sample alone says little of the thrust over the step.
    """
    _, ok, _ = interpolate_samples(t, x, grid, LONGEST_GAP["servo"])
    steps = np.diff(t)[:, None]
    integral = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(0.5 * steps * (x[1:] + x[:-1]), axis=0)])
    edges = np.clip(np.append(grid - 0.5 * DT, grid[-1] + 0.5 * DT), t[0], t[-1])
    at_edges = np.stack([np.interp(edges, t, column) for column in integral.T], axis=1)
    return np.diff(at_edges, axis=0) / np.maximum(np.diff(edges), 1e-3)[:, None], ok


def _command(t: np.ndarray, command: np.ndarray, grid: np.ndarray) -> np.ndarray:
    out = np.full((len(grid), 2), np.nan)
    if len(t) < _MIN_ROWS:
        return out
    values, ok, _ = interpolate_samples(t, command[:, :2], grid, _COMMAND_GAP_S)
    out[ok] = values[ok]
    return out


def _eroded(ok: np.ndarray) -> np.ndarray:
    """Return the rows that are also valid `_AROUND_S` before and after, as far as the window goes."""
    n = round(_AROUND_S / DT)
    bad = np.convolve(~ok, np.ones(2 * n + 1, int))[n : n + len(ok)]
    return np.asarray(bad == 0)
