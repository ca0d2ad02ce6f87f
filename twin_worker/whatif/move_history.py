"""Transform telemetry to another start, heading and wind with the same air-relative flight.

Everything a twin identifies in flight is relative to the air, so another start is a rigid motion of the flight so far:
v' = R (v - w) + w';  p' = start + R (p - p_end - w s) + w' s  with s = t - t_end.  Telemetry without a position
(servos, commands, airspeed, rates) is unchanged.
"""

from dataclasses import dataclass

import numpy as np

from fleet.frames import Origin, to_geodetic, to_ned, wrap
from twin_worker.telemetry.history import TelemetryHistory


@dataclass(frozen=True)
class Motion:
    """Rigid motion of the flight so far.

    Attributes:
        start: new end position of the flight so far; None: unchanged
        heading: new heading of the nose [rad]; None: unchanged
        wind, new_wind: actual and hypothetical wind, NED, (3,) [m/s]
    """

    start: Origin | None
    heading: float | None
    wind: np.ndarray
    new_wind: np.ndarray


def move_history(history: TelemetryHistory, origin: Origin, motion: Motion) -> None:
    """Move the telemetry history, in place."""
    t_p, geodetic = history.rows("position")
    t_v, v = history.rows("velocity")
    t_a, attitude = history.rows("attitude")
    if not len(t_p):
        return
    rotation = 0.0 if motion.heading is None else motion.heading - _heading(attitude, v - motion.wind)
    c, s = np.cos(rotation), np.sin(rotation)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    p, relative_t = to_ned(origin, *geodetic.T), (t_p - t_p[-1])[:, None]
    path = (p - p[-1] - motion.wind * relative_t) @ R.T + motion.new_wind * relative_t  # from the last position
    moved_positions = to_geodetic(origin, p[-1] + path) if motion.start is None else to_geodetic(motion.start, path)
    history.replace_rows("position", t_p, moved_positions.astype(float))
    history.replace_rows("velocity", t_v, (v - motion.wind) @ R.T + motion.new_wind)
    if len(t_a):
        attitude[:, 2] = wrap(attitude[:, 2] + rotation)
        history.replace_rows("attitude", t_a, attitude)


def _heading(attitude: np.ndarray, air_velocity: np.ndarray) -> float:
    """Return the heading: as received, else the direction of the air-relative velocity [rad]."""
    if len(attitude):
        return float(attitude[-1, 2])
    return float(np.arctan2(air_velocity[-1, 1], air_velocity[-1, 0])) if len(air_velocity) else 0.0
