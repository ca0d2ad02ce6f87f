"""Feed the wind filter from telemetry as it came."""

import numpy as np

from twin_worker.history import History
from twin_worker.wind import WindFilter

_EVERY_S = 0.199  # between rows taken [s]
_STALE_S = 0.5  # airspeed and heading older than this say nothing of a velocity [s]


def blow(wind: WindFilter, history: History, last: float, since: float, until: float = np.inf) -> float:
    """Take ground velocities, five a second; give the time of the newest taken [s since 1970].

    Args:
        wind: changed in place
        history: telemetry
        last: newest row taken before [s since 1970]
        since, until: rows before and after are left out [s since 1970]
    """
    t_v, v = history.rows("velocity", since)
    t_air, air = history.rows("air", since - 1.0)
    t_att, attitude = history.rows("attitude", since - 1.0)
    if not (len(t_air) and len(t_att)):
        return last
    for k in range(len(t_v)):
        if t_v[k] - last < _EVERY_S or t_v[k] >= until:
            continue
        i, j = np.searchsorted(t_air, t_v[k]) - 1, np.searchsorted(t_att, t_v[k]) - 1
        if i >= 0 and j >= 0 and t_v[k] - t_air[i] < _STALE_S and t_v[k] - t_att[j] < _STALE_S:
            last = float(t_v[k])
            wind.update(last, v[k], float(air[i, 0]), float(attitude[j, 2]))
    return last
