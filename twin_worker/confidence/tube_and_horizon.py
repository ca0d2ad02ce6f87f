"""Prediction region (tube) and confidence horizon from calibration tables and the aircraft's own past predictions.

A position is covered if it lies within all three half-axes (along, cross, vertical) of the predicted track at its
look-ahead. This box is never wider than the ellipsoid of the same coverage. A look-ahead is scored as soon as it has
been flown. A prediction that ends before it exceeds 10 % is a censored observation.

M1, the relative error: |p_hat - p| / max(path flown, 2 s of ground speed).
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from twin_worker.confidence.adaptive_conformal import Factors, Levels, factors
from twin_worker.confidence.calibration_table import INDEPENDENT, Table, doubt_of
from twin_worker.confidence.horizon_risk import growth
from twin_worker.confidence.lagged_ensemble import Earlier
from twin_worker.confidence.prediction_log import EVERY_S, Ledger
from twin_worker.confidence.table_files import Tables, load
from twin_worker.confidence.weighted_quantile import median_passage
from twin_worker.numerics.prediction_errors import (
    AHEAD,
    LIMIT,
    QUANTILE,
    axes_error,
    first_passage,
    path_length,
    track_frame,
)

__all__ = [
    "AHEAD",
    "EVERY_S",
    "LIMIT",
    "QUANTILE",
    "Made",
    "Record",
    "Trust",
    "axes_error",
    "first_passage",
    "path_length",
    "track_frame",
]
_GROUPS = 8  # groups whose levels are stored
_ENDED = 60  # passages stored per method
_RENEWED_EVERY_S = (
    5.38  # between extrapolated rollouts that are scored: no multiple of usual periods, so all ages occur [s]
)
_RENEWED_ROWS, _RENEWED_S = 48, 60.0  # extrapolated rollouts stored, longest look-ahead that is scored [s]
_RIPE_S = 60.0  # younger predictions would bias the median: early failures are observed first [s]


@dataclass(frozen=True)
class Made:
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
class Trust:
    """Prediction region and confidence horizon of a prediction.

    Attributes:
        tube: half-axes along, cross, vertical, (n, 3) [m]
        horizon_s: confidence horizon, from look-ahead 0 [s]
        horizon_open: the horizon is not reached at the last look-ahead
        sentence: calibration table used, and number of own predictions behind the adaptation
        factor: half-axes of the tube over those of the table, by knot, (13,) [-]
        ratio: running maximum of half-axes over predicted path length, (n,) [-]
        axis_quantile: coverage of each half-axis by itself [-]
    """

    tube: np.ndarray
    horizon_s: float
    horizon_open: bool
    sentence: str
    factor: np.ndarray
    ratio: np.ndarray
    alone: float = INDEPENDENT


@dataclass
class Record:
    """Past predictions of one aircraft and their scores."""

    tables: Tables = field(default_factory=load)
    passages: dict[str, deque[tuple[float, bool]]] = field(default_factory=dict)  # ended: time to 10 % [s], censored
    scored: dict[str, int] = field(default_factory=dict)  # predictions ended so far, by method
    latest: tuple[Made, Trust] | None = None
    _ledger: Ledger = field(default_factory=Ledger)
    _earlier: Earlier = field(default_factory=Earlier)
    _levels: dict[str, Levels] = field(default_factory=dict)
    _joined: tuple[tuple[str, float], Factors] | None = None
    _renewed: Ledger | None = None  # extrapolated rollouts; None before the first
    _renewed_due: float = -np.inf  # earliest time of the next one [s since 1970]

    def trust(self, made: Made) -> Trust:
        """Compute the tube of a prediction and the horizon up to which it stays within 10 %."""
        table, said = self.tables.choose(made.group)
        now = self._factors(made.group, table)
        revision = self._earlier.revised(made.t, made.ahead, made.path)
        half_axes = table.half_axes(doubt_of(made.spread, revision, made.method, made.ahead), made.ahead)
        length = path_length(made.path, made.speed, made.speed * float(made.ahead[0]))
        ratio = growth(half_axes, length)
        horizon, open_end = first_passage(now.horizon * ratio, made.ahead)
        own = f", adapted to {now.own} own predictions" if now.own else ""
        own += "; adaptation is at its bound: coverage may be below the target" if now.bounded else ""
        tube = now.at(made.ahead)[:, None] * half_axes
        return Trust(tube, horizon, open_end, said + own, now.tube, ratio, table.alone)

    def _factors(self, group: str, table: Table) -> Factors:
        """Return the scale factors, recomputed after every prediction that was added."""
        key = group, self._ledger.newest
        if self._joined is None or self._joined[0] != key:
            levels = self._levels.get(group) or Levels()
            self._joined = key, factors(self._ledger, group, table, levels)
        return self._joined[1]

    def keep(self, made: Made, trust: Trust) -> None:
        """Store a prediction for scoring, at most one every few seconds.

        Raises:
            ValueError: when its look-aheads are not the first n of `AHEAD`; resample it.
        """
        self.latest = made, trust
        n = len(made.ahead)
        if not np.array_equal(made.ahead, AHEAD[:n]):
            raise ValueError(
                f"prediction: found {n} look-aheads up to {made.ahead[-1]:g} s, expected the first {n} of AHEAD; "
                "resample it"
            )
        if made.t < self._ledger.newest:  # the clock was set back: earlier predictions cannot be scored
            self.forget()
            self._ledger, self._renewed = Ledger(), None
        if made.t - self._ledger.newest < EVERY_S or n < 2:
            return
        self._earlier.add(made.t, made.ahead, made.path)
        book = self._ledger
        r = book.add(made.t, made.method, made.group, made.path, made.speed)
        book.tube[r, :n], book.factor[r], book.horizon[r] = trust.tube, trust.factor, trust.horizon_s
        book.ratio[r], book.ratio[r, :n] = trust.ratio[-1], trust.ratio

    def keep_renewed(self, t: float, method: str, path: np.ndarray, tube: np.ndarray) -> None:
        """Store an extrapolated rollout for scoring, at most one every few seconds; it does not affect adaptation.

        Args:
            t: look-ahead 0 [s since 1970]
            method: as in `Prediction`
            path, tube: NED positions and half-axes over the first n of `AHEAD`, (n, 3) [m]
        """
        if self._renewed is None or t < self._renewed.newest:
            self._renewed, self._renewed_due = Ledger(_RENEWED_ROWS, int(AHEAD.searchsorted(_RENEWED_S)) + 1), t
        book = self._renewed
        n = min(len(path), book.score.shape[1])
        if t < self._renewed_due or n < 2:
            return
        self._renewed_due = max(self._renewed_due, t - _RENEWED_EVERY_S) + _RENEWED_EVERY_S
        r = book.add(t, method, "", path[:n], 0.0)
        book.tube[r, :n] = tube[:n]

    def forget(self, *, moved: bool = False) -> None:
        """Censor every open prediction: an event (mode, mission, clock) has invalidated them.

        Args:
            frame_changed: the origin of the local frame has changed
        """
        self._enter(self._ledger.end())
        for book in filter(None, (self._ledger, self._renewed)):
            book.end()
            if moved:
                book.restart()
        self._earlier.clear()

    def answer(self, t: np.ndarray, flown: np.ndarray) -> int:
        """Score every look-ahead that has been flown.

        Args:
            t: times of the flown path, rising, from before `evaluated_until` on, (n,) [s since 1970]
            positions: flown positions in the twin's NED frame, (n, 3) [m]
        Returns:
            number of predictions that ended
        """
        if len(t) < 2:
            return 0
        live = self._ledger.live.copy()
        r, j = self._ledger.answer(t, flown)
        if self._renewed is not None:
            self._renewed.answer(t, flown)
        for group in set(self._ledger.group[r].tolist()):
            if group not in self._levels and len(self._levels) >= _GROUPS:
                del self._levels[next(iter(self._levels))]
            self._levels.setdefault(group, Levels()).learn(self._ledger, r, j, self._ledger.group == group)
        ended = np.flatnonzero(live & ~self._ledger.live)
        self._enter(ended)
        return len(ended)

    def _enter(self, rows: np.ndarray) -> None:
        """Store the first passages of predictions that have ended."""
        for r in rows:
            method = self._ledger.method[r]
            self.scored[method] = self.scored.get(method, 0) + 1
            passage = float(self._ledger.followed[r]), not self._ledger.passed[r]
            self.passages.setdefault(method, deque(maxlen=_ENDED)).append(passage)

    @property
    def answered(self) -> float:
        """Return the time up to which predictions have been scored [s since 1970]."""
        return self._ledger.until

    @property
    def waits(self) -> bool:
        """Return whether any prediction is not yet fully scored."""
        return bool(self._ledger.live.any()) or (self._renewed is not None and bool(self._renewed.live.any()))

    @property
    def waiting(self) -> tuple[float, ...]:
        """Return the start times of the predictions that are not yet fully scored [s since 1970]."""
        return tuple(self._ledger.t0[self._ledger.live].tolist())

    @property
    def held(self) -> tuple[float, int]:
        """Return the empirical coverage (nan before any score) and the number of predictions behind it."""
        return self._ledger.coverage

    @property
    def coverage_renewed(self) -> tuple[float | None, int]:
        """Return the empirical coverage of extrapolated rollouts (None before any score) and their number."""
        share, n = self._renewed.coverage if self._renewed is not None else (0.0, 0)
        return (share if n else None), n

    def t10(self, method: str) -> tuple[float | None, float | None, int]:
        """Return the median first passage of 10 % [s], the censored share, and the number of predictions.

        Open predictions count as censored at their present age. Where fewer than half have passed, the median is the
        longest time that any prediction was followed.
        """
        book = self._ledger
        ripe = book.live & (book.method == method) & (book.t0 <= book.until - _RIPE_S)
        found = [*self.passages.get(method, ())]
        found += [(float(book.followed[r]), not book.passed[r]) for r in np.flatnonzero(ripe)]
        if not found:
            return None, None, 0
        return median_passage(found), float(np.mean([censored for _, censored in found])), len(found)
