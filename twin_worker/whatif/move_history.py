"""Telemetry as it would be, had the same air-relative flight been flown elsewhere, on another heading, in another wind.

Everything a twin learns in flight is relative to the air, so that a start elsewhere is a rigid motion of the flight so
far:  v' = R (v - w) + w';  p' = start + R (p - p_end - w s) + w' s  with s = t - t_end.  What has no place (servos,
commands, airspeed, rates) stays.
"""

from dataclasses import dataclass

import numpy as np

from fleet.frames import Origin, to_geodetic, to_ned, wrap
from twin_worker.telemetry.history import History


@dataclass(frozen=True)
class Motion:
    """How the flight so far is moved.

    Attributes:
        to: start; None: where it is
        heading: of the nose [rad]; None: as it is
        wind, wind_then: as it is and as it would be, NED, (3,) [m/s]
    """

    to: Origin | None
    heading: float | None
    wind: np.ndarray
    wind_then: np.ndarray


def moved(history: History, origin: Origin, how: Motion) -> None:
    """Move what is remembered, in place."""
    t_p, place = history.rows("position")
    t_v, v = history.rows("velocity")
    t_a, attitude = history.rows("attitude")
    if not len(t_p):
        return
    turn = 0.0 if how.heading is None else how.heading - _heading(attitude, v - how.wind)
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    p, since = to_ned(origin, *place.T), (t_p - t_p[-1])[:, None]
    path = (p - p[-1] - how.wind * since) @ R.T + how.wind_then * since  # from where it ends
    placed = to_geodetic(origin, p[-1] + path) if how.to is None else to_geodetic(how.to, path)
    history.put("position", t_p, placed.astype(float))
    history.put("velocity", t_v, (v - how.wind) @ R.T + how.wind_then)
    if len(t_a):
        attitude[:, 2] = wrap(attitude[:, 2] + turn)
        history.put("attitude", t_a, attitude)


def _heading(attitude: np.ndarray, air: np.ndarray) -> float:
    """Return where the nose points: as sent, else along the flight through the air [rad]."""
    if len(attitude):
        return float(attitude[-1, 2])
    return float(np.arctan2(air[-1, 1], air[-1, 0])) if len(air) else 0.0
