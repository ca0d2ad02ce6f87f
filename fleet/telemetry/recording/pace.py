"""Replay timing: wait until recorded times are due, and measure the replay speed."""

import math
import threading
import time


class ReplayPace:
    """Replay at a multiple of real time.

    Args:
        speed: recorded seconds per second; inf: as fast as possible
    """

    def __init__(self, speed: float) -> None:
        self.speed = speed
        self.passed_s = 0.0  # recorded time replayed [s]
        self._first_t: float | None = None
        self._started = self._newest = 0.0

    def wait(self, now: float, stop: threading.Event) -> bool:
        """Wait until recorded time `now` [s since 1970] is due; return True if stopped meanwhile."""
        if self._first_t is None:
            self._first_t, self._started = now, time.monotonic()
        due = self._started + (now - self._first_t) / self.speed - time.monotonic()
        stopped = stop.wait(due) if due > 0 else stop.is_set()
        self.passed_s, self._newest = now - self._first_t, time.monotonic()
        return stopped

    @property
    def elapsed_s(self) -> float:
        """Return the elapsed wall time [s]."""
        return self._newest - self._started

    @property
    def speed_reached(self) -> float:
        """Return the mean replay speed, recorded seconds per second; nan before the start."""
        return self.passed_s / self.elapsed_s if self.elapsed_s > 0 else math.nan

    def progress_text(self) -> str:
        """Return progress and speed as text."""
        minutes, seconds = divmod(int(self.passed_s), 60)
        hours, minutes = divmod(minutes, 60)
        speed_text = "" if math.isnan(self.speed_reached) else f", {self.speed_reached:.1f} times real time"
        return (f"{hours}:" if hours else "") + f"{minutes:02}:{seconds:02} recorded{speed_text}"


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
