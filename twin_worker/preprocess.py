"""Samples to `Window`: one time grid, lost samples filled by Lagrange interpolation, long gaps marked.

Source: Huang 2021, section 3.2 (time-stamp calibration, eq. 18; Lagrange interpolation, eq. 19).
"""

import numpy as np

from fleet.airframe import ServoMap
from fleet.frames import Origin, ned_to_body, to_ned
from fleet.window import Window
from twin_worker.history import History

DT = 0.04  # grid of every window [s]
LONGEST_GAP = {"attitude": 0.5, "velocity": 1.0, "servo": 0.5, "position": 1.0}  # wider gaps are never filled [s]


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


def preprocess(
    history: History, origin: Origin, servos: ServoMap, wind: np.ndarray, *, until: float, seconds: float
) -> Window | None:
    """Lay the newest `seconds` before `until` on one grid.

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
    rows = {name: history.rows(name, until - seconds - 2.0) for name in LONGEST_GAP}
    if any(len(t) < 8 for t, _ in rows.values()):
        return None
    start = max(until - seconds, *(float(t[0]) for t, _ in rows.values()))
    stop = min(until, *(float(t[-1]) for t, _ in rows.values()))
    n = int((stop - start) / DT)
    if n < 50:
        return None
    grid = stop - DT * np.arange(n)[::-1]
    t_att, att = rows["attitude"]
    angles = np.hstack([np.unwrap(att[:, :3], axis=0), att[:, 3:]])
    laid = {"attitude": fill(t_att, angles, grid, LONGEST_GAP["attitude"])}
    laid["velocity"] = fill(*rows["velocity"], grid, LONGEST_GAP["velocity"])
    t_pos, pos = rows["position"]
    laid["position"] = fill(t_pos, to_ned(origin, *pos.T), grid, LONGEST_GAP["position"])
    u, u_ok, u_filled = _held(*rows["servo"], grid)
    euler, rates, ground = laid["attitude"][0][:, :3], laid["attitude"][0][:, 3:], laid["velocity"][0]
    body = ned_to_body(euler[:, 0], euler[:, 1], euler[:, 2], ground - wind)
    ok = u_ok & np.logical_and.reduce([values[1] for values in laid.values()])
    filled = u_filled | np.logical_or.reduce([values[2] for values in laid.values()])
    x = np.hstack([body, rates, euler])
    return Window(grid, x, servos.inputs(u), laid["position"][0], ground, ok, filled)


def _held(t: np.ndarray, pulses: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lay servo pulses on the grid, straight between samples: a servo does not overshoot as a cubic would."""
    usual = float(np.median(np.diff(t)))
    right = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    gap = t[right] - t[right - 1]
    values = np.stack([np.interp(grid, t, column) for column in pulses.T], axis=1)
    return values, gap <= LONGEST_GAP["servo"], gap > 1.6 * usual
