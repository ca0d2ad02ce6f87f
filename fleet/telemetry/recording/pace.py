"""Replay timing: wait until recorded times are due, and measure the replay speed."""

import math
import threading
import time


class Pace:
    """Replay at a multiple of real time.

    Args:
        speed: recorded seconds per second; inf: as fast as possible
    """

    def __init__(self, speed: float) -> None:
        self.speed = speed
        self.passed_s = 0.0  # recorded time replayed [s]
        self._first: float | None = None
        self._begun = self._newest = 0.0

    def wait(self, now: float, stop: threading.Event) -> bool:
        """Wait until recorded time `now` [s since 1970] is due; return True if stopped meanwhile."""
        if self._first is None:
            self._first, self._begun = now, time.monotonic()
        due = self._begun + (now - self._first) / self.speed - time.monotonic()
        stopped = stop.wait(due) if due > 0 else stop.is_set()
        self.passed_s, self._newest = now - self._first, time.monotonic()
        return stopped

    @property
    def took_s(self) -> float:
        """Return the elapsed wall time [s]."""
        return self._newest - self._begun

    @property
    def reached(self) -> float:
        """Return the mean replay speed, recorded seconds per second; nan before the start."""
        return self.passed_s / self.took_s if self.took_s > 0 else math.nan

    def words(self) -> str:
        """Return progress and speed as text."""
        minutes, seconds = divmod(int(self.passed_s), 60)
        hours, minutes = divmod(minutes, 60)
        fast = "" if math.isnan(self.reached) else f", {self.reached:.1f} times real time"
        return (f"{hours}:" if hours else "") + f"{minutes:02}:{seconds:02} recorded{fast}"


def read_speed(text: str) -> float:
    """Parse a replay speed: a multiple of real time, or `max`.

    Raises:
        ValueError: if it is neither; pass a number above 0 or `max`.
    """
    try:
        speed = math.inf if text == "max" else float(text)
    except ValueError:
        speed = 0.0
    if not speed > 0:
        raise ValueError(f"speed: found {text!r}, expected a number above 0 or max; write e.g. 4")
    return speed
