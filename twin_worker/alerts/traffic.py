"""Conflict alerts: each pair is assessed once, by the worker that owns the aircraft with the lower id."""

from dataclasses import dataclass, field
from math import inf, isfinite

import numpy as np

from fleet.contract import Alert, AlertKind, Message, Prediction
from twin_worker.alerts.conflict_probability import Separation, chance, screen
from twin_worker.alerts.gaussian_forecast import DRAWS, STEP, Forecast
from twin_worker.alerts.hysteresis import Finding, Ledger
from twin_worker.alerts.traffic_picture import Board

_EVERY_S = 1.0  # between assessments of one aircraft's pairs [s]
_STALE_S = 10.0  # maximum age of a prediction [s]
_SLIGHT = 0.02  # lower probabilities are ignored [-]
_KEPT = "no conflict with uav-{} predicted"


@dataclass
class Traffic:
    """Predictions of all aircraft, and conflicts of the owned aircraft."""

    separation: Separation = field(default_factory=Separation)
    board: Board = field(default_factory=Board)
    _ledgers: dict[int, Ledger] = field(default_factory=dict)
    _judged: dict[int, float] = field(default_factory=dict)  # time of the last assessment, by UAV [s since 1970]

    def hear(self, made: Prediction) -> None:
        """Store the newest prediction of any aircraft."""
        self.board.hear(made)

    def after(self, uav: int, now: float, results: list[Message]) -> list[Message]:
        """Process the results of an owned twin at data time `now`; return them and the conflict alerts that follow."""
        for result in results:
            if isinstance(result, Prediction):
                self.hear(result)
        return [*results, *self.judge(uav, now)]

    def judge(self, uav: int, now: float) -> list[Alert]:
        """Assess one owned aircraft against all with a higher id, at most once a second of data time `now`."""
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
        """Take over the alert state of a newly owned aircraft from another worker."""
        self._ledgers[uav] = conflicts

    def show(self, uav: int) -> Ledger:
        """Return the alert state of an aircraft."""
        return self._ledgers.get(uav) or Ledger()

    def forget(self, uav: int) -> None:
        """Delete the alert state of an aircraft that is no longer owned."""
        self._judged.pop(uav, None)
        self._ledgers.pop(uav, None)

    def active(self, uav: int) -> list[Alert]:
        """Return the active conflict alerts of one owned aircraft."""
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
