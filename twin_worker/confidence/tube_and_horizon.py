"""How far a prediction may be trusted: tube and horizon from calibration tables and this aircraft's own past.

Covered means: at its look-ahead, the position lies within all three half-axes, along, cross and vertical, of the
predicted track. That box is never wider than the ellipsoid that holds as many. A look-ahead is answered as soon as
it has been flown; what was followed for a while without passing 10 % counts as that.

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
_GROUPS = 8  # groups whose levels are remembered
_ENDED = 60  # passages remembered per method
_RENEWED_EVERY_S = (
    5.38  # between continued rollouts that are scored: no multiple of usual periods, so all ages come [s]
)
_RENEWED_ROWS, _RENEWED_S = 48, 60.0  # of them remembered, and how far ahead they are scored [s]
_RIPE_S = 60.0  # predictions younger say nothing about medians yet: the early failures come first [s]


@dataclass(frozen=True)
class Made:
    """A prediction, before anything is said about trust.

    Attributes:
        t: look-ahead 0 [s since 1970]
        method, group: as in `Prediction`; calibration group, e.g. hybrid/arduplane/fixed_wing/known
        ahead: look-ahead of each point, (n,) [s]
        path: NED, (n, 3) [m]
        speed: over ground at t, climb included [m/s]
        spread: standard deviation of an ensemble along, cross, vertical, (n, 3) [m]; None without one
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
    """How far a prediction may be trusted.

    Attributes:
        tube: half-axes along, cross, vertical, (n, 3) [m]
        horizon_s: confidence horizon, from look-ahead 0 [s]
        horizon_open: still below 10 % at the last look-ahead
        sentence: which table it rests on, and how many of the aircraft's own predictions
        factor: how much wider than the table the tube is, by knot, (13,) [-]
        ratio: what the horizon was sought in, (n,) [-]
        alone: share of the errors that each half-axis alone holds [-]
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
    """Past predictions of one aircraft and what came of them."""

    tables: Tables = field(default_factory=load)
    passages: dict[str, deque[tuple[float, bool]]] = field(default_factory=dict)  # ended: time to 10 % [s], censored
    scored: dict[str, int] = field(default_factory=dict)  # predictions ended so far, by method
    latest: tuple[Made, Trust] | None = None
    _ledger: Ledger = field(default_factory=Ledger)
    _earlier: Earlier = field(default_factory=Earlier)
    _levels: dict[str, Levels] = field(default_factory=dict)
    _joined: tuple[tuple[str, float], Factors] | None = None
    _renewed: Ledger | None = None  # continued rollouts; none before the first
    _renewed_due: float = -np.inf  # the next of them is remembered from then on [s since 1970]

    def trust(self, made: Made) -> Trust:
        """Wrap a prediction in its tube and say up to when it stays within 10 %."""
        table, said = self.tables.choose(made.group)
        now = self._factors(made.group, table)
        revision = self._earlier.revised(made.t, made.ahead, made.path)
        half_axes = table.half_axes(doubt_of(made.spread, revision, made.method, made.ahead), made.ahead)
        length = path_length(made.path, made.speed, made.speed * float(made.ahead[0]))
        ratio = growth(half_axes, length)
        horizon, open_end = first_passage(now.horizon * ratio, made.ahead)
        own = f", adapted by {now.own} of its own" if now.own else ""
        own += "; at the bound of adaptation: the tube may hold fewer than it is meant to" if now.bounded else ""
        tube = now.at(made.ahead)[:, None] * half_axes
        return Trust(tube, horizon, open_end, said + own, now.tube, ratio, table.alone)

    def _factors(self, group: str, table: Table) -> Factors:
        """Return the factors in force, reckoned anew for every prediction that was kept."""
        key = group, self._ledger.newest
        if self._joined is None or self._joined[0] != key:
            levels = self._levels.get(group) or Levels()
            self._joined = key, factors(self._ledger, group, table, levels)
        return self._joined[1]

    def keep(self, made: Made, trust: Trust) -> None:
        """Remember a prediction for scoring, at most one every few seconds.

        Raises:
            ValueError: when its look-aheads are not the first of `AHEAD`; cut or sample it so.
        """
        self.latest = made, trust
        n = len(made.ahead)
        if not np.array_equal(made.ahead, AHEAD[:n]):
            raise ValueError(f"record: found {n} look-aheads up to {made.ahead[-1]:g} s, expected the first of AHEAD")
        if made.t < self._ledger.newest:  # the clock was set back: nothing of before can be answered
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
        """Remember a continued rollout for scoring, at most one every few seconds; it adapts nothing.

        Args:
            t: look-ahead 0 [s since 1970]
            method: as in `Prediction`
            path, tube: NED and half-axes over the first n of `AHEAD`, (n, 3) [m]
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
        """Follow no prediction beyond now: an event (mode, mission, clock) has made them meaningless.

        Args:
            moved: the origin of the local frame is another from now on
        """
        self._enter(self._ledger.end())
        for book in filter(None, (self._ledger, self._renewed)):
            book.end()
            if moved:
                book.restart()
        self._earlier.clear()

    def answer(self, t: np.ndarray, flown: np.ndarray) -> int:
        """Answer every look-ahead that has been flown by now.

        Args:
            t: times of the flown path, rising, from before `answered` on, (n,) [s since 1970]
            flown: positions in the twin's NED frame, (n, 3) [m]
        Returns:
            how many predictions came to their end
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
        """Enter what became of predictions that have ended."""
        for r in rows:
            method = self._ledger.method[r]
            self.scored[method] = self.scored.get(method, 0) + 1
            passage = float(self._ledger.followed[r]), not self._ledger.passed[r]
            self.passages.setdefault(method, deque(maxlen=_ENDED)).append(passage)

    @property
    def answered(self) -> float:
        """Give up to when predictions have been answered [s since 1970]."""
        return self._ledger.until

    @property
    def waits(self) -> bool:
        """Return whether any prediction waits for answers."""
        return bool(self._ledger.live.any()) or (self._renewed is not None and bool(self._renewed.live.any()))

    @property
    def waiting(self) -> tuple[float, ...]:
        """Return when the predictions that wait for answers were made [s since 1970]."""
        return tuple(self._ledger.t0[self._ledger.live].tolist())

    @property
    def held(self) -> tuple[float, int]:
        """Return measured share of look-aheads inside the tube so far (nan before any) and the predictions behind."""
        return self._ledger.coverage

    @property
    def coverage_renewed(self) -> tuple[float | None, int]:
        """Return the same of continued rollouts alone; None before any."""
        share, n = self._renewed.coverage if self._renewed is not None else (0.0, 0)
        return (share if n else None), n

    def t10(self, method: str) -> tuple[float | None, float | None, int]:
        """Return the median first passage of 10 % [s], the share still within, and how many predictions that is.

        Those still flown count by how long they have stayed within; the median of what never passed is the longest.
        """
        book = self._ledger
        ripe = book.live & (book.method == method) & (book.t0 <= book.until - _RIPE_S)
        found = [*self.passages.get(method, ())]
        found += [(float(book.followed[r]), not book.passed[r]) for r in np.flatnonzero(ripe)]
        if not found:
            return None, None, 0
        return median_passage(found), float(np.mean([censored for _, censored in found])), len(found)
