"""Samples to `Window`: one time grid, lost samples filled by Lagrange interpolation, long gaps marked.

Source: Huang 2021, section 3.2 (time-stamp calibration, eq. 18; Lagrange interpolation, eq. 19).
"""

from math import ceil, floor

import numpy as np

from fleet.airframe import ServoMap
from fleet.frames import Origin, ned_to_body, to_ned
from fleet.window import Window
from twin_worker.history import History

DT = 0.04  # grid of every window [s]
LONGEST_GAP = {"attitude": 0.5, "velocity": 1.0, "servo": 0.5, "position": 1.0}  # wider gaps are never filled [s]
_SETTLED_S = 1.5  # rows older than the newest grid time by more come no longer [s]
_BEFORE_S = 4.0  # rows before a piece that its interpolation looks at [s]
_LEAST_ROWS = 4, 8  # of every kind, to go on and to begin
_FEWEST = 50  # grid times of a window
_SPLIT = (6, 9, 12)  # where velocity, position and pulses begin in what is laid
_WIDTH = 20


def lagrange(t: np.ndarray, y: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Interpolate by the cubic Lagrange polynomial through the four samples around each grid time.

    L(a) = sum_i b_i prod_(j != i) (a - a_j) / (a_i - a_j).  Source: Huang 2021 eq. 19.

    Args:
        t: sample times, rising, (m,) [s]
        y: samples, (m, k)
        grid: wanted times within the samples, (n,) [s]
    Returns:
        values on the grid, (n, k)
    """
    if len(t) < 4:
        return np.stack([np.interp(grid, t, column) for column in y.T], axis=1)
    left = np.clip(np.searchsorted(t, grid, side="right") - 2, 0, len(t) - 4)
    index = left[:, None] + np.arange(4)
    a = t[index]
    out = np.zeros((len(grid), y.shape[1]))
    for i in range(4):
        weight = np.ones(len(grid))
        for j in range(4):
            if j != i:
                weight *= (grid - a[:, j]) / (a[:, i] - a[:, j])
        out += weight[:, None] * y[index[:, i]]
    return out


def fill(t: np.ndarray, y: np.ndarray, grid: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lay samples on the grid: cubic where they are dense, linear across a short gap, not at all across a long one.

    Returns:
        values (n, k), measured or filled (n,) bool, filled across lost samples (n,) bool
    """
    n = len(grid)
    if len(t) < 4:
        return np.zeros((n, y.shape[1])), np.zeros(n, bool), np.zeros(n, bool)
    usual = float(np.median(np.diff(t)))
    right = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    gap = t[right] - t[right - 1]
    inside = (grid >= t[0] - usual) & (grid <= t[-1] + usual)
    ok = inside & (gap <= longest)
    lost = ok & (gap > 1.6 * usual)
    within = np.clip(grid, t[0], t[-1])
    smooth = lagrange(t, y, within)
    straight = np.stack([np.interp(within, t, column) for column in y.T], axis=1)
    # next to a gap the cubic's four points are far apart and noise would swing it
    span = t[np.clip(right + 1, 0, len(t) - 1)] - t[np.clip(right - 2, 0, len(t) - 1)]
    return np.where((span > 8 * usual)[:, None], straight, smooth), ok, lost


class Grid:
    """One aircraft's telemetry on one grid, multiples of `DT`; what is settled is laid once, the tail every time."""

    def __init__(self, keep_s: float = 160.0) -> None:
        self.keep_s = keep_s
        self._origin: Origin | None = None
        self._k = np.empty(0, np.int64)  # grid times in steps of DT
        self._laid = np.empty((0, _WIDTH))  # attitude, velocity, position, pulses
        self._ok = np.empty((0, 2), bool)  # measured or filled; filled

    def clear(self) -> None:
        """Forget everything, as after a jump of the clock."""
        self._k = self._k[:0]

    def window(
        self, history: History, origin: Origin, servos: ServoMap, wind: np.ndarray, *, until: float, seconds: float
    ) -> Window | None:
        """Lay what is new, and give the newest `seconds` before `until`.

        Args:
            history: telemetry as it came
            origin: where the twin's NED frame touches the earth
            servos: pulse widths to inputs
            wind: wind, NED, the direction it blows to, (3,) [m/s]
            until: newest grid time [s since 1970]
            seconds: wanted length [s]
        Returns:
            the window, or None while any needed kind of row is missing
        """
        if self._origin != origin:
            self.clear()
            self._origin = origin
        if not self._extend(history, until):
            return None
        first = np.searchsorted(self._k, ceil((until - seconds) / DT - 1e-3))
        last = np.searchsorted(self._k, floor(until / DT + 1e-3), side="right")
        rows = slice(first, last)
        if last - first < _FEWEST:
            return None
        attitude, v, p, pulses = np.split(self._laid[rows], _SPLIT, axis=1)
        ok, filled = self._ok[rows].T
        body = ned_to_body(attitude[:, 0], attitude[:, 1], attitude[:, 2], v - wind)
        x = np.hstack([body, attitude[:, 3:], attitude[:, :3]])
        return Window(self._k[rows] * DT, x, servos.inputs(pulses), p, v, ok, filled)

    def _extend(self, history: History, until: float) -> bool:
        """Lay the tail anew from where rows may still have come; tell whether every kind is there."""
        settled = self._k[-1] * DT - _SETTLED_S if len(self._k) else max(until - self.keep_s, 0.0)
        rows = {name: history.rows(name, settled - _BEFORE_S) for name in LONGEST_GAP}
        if any(len(t) < _LEAST_ROWS[not len(self._k)] for t, _ in rows.values()):
            return len(self._k) > 0
        start = settled if len(self._k) else max(settled, *(float(t[0]) for t, _ in rows.values()))
        stop = min(until, *(float(t[-1]) for t, _ in rows.values()))
        k = np.arange(ceil(start / DT), floor(stop / DT) + 1)
        if not len(k):
            return len(self._k) > 0
        assert self._origin is not None
        laid, ok, filled = _lay(rows, k * DT, self._origin)
        keep = slice(*np.searchsorted(self._k, [k[0] - int(self.keep_s / DT), k[0]]))
        if len(self._k) and len(laid):  # angles go on from the turn they were on
            laid[:, :3] += 2 * np.pi * np.round((self._before(keep) - laid[0, :3]) / (2 * np.pi))
        self._k = np.concatenate([self._k[keep], k])
        self._laid = np.concatenate([self._laid[keep], laid])
        self._ok = np.concatenate([self._ok[keep], np.column_stack([ok, filled])])
        return True

    def _before(self, keep: slice) -> np.ndarray:
        return self._laid[keep.stop - 1, :3] if keep.stop > keep.start else np.zeros(3)


def _lay(
    rows: dict[str, tuple[np.ndarray, np.ndarray]], grid: np.ndarray, origin: Origin
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lay every kind on grid times; give columns as in `Grid`, what is measured or filled, and what is filled."""
    t, attitude = rows["attitude"]
    unwrapped = np.hstack([np.unwrap(attitude[:, :3], axis=0), attitude[:, 3:]])
    t_p, place = rows["position"]
    laid = [
        fill(t, unwrapped, grid, LONGEST_GAP["attitude"]),
        fill(*rows["velocity"], grid, LONGEST_GAP["velocity"]),
        fill(t_p, to_ned(origin, *place.T), grid, LONGEST_GAP["position"]),
        _held(*rows["servo"], grid),
    ]
    values, ok, filled = zip(*laid, strict=True)
    return np.hstack(values), np.logical_and.reduce(ok), np.logical_or.reduce(filled)


def preprocess(
    history: History, origin: Origin, servos: ServoMap, wind: np.ndarray, *, until: float, seconds: float
) -> Window | None:
    """Lay the newest `seconds` before `until` on one grid; arguments as for `Grid.window`."""
    return Grid(seconds).window(history, origin, servos, wind, until=until, seconds=seconds)


def _held(t: np.ndarray, pulses: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lay servo pulses on the grid, straight between samples: a servo does not overshoot as a cubic would."""
    usual = float(np.median(np.diff(t)))
    right = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    gap = t[right] - t[right - 1]
    values = np.stack([np.interp(grid, t, column) for column in pulses.T], axis=1)
    return values, gap <= LONGEST_GAP["servo"], gap > 1.6 * usual
