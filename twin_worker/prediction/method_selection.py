"""Selection of the prediction method with the smallest past error, all methods scored at the same times.

Source: Bates & Granger 1969, "The combination of forecasts" (the mean of two forecasts is one of the methods).
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from twin_worker.confidence.tube_and_horizon import path_length
from twin_worker.numerics.interpolation import interpolate_rows

SCORE_AHEAD = np.arange(0.0, 61.0, 5.0)  # look-ahead of the scores [s]
SCORE_INTERVAL_S = 5.0  # interval of scored predictions [s]
PREFERENCE = ("both", "hybrid", "dynamics", "paper")  # preference before any score
_SMOOTHING = 0.1  # smoothing weight of the newest score
_SWITCH_RATIO = 0.85  # another method replaces the preferred one below this ratio of errors [-]
_MIN_SCORED = 4  # minimum scored predictions
_MAX_GAP_S = 2.0  # predictions across a longer gap are not scored [s]


@dataclass
class MethodSelector:
    """Score the predicted paths of every method against the flight.

    Attributes:
        pending: predictions that are not scored yet: start time, ground speed, path by method
        mean_error: smoothed mean relative error up to 60 s, by method [-]
        n_scored: number of scored predictions, by method
    """

    pending: deque[tuple[float, float, dict[str, np.ndarray]]] = field(default_factory=deque)
    mean_error: dict[str, float] = field(default_factory=dict)
    n_scored: dict[str, int] = field(default_factory=dict)

    def is_due(self, t: float) -> bool:
        """Return whether predictions at `t` are scored, which requires a path of every method."""
        return not self.pending or not self.pending[-1][0] <= t < self.pending[-1][0] + SCORE_INTERVAL_S

    def add(self, t: float, speed: float, ahead: np.ndarray, paths: dict[str, np.ndarray]) -> None:
        """Add the predicted path of each method at `t`.

        Args:
            t: start time [s since 1970]
            speed: ground speed [m/s]
            ahead: look-ahead times, (k,) [s]
            paths: NED, (k, 3) [m] by method
        """
        rows = {method: interpolate_rows(SCORE_AHEAD, ahead, path) for method, path in paths.items()}
        self.pending.append((t, speed, rows))

    def clear(self) -> None:
        """Discard pending predictions that an event has invalidated."""
        self.pending.clear()

    def score(self, t: np.ndarray, positions: np.ndarray) -> None:
        """Score completed predictions with the flight: times (n,) [s since 1970], positions NED (n, 3) [m]."""
        while self.pending and len(t) and self.pending[0][0] + SCORE_AHEAD[-1] <= t[-1]:
            start_t, speed, paths = self.pending.popleft()
            times = start_t + SCORE_AHEAD
            time_gap = np.abs(t[np.clip(np.searchsorted(t, times), 0, len(t) - 1)] - times)
            if start_t < t[0] or time_gap.max() > _MAX_GAP_S:
                continue
            actual = interpolate_rows(times, t, positions)
            length = path_length(actual, speed)
            for method, path in paths.items():
                self._update(method, float(np.mean(np.linalg.norm(path - actual, axis=1)[1:] / length[1:])))

    def _update(self, method: str, error: float) -> None:
        n = self.n_scored[method] = self.n_scored.get(method, 0) + 1
        previous = self.mean_error.get(method, error)
        self.mean_error[method] = previous + max(_SMOOTHING, 1.0 / n) * (error - previous)

    def best(self, methods: tuple[str, ...]) -> str:
        """Return the first of `PREFERENCE` among methods, unless another has a clearly smaller error."""
        scored = [method for method in methods if self.n_scored.get(method, 0) >= _MIN_SCORED]
        if len(scored) < len(methods):
            return min(methods, key=PREFERENCE.index)
        preferred = min(methods, key=PREFERENCE.index)
        best_scored = min(scored, key=lambda method: self.mean_error[method])
        return best_scored if self.mean_error[best_scored] < _SWITCH_RATIO * self.mean_error[preferred] else preferred

    def describe(self, method: str) -> str:
        """Describe the errors of all methods; empty before enough scores."""
        if len(self.mean_error) < 2 or self.n_scored.get(method, 0) < _MIN_SCORED:
            return ""
        others = ", ".join(f"{name} {error:.1%}" for name, error in self.mean_error.items() if name != method)
        return f"{method}: mean error {self.mean_error[method]:.1%} of path length ({others})"
