"""Recorded time in steps of 0.1 s, as the live gateway publishes; long silences are skipped."""

from collections.abc import Callable, Iterator

import numpy as np

from fleet.contract import Status

STEP_S = 0.1  # recorded time between two publications [s]
SILENT_STEPS = 100  # steps after the last message before a gap; enough to detect the lost link
MOST_GAPS = 1000  # replayed silences; frames between later ones are combined into one step
SETTLE_S = 2.5  # time after the end at which pending messages are returned [s]


class Steps:
    """Time steps of one recording.

    Args:
        collect: returns the new messages up to a time
    """

    def __init__(self, take: Callable[[float], list]) -> None:
        self._take = take
        self._first: float | None = None
        self._number = 0  # number of the newest step
        self.gaps = 0  # silences longer than `SILENT_STEPS`

    def upto(self, arrival: np.ndarray) -> Iterator[tuple[float, list]]:
        """Return the steps completed by new data: (end of the step [s since 1970], messages).

        Args:
            arrival: arrival of the new data, non-decreasing, (n,) [s since 1970]
        """
        if not len(arrival):
            return
        if self._first is None:
            self._first = float(arrival[0])
        numbers = np.unique(np.floor((arrival - self._first) / STEP_S).astype(int))
        silence = np.diff(numbers, prepend=self._number) > SILENT_STEPS
        order = self.gaps + np.cumsum(silence)  # number of the silence
        combined = np.append(silence[1:] & (order[1:] > MOST_GAPS), False)  # another silence follows
        self.gaps = int(order[-1])
        for number, gaps in zip(numbers[~combined].tolist(), order[~combined].tolist(), strict=True):
            silent = SILENT_STEPS if gaps <= MOST_GAPS else 1
            for step in range(self._number, min(number, self._number + silent)):
                now = self._first + (step + 1) * STEP_S
                yield now, self._take(now)
            self._number = max(number, self._number)

    def last(self) -> Iterator[tuple[float, list]]:
        """Return the remaining steps at the end."""
        if self._first is not None:
            now = self._first + (self._number + 1) * STEP_S
            yield now, self._take(now)
            settled = self._take(now + SETTLE_S)
            # without status: the end of the recording is no link loss
            yield now + SETTLE_S, [news for news in settled if not isinstance(news, Status)]
