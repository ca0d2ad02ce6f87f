"""Playback state: live, paused or playing. Pure: it depends on times only."""

from dataclasses import dataclass
from typing import NamedTuple


class TimelineRange(NamedTuple):
    """Available time range: oldest to newest recorded data time [s since 1970]."""

    begin: float
    end: float

    def clip(self, t: float) -> float:
        """Clip a time to the range."""
        return min(max(t, self.begin), self.end)

    def fraction(self, t: float) -> float:
        """Return the relative position of a time in the range, 0 to 1."""
        return (self.clip(t) - self.begin) / max(self.end - self.begin, 1e-9)


@dataclass
class Player:
    """Time shown and playback rate."""

    t: float | None = None  # data time shown [s since 1970]; None: live
    rate: float = 0.0  # data seconds per wall second; 0 paused

    @property
    def live(self) -> bool:
        """Return whether the page is live."""
        return self.t is None

    def go_live(self) -> None:
        """Return to live."""
        self.t, self.rate = None, 0.0

    def seek(self, t: float, span: TimelineRange) -> None:
        """Show another time; a live player pauses there."""
        self.t = span.clip(t)

    def pause(self, span: TimelineRange) -> None:
        """Pause at the time shown."""
        self.t, self.rate = span.end if self.t is None else self.t, 0.0

    def play(self, rate: float, span: TimelineRange) -> None:
        """Play at a rate from the time shown; from live, play from the beginning."""
        self.t, self.rate = span.begin if self.t is None else self.t, rate

    def advance(self, elapsed: float, span: TimelineRange) -> None:
        """Advance by elapsed wall time [s]; skip deleted data, return to live at the end."""
        if self.t is None:
            return
        self.t = max(self.t + self.rate * elapsed, span.begin)
        if self.rate and self.t >= span.end:
            self.go_live()


def next_after(t: float, times: list[float]) -> float | None:
    """Return the first time after t by more than 1 ms; None when there is none."""
    return min((candidate for candidate in times if candidate > t + 1e-3), default=None)


def last_before(t: float, times: list[float]) -> float | None:
    """Return the last time before t by more than 1 ms; None when there is none."""
    return max((candidate for candidate in times if candidate < t - 1e-3), default=None)
