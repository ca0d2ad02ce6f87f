"""Feed the wind filter from telemetry as it came."""

from bisect import bisect_left
from math import inf

from twin_worker.estimation.wind_filter import WindFilter
from twin_worker.telemetry.history import History

_EVERY_S = 0.199  # between rows taken [s]
_STALE_S = 0.5  # airspeed and heading older than this say nothing of a velocity [s]


def blow(wind: WindFilter, history: History, last: float, since: float, until: float = inf) -> float:
    """Take ground velocities, five a second; give the time of the newest taken [s since 1970].

    Args:
        wind: changed in place
        history: telemetry
        last: newest row taken before [s since 1970]
        since, until: rows before and after are left out [s since 1970]
    """
    times, v = history.look("velocity", since)
    air_times, air = history.look("air", since - 1.0)
    att_times, attitude = history.look("attitude", since - 1.0)
    t_air, t_att = air_times.tolist(), att_times.tolist()  # a few numbers are looked at faster than an array
    if not (t_air and t_att):
        return last
    for t, ground in zip(times.tolist(), v.tolist(), strict=True):
        if t - last < _EVERY_S or t >= until:
            continue
        i, j = bisect_left(t_air, t) - 1, bisect_left(t_att, t) - 1
        if i >= 0 and j >= 0 and t - t_air[i] < _STALE_S and t - t_att[j] < _STALE_S:
            last = t
            wind.update(t, ground, float(air[i, 0]), float(attitude[j, 2]))
    return last
