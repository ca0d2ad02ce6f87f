"""Simulated radio link: loses frames, delays the others, preserves their order."""

from collections import deque

import numpy as np

DELAY_S = 0.015  # minimum delay [s]
JITTER_S = 0.004  # mean additional delay [s]
FADE_S = (0.2, 1.4)  # range of the duration of a fade [s]


class RadioLink:
    """One direction of one radio link."""

    def __init__(self, rng: np.random.Generator, loss: float, fades_s: float = 0.0):
        """Draw losses from `rng`; with `fades_s` above 0, fades occur at this mean interval [s].

        Raises:
            ValueError: when `loss` is outside 0..1.
        """
        if not 0 <= loss < 1:
            raise ValueError(f"loss: found {loss}, expected a fraction from 0 to below 1; use e.g. 0.02")
        self._rng, self._loss = rng, loss
        self._queue: deque[tuple[float, bytes]] = deque()
        self._last_arrival = 0.0
        self._fades_s = fades_s
        self._fade = (0.0, 0.0)  # start and end of the next fade [s]

    def send(self, t: float, frames: list[bytes]) -> None:
        """Send frames at time `t` [s]."""
        if self._fades_s > 0 and self._is_faded(t):
            return
        for frame in frames:
            if self._rng.random() >= self._loss:
                self._last_arrival = max(self._last_arrival, t + DELAY_S + float(self._rng.exponential(JITTER_S)))
                self._queue.append((self._last_arrival, frame))

    def _is_faded(self, t: float) -> bool:
        if t >= self._fade[1]:
            begins = t + float(self._rng.exponential(self._fades_s))
            self._fade = begins, begins + float(self._rng.uniform(*FADE_S))
        return t >= self._fade[0]

    def receive(self, t: float) -> list[tuple[float, bytes]]:
        """Return the frames received until `t`: arrival time [s] and frame, in order."""
        arrived = []
        while self._queue and self._queue[0][0] <= t:
            arrived.append(self._queue.popleft())
        return arrived
