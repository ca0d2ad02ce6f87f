"""Airspeed set-point of the autopilot, for legs whose route item does not define it.

After a mission jump the autopilot keeps the speed commanded last. Telemetry does not contain that speed, but
NAV_CONTROLLER_OUTPUT contains the airspeed error. Autopilots that do not send the error, such as PX4, still fly one
of the few speeds in the mission.
"""

import numpy as np

from fleet.mission import SEQ, VA_C
from twin_worker.telemetry.history import TelemetryHistory

_MEDIAN_S = 3.0  # window of the median [s]
_MIN_REPORTS = 3  # minimum reports in the window
STEADY_S = 20.0  # window in which the airspeed must be steady
_MAX_CHANGE, _MAX_OFFSET = 0.04, 0.06  # largest change and largest offset, relative to the airspeed [-]
MIN_DIFFERENCE = 0.5  # smaller differences are rounding and noise [m/s]


def reported_setpoint(history: TelemetryHistory, t: float, since: float = -np.inf) -> float:
    """Return the reported airspeed set-point just before `t`; nan if it is not reported after `since` [m/s].

    The reports follow a new set-point at limited acceleration; while they change, none is returned.
    """
    reports = _setpoint_reports(history, t, max(t - _MEDIAN_S, since))
    half = len(reports) // 2
    if not half or abs(_median(reports[half:]) - _median(reports[:half])) > MIN_DIFFERENCE:
        return float("nan")
    return _median(reports)


def reported_demand(history: TelemetryHistory, t: float) -> float:
    """Return the newest reported airspeed demand, which follows the set-point; nan if it is not reported [m/s]."""
    reports = _setpoint_reports(history, t, t - _MEDIAN_S)
    return _median(reports[-_MIN_REPORTS:]) if len(reports) else float("nan")


def _setpoint_reports(history: TelemetryHistory, t: float, since: float) -> np.ndarray:
    """Return the airspeed demands reported from `since` to `t`; empty if there are too few [m/s]."""
    t_c, command = history.rows_since("command", since)
    t_air, air = history.rows_since("air", t - _MEDIAN_S - 2.0)
    if len(t_c) < _MIN_REPORTS or len(t_air) < _MIN_REPORTS or air[:, 0].max() < 3.0:
        return np.empty(0)
    return (command[:, 4] + np.interp(t_c, t_air, air[:, 0]))[t_c <= t]


def inferred_setpoint(history: TelemetryHistory, t: float, speeds: np.ndarray) -> float:
    """Return the one of `speeds` [m/s] that was flown just before `t`; nan if the airspeed matches none of them."""
    t_air, air = history.rows_since("air", t - STEADY_S)
    Va = air[t_air <= t, 0]
    if len(Va) < 2 * _MIN_REPORTS or not len(speeds) or Va.min() < 3.0:
        return float("nan")
    half = len(Va) // 2
    median_speed = _median(Va)
    offsets = np.sort(np.abs(speeds - median_speed))
    steady = abs(_median(Va[:half]) - _median(Va[half:])) < _MAX_CHANGE * median_speed
    if not steady or offsets[0] > _MAX_OFFSET * median_speed or (len(offsets) > 1 and offsets[0] > 0.5 * offsets[1]):
        return float("nan")
    return float(speeds[np.argmin(np.abs(speeds - median_speed))])


def _median(x: np.ndarray) -> float:
    """Return the median; nan if any value is nan."""
    ordered = np.sort(x)
    n = len(ordered)
    return 0.5 * float(ordered[(n - 1) // 2] + ordered[n // 2]) if ordered[-1] == ordered[-1] else float("nan")


def apply_setpoint(legs: np.ndarray, seq: float, cruise: float, setpoint: float) -> np.ndarray:
    """Set the airspeed set-point on the current leg and on its neighbours of the same speed; return the legs.

    Args:
        legs: route, (n, 9)
        seq: current mission item
        cruise: speed of legs without a commanded speed [m/s]
        setpoint: airspeed set-point; nan changes nothing [m/s]
    """
    matches = np.flatnonzero(legs[:, SEQ] == seq)
    speeds = np.where(legs[:, VA_C] > 0, legs[:, VA_C], cruise)
    if not len(matches) or not abs(setpoint - speeds[matches[0]]) > MIN_DIFFERENCE:
        return legs
    other_legs = np.flatnonzero(speeds != speeds[matches[0]])
    earlier, later = other_legs[other_legs < matches[0]], other_legs[other_legs > matches[0]]
    changed = legs.copy()
    changed[earlier[-1] + 1 if len(earlier) else 0 : later[0] if len(later) else len(legs), VA_C] = setpoint
    return changed
