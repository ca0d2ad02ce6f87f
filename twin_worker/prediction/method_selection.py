"""Which way of flying the route is used: the one whose past predictions strayed least, all scored at the same instants.

Source: Bates & Granger 1969, "The combination of forecasts" (why the mean of two is one of them).
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from twin_worker.confidence.tube_and_horizon import path_length
from twin_worker.numerics.interpolation import straight

AT = np.arange(0.0, 61.0, 5.0)  # look-ahead at which paths are compared [s]
EVERY_S = 5.0  # between predictions that are compared [s]
ORDER = ("both", "hybrid", "dynamics", "paper")  # while there is nothing to compare
_NEWS = 0.1  # weight of the newest, once there are many
_CLEARLY = 0.85  # share of the usual one's miss below which another is preferred: the mean of two errs less [-]
_LEAST = 4  # answered predictions before any of them counts
_HOLE_S = 2.0  # a longer hole in the flight gives no answer [s]


@dataclass
class Contest:
    """Paths of every method that wait for the flight, and how far each strayed so far.

    Attributes:
        miss: mean relative error up to 60 s, smoothed, by method [-]
        count: predictions answered, by method
    """

    waiting: deque[tuple[float, float, dict[str, np.ndarray]]] = field(default_factory=deque)
    miss: dict[str, float] = field(default_factory=dict)
    count: dict[str, int] = field(default_factory=dict)

    def due(self, t: float) -> bool:
        """Return whether the paths made at `t` are to be compared, so that every method must fly."""
        return not self.waiting or not self.waiting[-1][0] <= t < self.waiting[-1][0] + EVERY_S

    def keep(self, t: float, speed: float, ahead: np.ndarray, paths: dict[str, np.ndarray]) -> None:
        """Remember what each method foretells at `t`.

        Args:
            t: when they start [s since 1970]
            speed: over ground [m/s]
            ahead: look-ahead from there, (k,) [s]
            paths: NED, (k, 3) [m] by method
        """
        rows = {method: straight(AT, ahead, path) for method, path in paths.items()}
        self.waiting.append((t, speed, rows))

    def forget(self) -> None:
        """Drop what an event has made meaningless."""
        self.waiting.clear()

    def answer(self, t: np.ndarray, flown: np.ndarray) -> None:
        """Score what has been flown to its end: times (n,) [s since 1970], positions NED (n, 3) [m]."""
        while self.waiting and len(t) and self.waiting[0][0] + AT[-1] <= t[-1]:
            begun, speed, paths = self.waiting.popleft()
            at = begun + AT
            near = np.abs(t[np.clip(np.searchsorted(t, at), 0, len(t) - 1)] - at)
            if begun < t[0] or near.max() > _HOLE_S:
                continue
            truth = straight(at, t, flown)
            length = path_length(truth, speed)
            for method, path in paths.items():
                self._take(method, float(np.mean(np.linalg.norm(path - truth, axis=1)[1:] / length[1:])))

    def _take(self, method: str, miss: float) -> None:
        n = self.count[method] = self.count.get(method, 0) + 1
        before = self.miss.get(method, miss)
        self.miss[method] = before + max(_NEWS, 1.0 / n) * (miss - before)

    def best(self, methods: tuple[str, ...]) -> str:
        """Choose the first of `ORDER` among methods, unless another strayed clearly less in enough of them."""
        known = [method for method in methods if self.count.get(method, 0) >= _LEAST]
        if len(known) < len(methods):
            return min(methods, key=ORDER.index)
        usual = min(methods, key=ORDER.index)
        least = min(known, key=lambda method: self.miss[method])
        return least if self.miss[least] < _CLEARLY * self.miss[usual] else usual

    def said(self, method: str) -> str:
        """Say what the choice rests on; empty before enough were answered."""
        if len(self.miss) < 2 or self.count.get(method, 0) < _LEAST:
            return ""
        others = ", ".join(f"{name} {miss:.1%}" for name, miss in self.miss.items() if name != method)
        return f"{method} strayed {self.miss[method]:.1%} of the way ({others})"
