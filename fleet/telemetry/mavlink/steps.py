"""Recorded time in small steps, as the gateway publishes live: 0.1 s each, and none through long silence."""

from collections.abc import Callable, Iterator

import numpy as np

from fleet.contract import Status

STEP_S = 0.1  # recorded time between two publications [s]
SILENT_STEPS = 100  # steps made after the last message of a gap; by then everybody knows of the silence
MOST_GAPS = 1000  # silences that are played; frames between later ones are combined into one step
SETTLE_S = 2.5  # after the end: what waited for more is handed over [s]


class Steps:
    """The steps of one recording.

    Args:
        take: hands over the news up to a time
    """

    def __init__(self, take: Callable[[float], list]) -> None:
        self._take = take
        self._first: float | None = None
        self._number = 0  # of the newest step
        self.gaps = 0  # silences longer than `SILENT_STEPS`

    def upto(self, arrival: np.ndarray) -> Iterator[tuple[float, list]]:
        """Return the steps that are complete once these have arrived: (end of the step [s since 1970], news).

        Args:
            arrival: of everything new, never falling, (n,) [s since 1970]
        """
        if not len(arrival):
            return
        if self._first is None:
            self._first = float(arrival[0])
        numbers = np.unique(np.floor((arrival - self._first) / STEP_S).astype(int))
        silence = np.diff(numbers, prepend=self._number) > SILENT_STEPS
        order = self.gaps + np.cumsum(silence)  # the number of each silence
        combined = np.append(silence[1:] & (order[1:] > MOST_GAPS), False)  # another silence follows
        self.gaps = int(order[-1])
        for number, gaps in zip(numbers[~combined].tolist(), order[~combined].tolist(), strict=True):
            silent = SILENT_STEPS if gaps <= MOST_GAPS else 1
            for step in range(self._number, min(number, self._number + silent)):
                now = self._first + (step + 1) * STEP_S
                yield now, self._take(now)
            self._number = max(number, self._number)

    def last(self) -> Iterator[tuple[float, list]]:
        """Return what is left at the end."""
        if self._first is not None:
            now = self._first + (self._number + 1) * STEP_S
            yield now, self._take(now)
            settled = self._take(now + SETTLE_S)
            yield now + SETTLE_S, [news for news in settled if not isinstance(news, Status)]  # the link is not silent
