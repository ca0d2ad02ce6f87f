"""What is shown when: live, paused, or played again. Pure: it knows times alone."""

from dataclasses import dataclass
from typing import NamedTuple


class Span(NamedTuple):
    """What can be shown: from the oldest kept to the newest heard, data time [s since 1970]."""

    begin: float
    end: float

    def clip(self, t: float) -> float:
        """Bring a time into the span."""
        return min(max(t, self.begin), self.end)

    def share(self, t: float) -> float:
        """Return where in the span a time lies, 0 to 1."""
        return (self.clip(t) - self.begin) / max(self.end - self.begin, 1e-9)


@dataclass
class Player:
    """The time shown; None is live."""

    t: float | None = None  # data time shown [s since 1970]
    rate: float = 0.0  # data seconds per wall second; 0 paused

    @property
    def live(self) -> bool:
        """Return whether what is shown is now."""
        return self.t is None

    def go_live(self) -> None:
        """Show now."""
        self.t, self.rate = None, 0.0

    def seek(self, t: float, span: Span) -> None:
        """Show another time; a player that was live pauses there."""
        self.t = span.clip(t)

    def pause(self, span: Span) -> None:
        """Stand still at the time shown."""
        self.t, self.rate = span.end if self.t is None else self.t, 0.0

    def play(self, rate: float, span: Span) -> None:
        """Play at a rate from the time shown; from live there is nothing to play yet, so from the beginning."""
        self.t, self.rate = span.begin if self.t is None else self.t, rate

    def advance(self, passed: float, span: Span) -> None:
        """Let wall time pass [s]; what is no longer kept is skipped, and whoever reaches the end is live again."""
        if self.t is None:
            return
        self.t = max(self.t + self.rate * passed, span.begin)
        if self.rate and self.t >= span.end:
            self.go_live()


def next_after(t: float, times: list[float]) -> float | None:
    """Find the first of some times after t, by more than rounding; None where there is none."""
    return min((one for one in times if one > t + 1e-3), default=None)


def last_before(t: float, times: list[float]) -> float | None:
    """Find the last of some times before t; None where there is none."""
    return max((one for one in times if one < t - 1e-3), default=None)
