"""Selection of the prediction method with the smallest expected error, by prior and scores; turn-rate estimation.

Source: Bates & Granger 1969, "The combination of forecasts" (the mean of two forecasts is one of the methods).
"""

from collections import deque
from dataclasses import dataclass, field
from math import cos, exp, log, sin

import numpy as np
from filterpy.kalman import IMMEstimator, KalmanFilter

from fleet.contract import METHOD_TEXTS
from twin_worker.confidence.tube_and_horizon import path_length
from twin_worker.numerics.interpolation import interpolate_rows
from twin_worker.telemetry.track import STEP as TRACK_STEP
from twin_worker.telemetry.track import Track

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
        for start_t, speed, paths in self.pending:
            self._score_prediction(start_t, speed, paths, (t, positions))
        self.scored_t = float(t[-1])
        while self.pending and self.pending[0][0] + SCORE_AHEAD[-1] <= t[-1]:
            self.pending.popleft()

    def _score_prediction(
        self, start_t: float, speed: float, paths: dict[str, np.ndarray], flight: tuple[np.ndarray, np.ndarray]
    ) -> None:
        t, positions = flight
        times = start_t + SCORE_AHEAD[start_t + SCORE_AHEAD <= t[-1]]
        due = np.flatnonzero(times[1:] > self.scored_t)
        if not len(due) or start_t < t[0] or not paths:
            return
        right = np.clip(np.searchsorted(t, times), 0, len(t) - 1)
        time_gap = np.minimum(np.abs(t[right] - times), np.abs(t[np.maximum(right - 1, 0)] - times))
        if time_gap.max() > _MAX_GAP_S:
            return
        actual = interpolate_rows(times, t, positions)
        length = path_length(actual, speed)
        errors = np.stack([path[1 : len(times)] for path in paths.values()]) - actual[1:]  # (methods, k, 3)
        relative = np.sqrt(np.einsum("mki,mki->mk", errors, errors))[:, due] / length[1:][due]
        priors = np.stack([_LOG_PRIOR[method][due] for method in paths])
        log_ratios = (np.log(np.maximum(relative, _MIN_ERROR)) - priors).mean(axis=1).tolist()
        for method, log_ratio in zip(paths, log_ratios, strict=True):
            self._update(method, log_ratio, len(due) / len(SCORE_AHEAD[1:]))

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


STEP = 0.5  # filter step [s]
_FILTER_STEPS = 24  # past steps that the filter uses
_TURN_RATE = 0.3  # turn rate of the two turning models [rad/s]
_MAX_SPEED = 1e3  # faster rows are invalid [m/s]
# transition probabilities per step
_MODEL_TRANSITION = np.array([[0.97, 0.015, 0.015], [0.06, 0.93, 0.01], [0.06, 0.01, 0.93]])


def _transition(rate: float) -> np.ndarray:
    """Return the transition matrix of p_n, v_n, p_e, v_e at one turn rate [rad/s]."""
    if rate == 0.0:
        block = np.array([[1.0, STEP], [0.0, 1.0]])
        return np.kron(np.eye(2), block)
    s, c = sin(rate * STEP), cos(rate * STEP)
    return np.array(
        [
            [1, s / rate, 0, -(1 - c) / rate],
            [0, c, 0, -s],
            [0, (1 - c) / rate, 1, s / rate],
            [0, s, 0, c],
        ]
    )


class _TurnFilter(KalmanFilter):  # type: ignore[misc]
    """Kalman filter whose likelihood costs no decomposition: `update` has inverted the innovation covariance."""

    @property
    def log_likelihood(self) -> float:
        """Return the logarithm of the density of the last innovation."""
        _, log_det = np.linalg.slogdet(2.0 * np.pi * self.S)
        return float(-0.5 * (log_det + self.y @ self.SI @ self.y))


def _filter(rate: float, noise: float, start: np.ndarray) -> KalmanFilter:
    filt = _TurnFilter(dim_x=4, dim_z=4)
    q = np.array([[STEP**4 / 4, STEP**3 / 2], [STEP**3 / 2, STEP**2]])
    filt.F, filt.H, filt.R = _transition(rate), np.eye(4), np.diag([0.5, 0.05, 0.5, 0.05])
    filt.Q, filt.x, filt.P = np.kron(np.eye(2), q) * noise, start.copy(), np.eye(4)
    return filt


def constant_turn_prediction(track: Track, ahead: np.ndarray) -> np.ndarray | None:
    """Predict from the end of a track, NED, (k, 3) [m]; None with fewer than four gap-free steps.

    A clock jump puts rows of two times on one grid; rows before the last jump are ignored.

    Args:
        track: newest flight
        ahead: requested look-ahead times, (k,) [s]
    """
    stride = round(STEP / TRACK_STEP)
    unbroken = track.unbroken_tail()
    rows = slice((len(unbroken) - 1) % stride, None, stride)
    p, v = _after_jump(unbroken.p[rows][-_FILTER_STEPS:], unbroken.v[rows][-_FILTER_STEPS:])
    return imm(p, v, ahead) if len(p) >= 4 else None


def _after_jump(p: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities, (n, 3), after the last implausible row; nan is implausible."""
    plausible = np.linalg.norm(v, axis=1) < _MAX_SPEED
    plausible[1:] &= np.linalg.norm(np.diff(p, axis=0), axis=1) < _MAX_SPEED * STEP
    jumps = np.flatnonzero(~plausible)
    first = int(jumps[-1]) if len(jumps) else 0
    # the row after a position jump is valid
    first += int(len(jumps) > 0 and not np.linalg.norm(v[first]) < _MAX_SPEED)
    return p[first:], v[first:]


def imm(p: np.ndarray, v: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Predict from recent positions and velocities.

    Args:
        p: recent positions every `STEP` seconds, NED, newest last, (n, 3) [m]
        v: recent velocities over ground, NED, (n, 3) [m/s]
        ahead: requested look-ahead times, (k,) [s]
    Returns:
        mean path, NED, (k, 3) [m]
    """
    return _mean_path(_estimate(p, v), p[-1, 2], v[-4:, 2].mean(), ahead)


def imm_with_variance(p: np.ndarray, v: np.ndarray, ahead: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the path of `imm` and the variance of its horizontal position, north plus east, (k,) [m2].

    Source: Bar-Shalom 2001, 11.6.6 (moments of the mixture).
    """
    estimator = _estimate(p, v)
    variance = _mixture_variance(estimator, int(np.ceil(ahead[-1] / STEP)))
    path = _mean_path(estimator, p[-1, 2], v[-4:, 2].mean(), ahead)
    return path, np.interp(ahead, STEP * np.arange(len(variance)), variance)


def _estimate(p: np.ndarray, v: np.ndarray) -> IMMEstimator:
    """Return the estimator after all rows."""
    rows = np.column_stack([p[:, 0], v[:, 0], p[:, 1], v[:, 1]])
    filters = [_filter(rate, noise, rows[0]) for rate, noise in ((0.0, 0.5), (_TURN_RATE, 1.0), (-_TURN_RATE, 1.0))]
    estimator = IMMEstimator(filters, np.array([0.8, 0.1, 0.1]), _MODEL_TRANSITION)
    for row in rows[1:]:
        estimator.predict()
        estimator.update(row)
    return estimator


def _mean_path(estimator: IMMEstimator, p_d: float, v_d: float, ahead: np.ndarray) -> np.ndarray:
    """Return the mean path from height `p_d` [m] and sink rate `v_d` [m/s] on, NED, (k, 3) [m]."""
    steps = int(np.ceil(ahead[-1] / STEP))
    track = _run_forward(estimator, steps)
    t = STEP * np.arange(steps + 1)
    climb = np.clip(v_d, -8.0, 8.0) * 6.0 * (1 - np.exp(-ahead / 6.0))  # the climb decays
    return np.column_stack([np.interp(ahead, t, track[:, 0]), np.interp(ahead, t, track[:, 1]), p_d + climb])


def _run_forward(estimator: IMMEstimator, steps: int) -> np.ndarray:
    """Propagate the mixed models without measurements; return the mean p_n, p_e, (steps + 1, 2) [m]."""
    mu = estimator.mu.copy()
    x = np.stack([filt.x for filt in estimator.filters])
    F = np.stack([filt.F for filt in estimator.filters])
    track = [mu @ x]
    for _ in range(steps):
        mixed = mu @ _MODEL_TRANSITION
        x = np.einsum("jab,jb->ja", F, (_MODEL_TRANSITION * mu[:, None]).T @ x / mixed[:, None])
        mu = mixed
        track.append(mu @ x)
    return np.array(track)[:, [0, 2]]


def _mixture_variance(estimator: IMMEstimator, steps: int) -> np.ndarray:
    """Return the variance of p_n plus that of p_e of the mixed models without measurements, (steps + 1,) [m2]."""
    mu = estimator.mu.copy()
    x, P, F, Q = (np.stack([getattr(filt, name) for filt in estimator.filters]) for name in ("x", "P", "F", "Q"))
    FT, out = F.transpose(0, 2, 1), np.empty(steps + 1)
    for k in range(steps + 1):
        out[k] = mu @ ((x - mu @ x)[:, [0, 2]] ** 2 + P[:, [0, 2], [0, 2]]).sum(axis=1)
        mixed = mu @ _MODEL_TRANSITION
        share = (_MODEL_TRANSITION * mu[:, None]).T / mixed[:, None]  # of each model in each mixed start
        start = share @ x
        offset = x[None] - start[:, None]
        spread = np.einsum("ji,jia,jib->jab", share, offset, offset)
        P = F @ (np.einsum("ji,iab->jab", share, P) + spread) @ FT + Q
        x, mu = np.einsum("jab,jb->ja", F, start), mixed
    return out
