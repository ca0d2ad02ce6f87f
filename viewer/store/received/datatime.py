"""Data time: what the clock of the flight says, live or recorded years ago, and how fast it runs on this page."""

from datetime import UTC, datetime
from math import inf, isfinite
from typing import NamedTuple

UNDATED_S = 946_684_800.0  # 2000-01-01: a log that never heard of the date counts from here [s since 1970]
MONTH_S = 30 * 86_400.0  # no log runs for longer: what lies later has a date [s]
LATEST = 4e9  # times beyond are noise [s since 1970]
MEASURE_S = 2.0  # wall time over which the pace is measured [s]
COAST_S = 1.0  # so long a silence is bridged at the pace before it; from then on data time runs as the wall clock [s]
STEADY = 0.2  # a pace this near to 1 is called real time


class DataTime(NamedTuple):
    """The newest data time heard of a UAV, and the pace it comes at."""

    t: float = -inf  # newest, [s since 1970]
    heard: float = -inf  # when, monotonic [s]
    pace: float = 1.0  # data seconds per wall second, measured
    since: tuple[float, float] = (-inf, -inf)  # t and heard where the measurement began

    def hear(self, t: float, now: float) -> "DataTime":
        """Take over a time told at `now`, monotonic [s]; an older one than the newest changes nothing."""
        if not t > self.t:
            return self
        began_t, began = self.since
        passed = now - began
        if not isfinite(passed):
            return DataTime(t, now, self.pace, (t, now))
        if passed < MEASURE_S:
            return DataTime(t, now, self.pace, self.since)
        pace = (t - began_t) / passed
        return DataTime(t, now, 1.0 if abs(pace - 1) < STEADY else pace, (t, now))

    def at(self, now: float) -> float:
        """Estimate data time now [s since 1970]; -inf before any was heard."""
        silent = now - self.heard if isfinite(self.heard) else 0.0
        return self.t + min(silent, COAST_S) * self.pace + max(silent - COAST_S, 0.0)


def is_dated(t: float) -> bool:
    """Return whether a time is one of the calendar; else it counts from the start of its log."""
    return UNDATED_S + MONTH_S <= t < LATEST


def moment(t: float) -> str:
    """Say a time in a list: 15:53:31 of its day in UTC, or +2:05 since the start of an undated log."""
    if is_dated(t):
        return f"{datetime.fromtimestamp(t, UTC):%H:%M:%S}"
    if not 0 <= t < LATEST:
        return "–"
    minutes, seconds = divmod(int(t - UNDATED_S if t >= UNDATED_S else t), 60)
    return f"+{minutes}:{seconds:02d}"


def day(t: float) -> str:
    """Say how to read the moments of a list: the day of a time, or that there is none."""
    return f"{datetime.fromtimestamp(t, UTC):%Y-%m-%d} UTC" if is_dated(t) else "undated, since its start"


def stamp(t: float) -> str:
    """Say day and moment: 2018-07-18 15:53:31 UTC."""
    return f"{datetime.fromtimestamp(t, UTC):%Y-%m-%d %H:%M:%S} UTC" if is_dated(t) else f"undated {moment(t)}"


def times(pace: float) -> str:
    """Say a pace: 4×."""
    return f"{pace:.0f}×" if pace >= 1.5 else f"{pace:.2g}×"
