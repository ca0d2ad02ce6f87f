"""Recorded time in steps of 0.1 s, as the live gateway publishes; long silences are skipped."""

from collections.abc import Callable, Iterator

import numpy as np

from fleet.contract import Status

STEP_S = 0.1  # recorded time between two publications [s]
SILENT_STEPS = 100  # steps after the last message before a gap; enough to detect the lost link
MAX_GAPS = 1000  # replayed silences; frames between later ones are combined into one step
FLUSH_AFTER_S = 2.5  # time after the end at which pending messages are returned [s]


class ReplaySteps:
    """Time steps of one recording.

    Args:
        collect: returns the new messages up to a time
    """

    def __init__(self, collect: Callable[[float], list]) -> None:
        self._collect = collect
        self._first: float | None = None
        self._number = 0  # number of the newest step
        self.gaps = 0  # silences longer than `SILENT_STEPS`

    def until(self, arrival: np.ndarray) -> Iterator[tuple[float, list]]:
        """Return the steps completed by new data: (end of the step [s since 1970], messages).

        Args:
            arrival: arrival of the new data, non-decreasing, (n,) [s since 1970]
        """
        if not len(arrival):
            return
        if self._first is None:
            self._first = float(arrival[0])
        numbers = np.unique(np.floor((arrival - self._first) / STEP_S).astype(int))
        is_silent = np.diff(numbers, prepend=self._number) > SILENT_STEPS
        gap_number = self.gaps + np.cumsum(is_silent)  # number of the silence
        combined = np.append(is_silent[1:] & (gap_number[1:] > MAX_GAPS), False)  # another silence follows
        self.gaps = int(gap_number[-1])
        for number, gaps in zip(numbers[~combined].tolist(), gap_number[~combined].tolist(), strict=True):
            silent_steps = SILENT_STEPS if gaps <= MAX_GAPS else 1
            for step in range(self._number, min(number, self._number + silent_steps)):
                now = self._first + (step + 1) * STEP_S
                yield now, self._collect(now)
            self._number = max(number, self._number)

    def remaining(self) -> Iterator[tuple[float, list]]:
        """Return the remaining steps at the end."""
        if self._first is not None:
            now = self._first + (self._number + 1) * STEP_S
            yield now, self._collect(now)
            flushed = self._collect(now + FLUSH_AFTER_S)
            # without status: the end of the recording is no link loss
            yield now + FLUSH_AFTER_S, [message for message in flushed if not isinstance(message, Status)]
