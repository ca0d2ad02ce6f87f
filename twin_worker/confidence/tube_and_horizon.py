"""Prediction region (tube) and confidence horizon from calibration tables and past predictions.

A position is covered if it lies within all three half-axes (along, cross, vertical) of the predicted track at its
look-ahead. This box is never wider than the ellipsoid of the same coverage. A look-ahead is scored as soon as it has
been flown. A prediction that ends before it exceeds 10 % is a censored observation.

M1, the relative error: |p_hat - p| / max(path flown, 2 s of ground speed).
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline

from twin_worker.confidence.adaptive_conformal import AdaptiveLevels, ScaleFactors, scale_factors
from twin_worker.confidence.calibration_table import INDEPENDENT, CalibrationTable, uncertainty_features
from twin_worker.confidence.prediction_log import EVERY_S, PredictionLog
from twin_worker.confidence.table_files import TableSet, load
from twin_worker.confidence.weighted_quantile import median_passage, running_max_error_ratio
from twin_worker.numerics.prediction_errors import (
    AHEAD,
    ERROR_LIMIT,
    NOMINAL_COVERAGE,
    along_cross_down,
    axes_error,
    first_passage,
    path_length,
    track_frame,
)

_MIN_AGE_S, _MAX_AGE_S = 4.0, 21.0  # age of the predictions used [s]
_MEMBERS = 3  # predictions stored


@dataclass(eq=False)
class LaggedForecasts:
    """The last few predictions of one aircraft, as curves over time."""

    _members: deque[tuple[float, float, CubicSpline]] = field(default_factory=lambda: deque(maxlen=_MEMBERS))

    def add(self, t: float, ahead: np.ndarray, path: np.ndarray) -> None:
        """Store a prediction made at `t` [s since 1970], path (n, 3) [m] at look-aheads (n,) [s]."""
        self._members.append((t, t + float(ahead[-1]), CubicSpline(ahead, path)))

    def clear(self) -> None:
        """Delete all predictions, as after an event that invalidates them."""
        self._members.clear()

    def revision(self, t: float, ahead: np.ndarray, path: np.ndarray) -> np.ndarray | None:
        """Return the root mean square departure along, cross, vertical, (n, 3) [m]; None without earlier predictions.

        Beyond the end of an earlier prediction its last departure is used.
        """
        members = [
            member
            for member in self._members
            if _MIN_AGE_S <= t - member[0] <= _MAX_AGE_S and ahead[0] <= member[1] - t
        ]
        if not members:
            return None
        departures = np.empty((len(members), *path.shape))
        for departure, (made_t, end, curve) in zip(departures, members, strict=True):
            n = int(np.searchsorted(ahead, end - t, side="right"))
            departure[:n] = curve(ahead[:n] + (t - made_t)) - path[:n]
            departure[n:] = departure[n - 1]
        return np.sqrt(np.mean(along_cross_down(track_frame(path, ahead), departures) ** 2, axis=0))


__all__ = [
    "AHEAD",
    "ERROR_LIMIT",
    "EVERY_S",
    "NOMINAL_COVERAGE",
    "Confidence",
    "ConfidenceTracker",
    "PointForecast",
    "axes_error",
    "first_passage",
    "path_length",
    "track_frame",
]
EARLY_S = 10.0  # look-ahead of `Confidence.early_exceedance` [s]
_GROUPS = 8  # groups whose levels are stored
_PASSAGES = 60  # passages stored per method
_EXTRAPOLATED_EVERY_S = (
    5.38  # between extrapolated rollouts that are scored: no multiple of usual periods, so all ages occur [s]
)
_EXTRAPOLATED_ROWS, _EXTRAPOLATED_S = 48, 60.0  # extrapolated rollouts stored, longest look-ahead that is scored [s]
_MIN_FOLLOWUP_S = 60.0  # younger predictions would bias the median: early failures are observed first [s]


@dataclass(frozen=True)
class PointForecast:
    """A prediction without prediction region and horizon.

    Attributes:
        t: look-ahead 0 [s since 1970]
        method, group: as in `Prediction`; calibration group, e.g. hybrid/arduplane/fixed_wing/known
        ahead: look-ahead of each point, (n,) [s]
        path: NED, (n, 3) [m]
        speed: over ground at t, climb included [m/s]
        spread: standard deviation of an ensemble along, cross, vertical, (n, 3) [m]; None without an ensemble
    """

    t: float
    method: str
    group: str
    ahead: np.ndarray
    path: np.ndarray
    speed: float
    spread: np.ndarray | None = None


@dataclass(frozen=True)
class Confidence:
    """Prediction region and confidence horizon of a prediction.

    Attributes:
        tube: half-axes along, cross, vertical, (n, 3) [m]
        horizon_s: confidence horizon, from look-ahead 0 [s]
        horizon_open: the horizon is not reached at the last look-ahead
        sentence: calibration table used, and number of own predictions behind the adaptation
        factor: half-axes of the tube over those of the table, by knot and axis, (13, 3) [-]
        ratio: running maximum of half-axes over predicted path length, (n,) [-]
        axis_quantile: coverage of each half-axis by itself [-]
        early_exceedance: probability that the error exceeds 10 % within `EARLY_S` [-]
    """

    tube: np.ndarray
    horizon_s: float
    horizon_open: bool
    sentence: str
    factor: np.ndarray
    ratio: np.ndarray
    axis_quantile: float = INDEPENDENT
    early_exceedance: float = 0.0


@dataclass
class ConfidenceTracker:
    """Past predictions of one aircraft and their scores."""

    tables: TableSet = field(default_factory=load)
    passages: dict[str, deque[tuple[float, bool]]] = field(default_factory=dict)  # ended: time to 10 % [s], censored
    scored: dict[str, int] = field(default_factory=dict)  # predictions ended so far, by method
    latest: tuple[PointForecast, Confidence] | None = None
    _log: PredictionLog = field(default_factory=PredictionLog)
    _lagged: LaggedForecasts = field(default_factory=LaggedForecasts)
    _levels: dict[str, AdaptiveLevels] = field(default_factory=dict)
    _cached_factors: tuple[tuple[str, float], ScaleFactors] | None = None
    _extrapolated: PredictionLog | None = None  # extrapolated rollouts; None before the first
    _extrapolated_due: float = -np.inf  # earliest time of the next one [s since 1970]

    def confidence_of(self, forecast: PointForecast) -> Confidence:
        """Compute the tube of a prediction and the horizon up to which it stays within 10 %."""
        table, description = self.tables.choose(forecast.group)
        scale = self._factors(forecast.group, table)
        revision = self._lagged.revision(forecast.t, forecast.ahead, forecast.path)
        half_axes = table.half_axes(
            uncertainty_features(forecast.spread, revision, forecast.path, forecast.method, forecast.ahead),
            forecast.ahead,
        )
        length = path_length(forecast.path, forecast.speed, forecast.speed * float(forecast.ahead[0]))
        ratio = running_max_error_ratio(half_axes, length)
        horizon, horizon_open = first_passage(scale.horizon * ratio, forecast.ahead)
        adaptation = f", adapted to {scale.own_count} own predictions" if scale.own_count else ""
        adaptation += "; adaptation is at its bound: coverage may be below the target" if scale.bounded else ""
        tube = scale.at(forecast.ahead) * half_axes
        early = scale.exceedance(float(np.interp(EARLY_S, forecast.ahead - forecast.ahead[0], ratio)))
        sentence = description + adaptation
        return Confidence(tube, horizon, horizon_open, sentence, scale.tube, ratio, table.alone, early)

    def _factors(self, group: str, table: CalibrationTable) -> ScaleFactors:
        """Return the scale factors, recomputed after every prediction that was added."""
        cache_key = group, self._log.newest_t
        if self._cached_factors is None or self._cached_factors[0] != cache_key:
            levels = self._levels.get(group) or AdaptiveLevels()
            self._cached_factors = cache_key, scale_factors(self._log, group, table, levels)
        return self._cached_factors[1]

    def add(self, forecast: PointForecast, confidence: Confidence) -> None:
        """Store a prediction for scoring, at most one every few seconds.

        Raises:
            ValueError: when its look-aheads are not the first n of `AHEAD`; resample it.
        """
        self.latest = forecast, confidence
        n = len(forecast.ahead)
        if not np.array_equal(forecast.ahead, AHEAD[:n]):
            raise ValueError(
                f"prediction: found {n} look-aheads up to {forecast.ahead[-1]:g} s, expected the first {n} of AHEAD; "
                "resample it"
            )
        if forecast.t < self._log.newest_t:  # the clock was set back: earlier predictions cannot be scored
            self.censor_open()
            self._log, self._extrapolated = PredictionLog(), None
        if forecast.t - self._log.newest_t < EVERY_S or n < 2:
            return
        self._lagged.add(forecast.t, forecast.ahead, forecast.path)
        log = self._log
        row = log.add(forecast.t, forecast.method, forecast.group, forecast.path, forecast.speed)
        log.tube[row, :n], log.factor[row], log.horizon[row] = confidence.tube, confidence.factor, confidence.horizon_s
        log.ratio[row], log.ratio[row, :n] = confidence.ratio[-1], confidence.ratio

    def add_extrapolated(self, t: float, method: str, path: np.ndarray, tube: np.ndarray) -> None:
        """Store an extrapolated rollout for scoring, at most one every few seconds; it does not affect adaptation.

        Args:
            t: look-ahead 0 [s since 1970]
            method: as in `Prediction`
            path, tube: NED positions and half-axes over the first n of `AHEAD`, (n, 3) [m]
        """
        if self._extrapolated is None or t < self._extrapolated.newest_t:
            self._extrapolated, self._extrapolated_due = (
                PredictionLog(_EXTRAPOLATED_ROWS, int(AHEAD.searchsorted(_EXTRAPOLATED_S)) + 1),
                t,
            )
        log = self._extrapolated
        n = min(len(path), log.score.shape[1])
        if t < self._extrapolated_due or n < 2:
            return
        self._extrapolated_due = max(self._extrapolated_due, t - _EXTRAPOLATED_EVERY_S) + _EXTRAPOLATED_EVERY_S
        row = log.add(t, method, "", path[:n], 0.0)
        log.tube[row, :n] = tube[:n]

    def censor_open(self, *, frame_changed: bool = False) -> None:
        """Censor every open prediction: an event (mode, mission, clock) has invalidated them.

        Args:
            frame_changed: the origin of the local frame has changed
        """
        self._record_passages(self._log.censor_open())
        for log in filter(None, (self._log, self._extrapolated)):
            log.censor_open()
            if frame_changed:
                log.reset_odometer()
        self._lagged.clear()

    def evaluate(self, t: np.ndarray, positions: np.ndarray) -> int:
        """Score every look-ahead that has been flown.

        Args:
            t: times of the flown path, rising, from before `evaluated_until` on, (n,) [s since 1970]
            positions: flown positions in the twin's NED frame, (n, 3) [m]
        Returns:
            number of predictions that ended
        """
        if len(t) < 2:
            return 0
        live = self._log.live.copy()
        rows, columns = self._log.evaluate(t, positions)
        if self._extrapolated is not None:
            self._extrapolated.evaluate(t, positions)
        for group in set(self._log.group[rows].tolist()):
            if group not in self._levels and len(self._levels) >= _GROUPS:
                del self._levels[next(iter(self._levels))]
            self._levels.setdefault(group, AdaptiveLevels()).update(self._log, rows, columns, self._log.group == group)
        ended = np.flatnonzero(live & ~self._log.live)
        self._record_passages(ended)
        return len(ended)

    def _record_passages(self, rows: np.ndarray) -> None:
        """Store the first passages of predictions that have ended."""
        for row in rows:
            method = self._log.method[row]
            self.scored[method] = self.scored.get(method, 0) + 1
            passage = float(self._log.followed[row]), not self._log.exceeded[row]
            self.passages.setdefault(method, deque(maxlen=_PASSAGES)).append(passage)

    @property
    def evaluated_until(self) -> float:
        """Return the time up to which predictions have been scored [s since 1970]."""
        return self._log.evaluated_until

    @property
    def has_open(self) -> bool:
        """Return whether any prediction is not yet fully scored."""
        return bool(self._log.live.any()) or (self._extrapolated is not None and bool(self._extrapolated.live.any()))

    @property
    def open_start_times(self) -> tuple[float, ...]:
        """Return the start times of the predictions that are not yet fully scored [s since 1970]."""
        return tuple(self._log.t0[self._log.live].tolist())

    @property
    def coverage(self) -> tuple[float, int]:
        """Return the empirical coverage (nan before any score) and the number of predictions behind it."""
        return self._log.coverage

    @property
    def extrapolated_coverage(self) -> tuple[float | None, int]:
        """Return the empirical coverage of extrapolated rollouts (None before any score) and their number."""
        share, n = self._extrapolated.coverage if self._extrapolated is not None else (0.0, 0)
        return (share if n else None), n

    def t10(self, method: str) -> tuple[float | None, float | None, int]:
        """Return the median first passage of 10 % [s], the censored share, and the number of predictions.

        Open predictions count as censored at their present age. Where fewer than half have passed, the median is the
        longest time that any prediction was followed.
        """
        log = self._log
        mature = log.live & (log.method == method) & (log.t0 <= log.evaluated_until - _MIN_FOLLOWUP_S)
        passages = [*self.passages.get(method, ())]
        passages += [(float(log.followed[r]), not log.exceeded[r]) for r in np.flatnonzero(mature)]
        if not passages:
            return None, None, 0
        return median_passage(passages), float(np.mean([censored for _, censored in passages])), len(passages)
