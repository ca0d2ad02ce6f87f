"""Airspeed set-point of the autopilot, for legs whose route item does not define it.

After a mission jump the autopilot keeps the speed commanded last. Telemetry does not contain that speed, but
NAV_CONTROLLER_OUTPUT contains the airspeed error. Autopilots that do not send the error, such as PX4, still fly one
of the few speeds in the mission.
"""

import numpy as np

from fleet.mission import SEQ, VA_C
from twin_worker.telemetry.history import History

_OVER_S = 3.0  # window of the median [s]
_LEAST = 3  # minimum reports in the window
_STEADY_S = 20.0  # window in which the airspeed must be steady
_STEADY, _STRAYS = 0.04, 0.06  # largest change and largest offset, relative to the airspeed [-]
_APART = 0.5  # smaller differences are rounding and noise [m/s]


def aimed_at(history: History, t: float) -> float:
    """Return the reported airspeed set-point just before `t`; nan if it is not reported [m/s]."""
    t_c, command = history.look("command", t - _OVER_S)
    t_air, air = history.look("air", t - _OVER_S - 2.0)
    if len(t_c) < _LEAST or len(t_air) < _LEAST or air[:, 0].max() < 3.0:
        return float("nan")
    wanted = command[:, 4] + np.interp(t_c, t_air, air[:, 0])
    return _middle(wanted[t_c <= t]) if (t_c <= t).any() else float("nan")


def held_to(history: History, t: float, speeds: np.ndarray) -> float:
    """Return the one of `speeds` [m/s] that was flown just before `t`; nan if the airspeed matches none of them."""
    t_air, air = history.look("air", t - _STEADY_S)
    Va = air[t_air <= t, 0]
    if len(Va) < 2 * _LEAST or not len(speeds) or Va.min() < 3.0:
        return float("nan")
    half = len(Va) // 2
    usual = _middle(Va)
    off = np.sort(np.abs(speeds - usual))
    steady = abs(_middle(Va[:half]) - _middle(Va[half:])) < _STEADY * usual
    if not steady or off[0] > _STRAYS * usual or (len(off) > 1 and off[0] > 0.5 * off[1]):
        return float("nan")
    return float(speeds[np.argmin(np.abs(speeds - usual))])


def _middle(x: np.ndarray) -> float:
    """Return the median; nan if any value is nan."""
    ranked = np.sort(x)
    n = len(ranked)
    return 0.5 * float(ranked[(n - 1) // 2] + ranked[n // 2]) if ranked[-1] == ranked[-1] else float("nan")


def as_told(legs: np.ndarray, seq: float, cruise: float, told: float) -> np.ndarray:
    """Set the airspeed set-point on the current leg and on its neighbours of the same speed; return the legs.

    Args:
        legs: route, (n, 9)
        seq: current mission item
        cruise: speed of legs without a commanded speed [m/s]
        setpoint: airspeed set-point; nan changes nothing [m/s]
    """
    found = np.flatnonzero(legs[:, SEQ] == seq)
    speeds = np.where(legs[:, VA_C] > 0, legs[:, VA_C], cruise)
    if not len(found) or not abs(told - speeds[found[0]]) > _APART:
        return legs
    other = np.flatnonzero(speeds != speeds[found[0]])
    before, after = other[other < found[0]], other[other > found[0]]
    changed = legs.copy()
    changed[before[-1] + 1 if len(before) else 0 : after[0] if len(after) else len(legs), VA_C] = told
    return changed
