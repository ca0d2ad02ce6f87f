"""Data time: time stamps of the flight, live or recorded, and the rate at which they advance."""

from datetime import UTC, datetime
from math import inf, isfinite
from typing import NamedTuple

UNDATED_EPOCH_S = 946_684_800.0  # 2000-01-01: start time of a log without a date [s since 1970]
MAX_UNDATED_S = 30 * 86_400.0  # longest undated log; later times have a date [s]
LATEST = 4e9  # later times are invalid [s since 1970]
RATE_WINDOW_S = 2.0  # wall time over which the rate is measured [s]
COAST_S = 1.0  # data time advances at the last rate for this long without data, then at 1 [s]
REALTIME_TOLERANCE = 0.2  # a rate within this of 1 is real time


class DataTime(NamedTuple):
    """Newest data time of a UAV and the rate at which it advances."""

    t: float = -inf  # newest, [s since 1970]
    received: float = -inf  # arrival of t, monotonic [s]
    rate: float = 1.0  # data seconds per wall second, measured
    window_start: tuple[float, float] = (-inf, -inf)  # t and received at the start of the rate measurement

    def update(self, t: float, now: float) -> "DataTime":
        """Update with a time received at `now`, monotonic [s]; ignore a time that is not newer."""
        if not t > self.t:
            return self
        start_t, start = self.window_start
        elapsed = now - start
        if not isfinite(elapsed):
            return DataTime(t, now, self.rate, (t, now))
        if elapsed < RATE_WINDOW_S:
            return DataTime(t, now, self.rate, self.window_start)
        rate = (t - start_t) / elapsed
        return DataTime(t, now, 1.0 if abs(rate - 1) < REALTIME_TOLERANCE else rate, (t, now))

    def estimate(self, now: float) -> float:
        """Estimate the current data time [s since 1970]; -inf before the first message."""
        silence_s = now - self.received if isfinite(self.received) else 0.0
        return self.t + min(silence_s, COAST_S) * self.rate + max(silence_s - COAST_S, 0.0)


def is_dated(t: float) -> bool:
    """Return whether a time has a calendar date; otherwise it counts from the start of its log."""
    return UNDATED_EPOCH_S + MAX_UNDATED_S <= t < LATEST


def time_of_day(t: float) -> str:
    """Format a time: 15:53:31 (UTC), or +2:05 since the start of an undated log."""
    if is_dated(t):
        return f"{datetime.fromtimestamp(t, UTC):%H:%M:%S}"
    if not 0 <= t < LATEST:
        return "–"
    minutes, seconds = divmod(int(t - UNDATED_EPOCH_S if t >= UNDATED_EPOCH_S else t), 60)
    return f"+{minutes}:{seconds:02d}"


def date_text(t: float) -> str:
    """Format the date of a time, or state that there is none."""
    return f"{datetime.fromtimestamp(t, UTC):%Y-%m-%d} UTC" if is_dated(t) else "undated, since its start"


def timestamp(t: float) -> str:
    """Format date and time: 2018-07-18 15:53:31 UTC."""
    return f"{datetime.fromtimestamp(t, UTC):%Y-%m-%d %H:%M:%S} UTC" if is_dated(t) else f"undated {time_of_day(t)}"


def rate_text(rate: float) -> str:
    """Format a rate: 4×."""
    return f"{rate:.0f}×" if rate >= 1.5 else f"{rate:.2g}×"
