"""Transform telemetry to another start, heading and wind with the same air-relative flight.

Everything a twin identifies in flight is relative to the air, so another start is a rigid motion of the flight so far:
v' = R (v - w) + w';  p' = start + R (p - p_end - w s) + w' s  with s = t - t_end.  Telemetry without a position
(servos, commands, airspeed, rates) is unchanged.
"""

from dataclasses import dataclass

import numpy as np

from fleet.frames import Origin, to_geodetic, to_ned, wrap
from twin_worker.telemetry.history import History


@dataclass(frozen=True)
class Motion:
    """Rigid motion of the flight so far.

    Attributes:
        start: new end position of the flight so far; None: unchanged
        heading: new heading of the nose [rad]; None: unchanged
        wind, new_wind: actual and hypothetical wind, NED, (3,) [m/s]
    """

    to: Origin | None
    heading: float | None
    wind: np.ndarray
    wind_then: np.ndarray


def moved(history: History, origin: Origin, how: Motion) -> None:
    """Move the telemetry history, in place."""
    t_p, place = history.rows("position")
    t_v, v = history.rows("velocity")
    t_a, attitude = history.rows("attitude")
    if not len(t_p):
        return
    turn = 0.0 if how.heading is None else how.heading - _heading(attitude, v - how.wind)
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    p, since = to_ned(origin, *place.T), (t_p - t_p[-1])[:, None]
    path = (p - p[-1] - how.wind * since) @ R.T + how.wind_then * since  # from the last position
    placed = to_geodetic(origin, p[-1] + path) if how.to is None else to_geodetic(how.to, path)
    history.put("position", t_p, placed.astype(float))
    history.put("velocity", t_v, (v - how.wind) @ R.T + how.wind_then)
    if len(t_a):
        attitude[:, 2] = wrap(attitude[:, 2] + turn)
        history.put("attitude", t_a, attitude)


def _heading(attitude: np.ndarray, air: np.ndarray) -> float:
    """Return the heading: as received, else the direction of the air-relative velocity [rad]."""
    if len(attitude):
        return float(attitude[-1, 2])
    return float(np.arctan2(air[-1, 1], air[-1, 0])) if len(air) else 0.0
