"""Loss of separation: each pair is judged once, by whoever holds the aircraft with the lower id."""

from dataclasses import dataclass, field
from math import inf, isfinite

import numpy as np

from fleet.contract import Alert, AlertKind, Message, Prediction
from twin_worker.alerts.conflict_probability import Separation, chance, screen
from twin_worker.alerts.gaussian_forecast import DRAWS, STEP, Forecast
from twin_worker.alerts.hysteresis import Finding, Ledger
from twin_worker.alerts.traffic_picture import Board

_EVERY_S = 1.0  # between judgements of one aircraft's pairs [s]
_STALE_S = 10.0  # predictions older by more say nothing [s]
_SLIGHT = 0.02  # probabilities below are not followed up [-]
_KEPT = "separation from uav-{} is kept"


@dataclass
class Traffic:
    """The predictions of all aircraft, and the conflicts of those that are held here."""

    separation: Separation = field(default_factory=Separation)
    board: Board = field(default_factory=Board)
    _ledgers: dict[int, Ledger] = field(default_factory=dict)
    _judged: dict[int, float] = field(default_factory=dict)  # when, by UAV [s since 1970]

    def hear(self, made: Prediction) -> None:
        """Keep the newest prediction of an aircraft, held here or not."""
        self.board.hear(made)

    def after(self, uav: int, now: float, results: list[Message]) -> list[Message]:
        """Take what a held twin published up to data time `now`; return that, and what it means to its neighbours."""
        for result in results:
            if isinstance(result, Prediction):
                self.hear(result)
        return [*results, *self.judge(uav, now)]

    def judge(self, uav: int, now: float) -> list[Alert]:
        """Judge one held aircraft against all with a higher id, at most once a second of data time `now`."""
        last = self._judged.get(uav, -inf)
        if last <= now < last + _EVERY_S or not isfinite(now):
            return []
        self._judged[uav] = now
        ledger = self._ledgers.setdefault(uav, Ledger())
        found = {finding.other: finding for finding in self._meetings(uav, now)}
        for other in ledger.watched(AlertKind.CONFLICT):
            found.setdefault(other, Finding(AlertKind.CONFLICT, 0.0, "", _KEPT.format(other), other))
        return [alert for finding in found.values() for alert in ledger.judge(uav, now, finding)]

    def take(self, uav: int, conflicts: Ledger) -> None:
        """Go on with what another worker found of an aircraft that is held here from now on."""
        self._ledgers[uav] = conflicts

    def show(self, uav: int) -> Ledger:
        """Return what was found of an aircraft."""
        return self._ledgers.get(uav) or Ledger()

    def forget(self, uav: int) -> None:
        """Hold an aircraft no longer."""
        self._judged.pop(uav, None)
        self._ledgers.pop(uav, None)

    def active(self, uav: int) -> list[Alert]:
        """Return the conflicts of one held aircraft that are in force."""
        return self._ledgers[uav].active if uav in self._ledgers else []

    def _meetings(self, uav: int, now: float) -> list[Finding]:
        self.board.settle()
        held = self.board.of(uav)
        if held is None or abs(held[1].made.t - now) > _STALE_S:
            return []
        board, (slot, own) = self.board, held
        others = board.others(slot, now, _STALE_S)
        if not len(others):
            return []
        scale, shift = board.into(slot, others)
        met = np.empty((len(others), 5))
        limits = np.array(self.separation, float)
        screen(slot, others, board.first, board.rows, board.path, board.covariance, scale, shift, limits, met)
        findings = []
        for j in np.flatnonzero(met[:, 0] >= 0):
            p = self._chance(slot, int(others[j]), (scale[j], shift[j]), met[j])
            if p >= _SLIGHT:
                findings.append(self._finding(own, int(board.uav[others[j]]), p, met[j]))
        return findings

    def _chance(self, own: int, other: int, frame: tuple[np.ndarray, np.ndarray], met: np.ndarray) -> float:
        board, steps = self.board, np.arange(int(met[0]), int(met[1]) + 1)
        i, k = steps - board.first[own], steps - board.first[other]
        apart = board.path[other, k] * frame[0] + frame[1] - board.path[own, i]
        covariance = board.covariance[own, i] + board.covariance[other, k]
        return float(chance(apart, covariance, DRAWS, np.array(self.separation, float)))

    def _finding(self, own: Forecast, other: int, p: float, met: np.ndarray) -> Finding:
        at, wide, high = float(met[2]) * STEP, float(met[3]), float(met[4])
        limit = self.separation
        danger = (
            f"{p:.0%} chance that it comes within {limit.horizontal:.0f} m and {limit.vertical:.0f} m of height of "
            f"uav-{other} in {max(at - own.made.t, 0.0):.0f} s; mean paths come within {wide:.0f} m and {high:.0f} m"
        )
        place = own.place(int(np.clip(round(met[2]) - own.first, 0, len(own.path) - 1)))
        return Finding(AlertKind.CONFLICT, p, danger, _KEPT.format(other), other, at, place)
