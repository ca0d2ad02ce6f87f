"""The radio of a pretend aircraft: loses frames, delays the others a little, keeps their order."""

from collections import deque

import numpy as np

DELAY_S = 0.015  # shortest way down [s]
JITTER_S = 0.004  # mean of what comes on top [s]
FADE_S = (0.2, 1.4)  # how long it falls silent, where it does [s]


class Link:
    """One direction of one radio link."""

    def __init__(self, rng: np.random.Generator, loss: float, fades_s: float = 0.0):
        """Draw losses from `rng`; it falls silent every `fades_s` seconds or so, if that is above 0.

        Raises:
            ValueError: when `loss` is no share.
        """
        if not 0 <= loss < 1:
            raise ValueError(f"loss: found {loss}, expected a share from 0 to below 1; write e.g. 0.02")
        self._rng, self._loss = rng, loss
        self._queue: deque[tuple[float, bytes]] = deque()
        self._last = 0.0
        self._fades_s = fades_s
        self._fade = (0.0, 0.0)  # the next one begins, ends [s]

    def send(self, t: float, frames: list[bytes]) -> None:
        """Hand over frames at time `t` [s]."""
        if self._fades_s > 0 and self._faded(t):
            return
        for frame in frames:
            if self._rng.random() >= self._loss:
                self._last = max(self._last, t + DELAY_S + float(self._rng.exponential(JITTER_S)))
                self._queue.append((self._last, frame))

    def _faded(self, t: float) -> bool:
        if t >= self._fade[1]:
            begins = t + float(self._rng.exponential(self._fades_s))
            self._fade = begins, begins + float(self._rng.uniform(*FADE_S))
        return t >= self._fade[0]

    def receive(self, t: float) -> list[tuple[float, bytes]]:
        """Return what has arrived by time `t`: arrival time [s] and frame, in order."""
        arrived = []
        while self._queue and self._queue[0][0] <= t:
            arrived.append(self._queue.popleft())
        return arrived
