"""Conflict alerts: traffic picture from all predictions; each pair is assessed once, by the owner of the lower id."""

from dataclasses import dataclass, field
from math import inf, isfinite

import numpy as np

from fleet.contract import Alert, AlertKind, Message, Prediction
from fleet.frames import Origin, to_geodetic, to_ned
from twin_worker.alerts.conflict_probability import Separation, conflict_probability, screen
from twin_worker.alerts.gaussian_forecast import DRAWS, MAX_AHEAD_S, STEP, GaussianForecast, to_gaussian
from twin_worker.alerts.hysteresis import AlertState, HazardEstimate

_ROWS = int(MAX_AHEAD_S / STEP) + 1
_MAX_AIRCRAFT = 4_096  # maximum number of aircraft; a bound against hostile input
_MIN_PERIOD_S = 2.0  # minimum period between stored predictions of one aircraft; paths change little within it [s]
_CORNER = np.array([1e4, 1e4, -1e4])  # point whose image determines the scale from one NED frame to another [m]


class TrafficPicture:
    """Predictions in slots, one per UAV; a slot is rewritten at the first assessment after a new prediction."""

    def __init__(self) -> None:
        self._slots: dict[int, int] = {}  # slot by UAV id
        self._pending: dict[int, Prediction] = {}  # received, not yet in a slot
        self._newest_t: dict[int, float] = {}  # time of the newest prediction [s since 1970]
        self._forecasts: list[GaussianForecast | None] = [None] * _MAX_AIRCRAFT
        # one row per slot; the operating system provides memory only for rows in use
        self.first = np.zeros(_MAX_AIRCRAFT, np.int64)
        self.rows = np.zeros(_MAX_AIRCRAFT, np.int64)
        self.path = np.zeros((_MAX_AIRCRAFT, _ROWS, 3))
        self.covariance = np.zeros((_MAX_AIRCRAFT, _ROWS, 4))
        self.uav = np.zeros(_MAX_AIRCRAFT, np.int64)
        self.t = np.zeros(_MAX_AIRCRAFT)  # time of the prediction [s since 1970]
        self.origin = np.zeros((_MAX_AIRCRAFT, 3))  # [1e-7 deg, 1e-7 deg, mm]
        self.corner = np.zeros((_MAX_AIRCRAFT, 3))  # geodetic position of `_CORNER`, same units

    def receive(self, prediction: Prediction) -> None:
        """Store the newest prediction of an aircraft; thread-safe."""
        newest = self._newest_t.get(prediction.uav, -inf)
        if newest < prediction.t < newest + _MIN_PERIOD_S:
            return
        if prediction.uav in self._slots or len(self._slots) + len(self._pending) < _MAX_AIRCRAFT:
            self._newest_t[prediction.uav], self._pending[prediction.uav] = prediction.t, prediction

    def update_slots(self) -> None:
        """Write pending predictions to their slots; an invalid prediction empties its slot."""
        while self._pending:
            uav, prediction = self._pending.popitem()
            if uav in self._slots or len(self._slots) < _MAX_AIRCRAFT:
                self._write_slot(self._slots.setdefault(uav, len(self._slots)), uav, prediction)

    def _write_slot(self, slot: int, uav: int, prediction: Prediction) -> None:
        forecast = to_gaussian(prediction)
        self._forecasts[slot], self.uav[slot], self.rows[slot] = forecast, uav, 0
        self.t[slot] = prediction.t if np.isfinite(prediction.t) else -np.inf
        if forecast is None:
            return
        n = len(forecast.path)
        self.first[slot], self.rows[slot] = forecast.first, n
        self.path[slot, :n], self.covariance[slot, :n] = forecast.path, forecast.covariance()
        if prediction.origin != tuple(self.origin[slot]):
            self.origin[slot] = prediction.origin
            self.corner[slot] = to_geodetic(prediction.ned_origin(), _CORNER)

    def slot_of(self, uav: int) -> tuple[int, GaussianForecast] | None:
        """Return slot and forecast of one aircraft; None without a valid prediction."""
        slot = self._slots.get(uav)
        forecast = None if slot is None else self._forecasts[slot]
        return None if slot is None or forecast is None else (slot, forecast)

    def others(self, slot: int, now: float, stale_s: float) -> np.ndarray:
        """Return the slots of aircraft with a higher id and a prediction made within `stale_s` of `now`, (m,)."""
        n = len(self._slots)
        relevant = (self.uav[:n] > self.uav[slot]) & (self.rows[:n] > 0) & (np.abs(self.t[:n] - now) <= stale_s)
        return np.flatnonzero(relevant)

    def frame_transform(self, slot: int, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return scale and shift from the others' NED frames to that of `slot`, (m, 3) each [-, m].

        Both frames are linear in latitude and longitude (`fleet.frames`), so two points determine the transform.
        """
        origin = Origin(*map(int, self.origin[slot]))
        shift = to_ned(origin, *self.origin[others].T)
        corner = to_ned(origin, *self.corner[others].T)
        return (corner - shift) / _CORNER, shift


_PERIOD_S = 1.0  # between assessments of one aircraft's pairs [s]
_STALE_S = 10.0  # maximum age of a prediction [s]
_MIN_PROBABILITY = 0.02  # lower probabilities are ignored [-]
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
        if occupied is None or abs(occupied[1].prediction.t - now) > _STALE_S:
            return []
        picture, (slot, forecast) = self.picture, occupied
        others = picture.others(slot, now, _STALE_S)
        if not len(others):
            return []
        scale, shift = picture.frame_transform(slot, others)
        encounters = np.empty((len(others), 5))
        limits = np.array(self.separation, float)
        screen(
            slot,
            others,
            picture.first,
            picture.rows,
            picture.path,
            picture.covariance,
            scale,
            shift,
            limits,
            encounters,
        )
        hazards = []
        for j in np.flatnonzero(encounters[:, 0] >= 0):
            probability = self._probability(slot, int(others[j]), (scale[j], shift[j]), encounters[j])
            if probability >= _MIN_PROBABILITY:
                hazards.append(self._hazard(forecast, int(picture.uav[others[j]]), probability, encounters[j]))
        return hazards

    def _probability(self, own: int, other: int, frame: tuple[np.ndarray, np.ndarray], encounter: np.ndarray) -> float:
        picture, steps = self.picture, np.arange(int(encounter[0]), int(encounter[1]) + 1)
        i, k = steps - picture.first[own], steps - picture.first[other]
        separation = picture.path[other, k] * frame[0] + frame[1] - picture.path[own, i]
        covariance = picture.covariance[own, i] + picture.covariance[other, k]
        return float(conflict_probability(separation, covariance, DRAWS, np.array(self.separation, float)))

    def _hazard(
        self, forecast: GaussianForecast, other: int, probability: float, encounter: np.ndarray
    ) -> HazardEstimate:
        t, horizontal, vertical = float(encounter[2]) * STEP, float(encounter[3]), float(encounter[4])
        limit = self.separation
        message = (
            f"{probability:.0%} chance that it comes within {limit.horizontal:.0f} m and {limit.vertical:.0f} "
            "m of height of "
            f"uav-{other} in {max(t - forecast.prediction.t, 0.0):.0f} s; mean paths come within "
            f"{horizontal:.0f} m and {vertical:.0f} m"
        )
        position = forecast.position(int(np.clip(round(encounter[2]) - forecast.first, 0, len(forecast.path) - 1)))
        return HazardEstimate(AlertKind.CONFLICT, probability, message, _CLEAR_TEXT.format(other), other, t, position)
