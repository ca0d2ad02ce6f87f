"""Selection of the prediction method with the smallest past error, all methods scored at the same times.

Source: Bates & Granger 1969, "The combination of forecasts" (the mean of two forecasts is one of the methods).
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from twin_worker.confidence.tube_and_horizon import path_length
from twin_worker.numerics.interpolation import straight

AT = np.arange(0.0, 61.0, 5.0)  # look-ahead of the scores [s]
EVERY_S = 5.0  # interval of scored predictions [s]
ORDER = ("both", "hybrid", "dynamics", "paper")  # preference before any score
_NEWS = 0.1  # smoothing weight of the newest score
_CLEARLY = 0.85  # another method replaces the preferred one below this ratio of errors [-]
_LEAST = 4  # minimum scored predictions
_HOLE_S = 2.0  # predictions across a longer gap are not scored [s]


@dataclass
class Contest:
    """Score the predicted paths of every method against the flight.

    Attributes:
        pending: predictions that are not scored yet: start time, ground speed, path by method
        mean_error: smoothed mean relative error up to 60 s, by method [-]
        n_scored: number of scored predictions, by method
    """

    waiting: deque[tuple[float, float, dict[str, np.ndarray]]] = field(default_factory=deque)
    miss: dict[str, float] = field(default_factory=dict)
    count: dict[str, int] = field(default_factory=dict)

    def due(self, t: float) -> bool:
        """Return whether predictions at `t` are scored, which requires a path of every method."""
        return not self.waiting or not self.waiting[-1][0] <= t < self.waiting[-1][0] + EVERY_S

    def keep(self, t: float, speed: float, ahead: np.ndarray, paths: dict[str, np.ndarray]) -> None:
        """Add the predicted path of each method at `t`.

        Args:
            t: start time [s since 1970]
            speed: ground speed [m/s]
            ahead: look-ahead times, (k,) [s]
            paths: NED, (k, 3) [m] by method
        """
        rows = {method: straight(AT, ahead, path) for method, path in paths.items()}
        self.waiting.append((t, speed, rows))

    def forget(self) -> None:
        """Discard pending predictions that an event has invalidated."""
        self.waiting.clear()

    def answer(self, t: np.ndarray, flown: np.ndarray) -> None:
        """Score completed predictions with the flight: times (n,) [s since 1970], positions NED (n, 3) [m]."""
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
        """Return the first of `PREFERENCE` among methods, unless another has a clearly smaller error."""
        known = [method for method in methods if self.count.get(method, 0) >= _LEAST]
        if len(known) < len(methods):
            return min(methods, key=ORDER.index)
        usual = min(methods, key=ORDER.index)
        least = min(known, key=lambda method: self.miss[method])
        return least if self.miss[least] < _CLEARLY * self.miss[usual] else usual

    def said(self, method: str) -> str:
        """Describe the errors of all methods; empty before enough scores."""
        if len(self.miss) < 2 or self.count.get(method, 0) < _LEAST:
            return ""
        others = ", ".join(f"{name} {miss:.1%}" for name, miss in self.miss.items() if name != method)
        return f"{method}: mean error {self.miss[method]:.1%} of path length ({others})"
