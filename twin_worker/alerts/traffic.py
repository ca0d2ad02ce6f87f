"""Conflict alerts: traffic picture from all predictions; each pair is assessed once, by the owner of the lower id."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from math import inf, isfinite
from typing import NamedTuple

import numpy as np

from fleet.contract import Alert, AlertKind, Message, Prediction
from fleet.frames import Origin, to_geodetic, to_ned
from twin_worker.alerts.conflict_probability import Separation, conflict_probability, screen
from twin_worker.alerts.gaussian_forecast import DRAWS, MAX_AHEAD_S, STEP, GaussianForecast, to_gaussian
from twin_worker.alerts.hysteresis import AlertState, HazardEstimate

_ROWS = int(MAX_AHEAD_S / STEP) + 1
_MAX_AIRCRAFT = 4_096  # maximum number of aircraft; a bound against hostile input
_MIN_PERIOD_S = 2.0  # minimum period between stored predictions of one aircraft; paths change little within it [s]
STALE_S = 10.0  # maximum age of a prediction [s]
_MIN_PROBABILITY = 0.02  # lower probabilities are ignored [-]
_CORNER = np.array([1e4, 1e4, -1e4])  # point whose image determines the scale from one NED frame to another [m]


class Encounter(NamedTuple):
    """Possible conflict of two aircraft: the other, its probability, and the closest approach of the mean paths."""

    other: int  # UAV id
    probability: float  # of a loss of separation, 0..1
    t: float  # of the closest approach [s since 1970]
    horizontal: float  # distance then [m]
    vertical: float  # difference of height then [m]


class TrafficPicture:
    """Predictions in slots, one per UAV; a slot is rewritten at the first assessment after a new prediction.

    Args:
        capacity: largest number of aircraft
    """

    def __init__(self, capacity: int = _MAX_AIRCRAFT) -> None:
        self._capacity = capacity
        self._slots: dict[int, int] = {}  # slot by UAV id
        self._pending: dict[int, Prediction] = {}  # received, not yet in a slot
        self._newest_t: dict[int, float] = {}  # time of the newest prediction [s since 1970]
        self._forecasts: list[GaussianForecast | None] = [None] * capacity
        # one row per slot; the operating system provides memory only for rows in use
        self.first = np.zeros(capacity, np.int64)
        self.rows = np.zeros(capacity, np.int64)
        self.path = np.zeros((capacity, _ROWS, 3))
        self.covariance = np.zeros((capacity, _ROWS, 4))
        self.uav = np.zeros(capacity, np.int64)
        self.t = np.zeros(capacity)  # time of the prediction [s since 1970]
        self.origin = np.zeros((capacity, 3))  # [1e-7 deg, 1e-7 deg, mm]
        self.corner = np.zeros((capacity, 3))  # geodetic position of `_CORNER`, same units

    def receive(self, prediction: Prediction) -> None:
        """Store the newest prediction of an aircraft; thread-safe."""
        newest = self._newest_t.get(prediction.uav, -inf)
        if newest < prediction.t < newest + _MIN_PERIOD_S:
            return
        if prediction.uav in self._slots or len(self._slots) + len(self._pending) < self._capacity:
            self._newest_t[prediction.uav], self._pending[prediction.uav] = prediction.t, prediction

    def update_slots(self) -> None:
        """Write pending predictions to their slots; an invalid prediction empties its slot."""
        while self._pending:
            uav, prediction = self._pending.popitem()
            self._write_slot(uav, prediction.t, to_gaussian(prediction))

    def place(self, forecast: GaussianForecast) -> None:
        """Write a forecast to the slot of its aircraft."""
        self._write_slot(forecast.prediction.uav, forecast.prediction.t, forecast)

    def _write_slot(self, uav: int, t: float, forecast: GaussianForecast | None) -> None:
        if uav not in self._slots and len(self._slots) >= self._capacity:
            return
        slot = self._slots.setdefault(uav, len(self._slots))
        self._forecasts[slot], self.uav[slot], self.rows[slot] = forecast, uav, 0
        self.t[slot] = t if np.isfinite(t) else -np.inf
        if forecast is None:
            return
        n, origin = len(forecast.path), forecast.prediction.origin
        self.first[slot], self.rows[slot] = forecast.first, n
        self.path[slot, :n], self.covariance[slot, :n] = forecast.path, forecast.covariance()
        if origin != tuple(self.origin[slot]):
            self.origin[slot] = origin
            self.corner[slot] = to_geodetic(forecast.prediction.ned_origin(), _CORNER)

    def forecasts(self, now: float) -> list[GaussianForecast]:
        """Return the valid recent forecasts of all aircraft at data time `now` [s since 1970]."""
        valid = [forecast for forecast in tuple(self._forecasts[: len(self._slots)]) if forecast is not None]
        return [forecast for forecast in valid if abs(forecast.prediction.t - now) <= STALE_S]

    def slot_of(self, uav: int) -> tuple[int, GaussianForecast] | None:
        """Return slot and forecast of one aircraft; None without a valid prediction."""
        slot = self._slots.get(uav)
        forecast = None if slot is None else self._forecasts[slot]
        return None if slot is None or forecast is None else (slot, forecast)

    def others(self, slot: int, now: float, *, higher_only: bool) -> np.ndarray:
        """Return the slots of other aircraft, or of those with a higher id, with a recent prediction at `now`, (m,)."""
        n = len(self._slots)
        other = self.uav[:n] > self.uav[slot] if higher_only else self.uav[:n] != self.uav[slot]
        return np.flatnonzero(other & (self.rows[:n] > 0) & (np.abs(self.t[:n] - now) <= STALE_S))

    def frame_transform(self, slot: int, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return scale and shift from the others' NED frames to that of `slot`, (m, 3) each [-, m].

        Both frames are linear in latitude and longitude (`fleet.frames`), so two points determine the transform.
        """
        origin = Origin(*map(int, self.origin[slot]))
        shift = to_ned(origin, *self.origin[others].T)
        corner = to_ned(origin, *self.corner[others].T)
        return (corner - shift) / _CORNER, shift

    def encounters(
        self, uav: int, now: float, separation: Separation, *, higher_only: bool = False
    ) -> Iterable[Encounter]:
        """Yield the possible conflicts of one aircraft with all others, or with those of a higher id.

        Args:
            uav: the aircraft
            now: data time, to which predictions are recent [s since 1970]
            separation: separation minima
            higher_only: only with higher ids, so that each pair is assessed once
        """
        occupied = self.slot_of(uav)
        if occupied is None or abs(occupied[1].prediction.t - now) > STALE_S:
            return
        slot, others = occupied[0], self.others(occupied[0], now, higher_only=higher_only)
        if not len(others):
            return
        scale, shift = self.frame_transform(slot, others)
        approaches, limits = np.empty((len(others), 5)), np.array(separation, float)
        screen(slot, others, self.first, self.rows, self.path, self.covariance, scale, shift, limits, approaches)
        for j in np.flatnonzero(approaches[:, 0] >= 0):
            steps = np.arange(int(approaches[j, 0]), int(approaches[j, 1]) + 1)
            i, k = steps - self.first[slot], steps - self.first[others[j]]
            relative = self.path[others[j], k] * scale[j] + shift[j] - self.path[slot, i]
            covariance = self.covariance[slot, i] + self.covariance[others[j], k]
            probability = float(conflict_probability(relative, covariance, DRAWS, limits))
            if probability >= _MIN_PROBABILITY:
                t, horizontal, vertical = (float(x) for x in approaches[j, 2:])
                yield Encounter(int(self.uav[others[j]]), probability, t * STEP, horizontal, vertical)


_PERIOD_S = 1.0  # between assessments of one aircraft's pairs [s]
_CLEAR_TEXT = "no conflict with uav-{} predicted"


@dataclass
class TrafficMonitor:
    """Predictions of all aircraft, and conflicts of the owned aircraft."""

    separation: Separation = field(default_factory=Separation)
    picture: TrafficPicture = field(default_factory=TrafficPicture)
    _states: dict[int, AlertState] = field(default_factory=dict)
    _assessed_t: dict[int, float] = field(default_factory=dict)  # time of the last assessment, by UAV [s since 1970]

    def receive(self, prediction: Prediction) -> None:
        """Store the newest prediction of any aircraft."""
        self.picture.receive(prediction)

    def process_results(self, uav: int, now: float, results: list[Message]) -> list[Message]:
        """Process the results of an owned twin at data time `now`; return them and the conflict alerts that follow."""
        for result in results:
            if isinstance(result, Prediction):
                self.receive(result)
        return [*results, *self.assess(uav, now)]

    def assess(self, uav: int, now: float) -> list[Alert]:
        """Assess one owned aircraft against all with a higher id, at most once a second of data time `now`."""
        previous = self._assessed_t.get(uav, -inf)
        if previous <= now < previous + _PERIOD_S or not isfinite(now):
            return []
        self._assessed_t[uav] = now
        state = self._states.setdefault(uav, AlertState())
        hazards = {hazard.other: hazard for hazard in self._conflicts(uav, now)}
        for other in state.tracked_uavs(AlertKind.CONFLICT):
            hazards.setdefault(other, HazardEstimate(AlertKind.CONFLICT, 0.0, "", _CLEAR_TEXT.format(other), other))
        return [alert for finding in hazards.values() for alert in state.update(uav, now, finding)]

    def acquire(self, uav: int, conflicts: AlertState) -> None:
        """Take over the alert state of a newly owned aircraft from another worker."""
        self._states[uav] = conflicts

    def state_of(self, uav: int) -> AlertState:
        """Return the alert state of an aircraft."""
        return self._states.get(uav) or AlertState()

    def release(self, uav: int) -> None:
        """Delete the alert state of an aircraft that is no longer owned."""
        self._assessed_t.pop(uav, None)
        self._states.pop(uav, None)

    def active(self, uav: int) -> list[Alert]:
        """Return the active conflict alerts of one owned aircraft."""
        return self.state_of(uav).active

    def _conflicts(self, uav: int, now: float) -> list[HazardEstimate]:
        self.picture.update_slots()
        occupied = self.picture.slot_of(uav)
        if occupied is None:
            return []
        encounters = self.picture.encounters(uav, now, self.separation, higher_only=True)
        return [self._hazard(occupied[1], encounter) for encounter in encounters]

    def _hazard(self, forecast: GaussianForecast, encounter: Encounter) -> HazardEstimate:
        limit, other = self.separation, encounter.other
        message = (
            f"{encounter.probability:.0%} chance that it comes within {limit.horizontal:.0f} m and "
            f"{limit.vertical:.0f} m of height of "
            f"uav-{other} in {max(encounter.t - forecast.prediction.t, 0.0):.0f} s; mean paths come within "
            f"{encounter.horizontal:.0f} m and {encounter.vertical:.0f} m"
        )
        row = int(np.clip(round(encounter.t / STEP) - forecast.first, 0, len(forecast.path) - 1))
        return HazardEstimate(
            AlertKind.CONFLICT,
            encounter.probability,
            message,
            _CLEAR_TEXT.format(other),
            other,
            encounter.t,
            forecast.position(row),
        )
