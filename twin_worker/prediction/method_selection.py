"""Selection of the prediction method with the smallest expected error, by prior and scores.

Source: Bates & Granger 1969, "The combination of forecasts" (the mean of two forecasts is one of the methods).
"""

from collections import deque
from dataclasses import dataclass, field
from functools import lru_cache
from math import exp, log

import numba as nb
import numpy as np

from fleet.contract import METHOD_TEXTS
from twin_worker.numerics.interpolation import interpolate_rows
from twin_worker.numerics.prediction_errors import min_path_length

SCORE_AHEAD = np.arange(0.0, 61.0, 5.0)  # look-ahead of the scores [s]
SCORE_INTERVAL_S = 5.0  # interval of scored predictions [s]
_PRIOR_AHEAD = np.array([5.0, 16.0, 30.0, 60.0])  # look-ahead of the prior errors [s]
PRIOR_ERRORS: dict[str, tuple[float, float, float, float]] = {
    "both": (0.025, 0.021, 0.020, 0.016),
    "hybrid": (0.026, 0.022, 0.021, 0.017),
    "dynamics": (0.028, 0.023, 0.022, 0.018),
    "paper": (0.038, 0.051, 0.052, 0.049),
    "greybox": (0.030, 0.024, 0.023, 0.020),
    "copter": (0.05, 0.05, 0.05, 0.05),
    "route_wind": (0.064, 0.060, 0.061, 0.052),
    "route_speed": (0.082, 0.105, 0.112, 0.107),
    "constant_turn": (0.12, 0.46, 0.68, 0.59),
    "constant_velocity": (0.25, 0.55, 0.81, 0.92),
}
"""Expected relative error of each method at `_PRIOR_AHEAD` before any score [-].

Median errors over path length of 288 starts of 16 simulated flights of the calibration set. `both`, `dynamics` and
`copter` are assumptions: slightly below its better part, between `hybrid` and `greybox`, and below the route lines.
"""
_LOG_PRIOR = {name: np.log(np.interp(SCORE_AHEAD[1:], _PRIOR_AHEAD, row)) for name, row in PRIOR_ERRORS.items()}
_MEAN_LOG_PRIOR = {name: float(row.mean()) for name, row in _LOG_PRIOR.items()}
_PRIOR_WEIGHT = 0.25  # weight of the prior, in completely scored predictions: three look-aheads [-]
_MIN_ERROR = 0.01  # smaller relative errors are as good as this: a tenth of the limit of the horizon [-]
_SMOOTHING = 0.1  # smoothing weight of the newest score
_SWITCH_RATIO = 0.85  # another method replaces the preferred one below this ratio of errors [-]
_MIN_DESCRIBED = 1.0  # completely scored predictions from which errors are described [-]
_MAX_GAP_S = 2.0  # predictions across a longer gap are not scored [s]


@dataclass
class MethodSelector:
    """Score the predicted paths of every method against the flight, each look-ahead as soon as it is flown.

    The relative error of method m at look-ahead h is modelled as the prior error times one factor for this aircraft:
    log e_mh = log prior_mh + a_m + noise. The mean of the logarithms estimates a_m, shrunk to zero by the prior.
    Source: Gelman et al. 2013, "Bayesian data analysis", 2.5 (normal mean with a normal prior).

    Attributes:
        pending: predictions that are not completely scored: start time, ground speed, path by method
        scored_t: all look-aheads up to this time are scored [s since 1970]
        mean_error: geometric mean of the relative error up to 60 s, by method [-]
        n_scored: number of scored predictions, in which a part counts as a fraction, by method
    """

    pending: deque[tuple[float, float, dict[str, np.ndarray]]] = field(default_factory=deque)
    scored_t: float = -np.inf
    mean_error: dict[str, float] = field(default_factory=dict)
    n_scored: dict[str, float] = field(default_factory=dict)

    def is_due(self, t: float) -> bool:
        """Return whether predictions at `t` are scored, which requires a path of every method."""
        return not self.pending or not self.pending[-1][0] <= t < self.pending[-1][0] + SCORE_INTERVAL_S

    def has_due_score(self, t: float) -> bool:
        """Return whether a look-ahead of a pending prediction was flown until `t` and is not scored."""
        first_t = self.pending[0][0] if self.pending else np.inf
        return t >= max(first_t, self.scored_t) + SCORE_AHEAD[1]

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
        """Score what was flown of the predictions: times (n,) [s since 1970], positions NED (n, 3) [m]."""
        if not len(t):
            return
        flight = np.ascontiguousarray(t, float), np.ascontiguousarray(positions, float)
        for start_t, speed, paths in self.pending:
            self._score_prediction(start_t, speed, paths, flight)
        self.scored_t = float(t[-1])
        while self.pending and self.pending[0][0] + SCORE_AHEAD[-1] <= t[-1]:
            self.pending.popleft()

    def _score_prediction(
        self, start_t: float, speed: float, paths: dict[str, np.ndarray], flight: tuple[np.ndarray, np.ndarray]
    ) -> None:
        if not paths:
            return
        log_ratios = np.empty(len(paths))
        bounds = start_t, self.scored_t, min_path_length(speed)
        n = _log_error_ratios(bounds, *flight, np.stack(list(paths.values())), _log_priors(tuple(paths)), log_ratios)
        for method, log_ratio in zip(paths, log_ratios.tolist(), strict=True):
            if n:
                self._update(method, log_ratio, n / (len(SCORE_AHEAD) - 1))

    def _update(self, method: str, log_ratio: float, weight: float) -> None:
        n = self.n_scored[method] = self.n_scored.get(method, 0.0) + weight
        log_error = log_ratio + _MEAN_LOG_PRIOR[method]
        previous = log(self.mean_error[method]) if method in self.mean_error else log_error
        self.mean_error[method] = exp(previous + max(_SMOOTHING * weight, weight / n) * (log_error - previous))

    def expected_error(self, method: str) -> float:
        """Return the relative error expected of a method, from prior and scores [-]."""
        n, prior = self.n_scored.get(method, 0.0), _MEAN_LOG_PRIOR[method]
        scored = log(self.mean_error[method]) if n > 0.0 else prior
        return exp((n * scored + _PRIOR_WEIGHT * prior) / (n + _PRIOR_WEIGHT))

    def best(self, methods: tuple[str, ...]) -> str:
        """Return the method with the smallest prior error, unless another has a clearly smaller expected error."""
        preferred, best = (min(methods, key=error) for error in (_MEAN_LOG_PRIOR.__getitem__, self.expected_error))
        return best if self.expected_error(best) < _SWITCH_RATIO * self.expected_error(preferred) else preferred

    def describe(self, method: str) -> str:
        """Describe the errors of all methods; empty before enough scores."""
        if len(self.mean_error) < 2 or self.n_scored.get(method, 0.0) < _MIN_DESCRIBED:
            return ""
        errors = sorted((error, name) for name, error in self.mean_error.items() if name != method)
        others = ", ".join(f"{METHOD_TEXTS[name]} {100 * error:.1f} %" for error, name in errors)
        own = f"{METHOD_TEXTS[method]}: mean error of past predictions {100 * self.mean_error[method]:.1f} %"
        return f"predicted with {own} of path length; other methods: {others}"


@lru_cache(maxsize=256)
def _log_priors(methods: tuple[str, ...]) -> np.ndarray:
    """Return the logarithms of the prior errors of some methods at `SCORE_AHEAD` from its second on, (m, k)."""
    return np.stack([_LOG_PRIOR[method] for method in methods])


@nb.njit(cache=True, error_model="numpy", nogil=True, _nrt=False)  # type: ignore[call-overload]
def _log_error_ratios(
    bounds: tuple[float, float, float],
    t: np.ndarray,
    positions: np.ndarray,
    paths: np.ndarray,
    log_priors: np.ndarray,
    out: np.ndarray,
) -> int:
    """Compute the mean logarithm of relative error over prior error of each path, over the look-aheads to score.

    Args:
        bounds: start of the prediction, time up to which all are scored [s since 1970], minimum path length [m]
        t, positions: flown, rising, (n,) [s since 1970] and (n, 3) [m]
        paths: at `SCORE_AHEAD`, (m, k + 1, 3) [m]
        log_priors: from the second look-ahead on, (m, k)
        out: (m,)
    Returns:
        number of look-aheads; 0 where none is due, or telemetry has a gap at one
    """
    (start_t, scored_t, min_length), n, right = bounds, len(t), 0
    length, due = 0.0, 0
    north = east = down = 0.0
    out[:] = 0.0
    if start_t < t[0]:
        return 0
    for k in range(len(SCORE_AHEAD)):
        time = start_t + SCORE_AHEAD[k]
        if not time <= t[n - 1]:
            break
        while right < n - 1 and t[right] < time:
            right += 1
        left = max(right - 1, 0)
        if min(abs(t[right] - time), abs(t[left] - time)) > _MAX_GAP_S:
            return 0
        part = (time - t[left]) / (t[right] - t[left]) if right > left else 0.0
        north_before, east_before, down_before = north, east, down
        north = positions[left, 0] + part * (positions[right, 0] - positions[left, 0])
        east = positions[left, 1] + part * (positions[right, 1] - positions[left, 1])
        down = positions[left, 2] + part * (positions[right, 2] - positions[left, 2])
        if k == 0:
            continue
        length += np.sqrt((north - north_before) ** 2 + (east - east_before) ** 2 + (down - down_before) ** 2)
        if not time > scored_t:
            continue
        due += 1
        for m in range(len(paths)):
            square = (paths[m, k, 0] - north) ** 2 + (paths[m, k, 1] - east) ** 2 + (paths[m, k, 2] - down) ** 2
            relative = np.sqrt(square) / max(length, min_length)
            out[m] += np.log(_MIN_ERROR if relative < _MIN_ERROR else relative) - log_priors[m, k - 1]
    for m in range(len(paths)):
        out[m] /= max(due, 1)
    return due
