"""Newest predictions of all aircraft in common arrays, so that one call assesses all pairs."""

from dataclasses import dataclass, field
from math import inf

import numpy as np

from fleet.contract import Prediction
from fleet.frames import Origin, to_geodetic, to_ned
from twin_worker.alerts.gaussian_forecast import MAX_AHEAD_S, STEP, GaussianForecast, to_gaussian

_ROWS = int(MAX_AHEAD_S / STEP) + 1
_MAX_AIRCRAFT = 4_096  # maximum number of aircraft; a bound against hostile input
_MIN_PERIOD_S = 2.0  # minimum period between stored predictions of one aircraft; paths change little within it [s]
_CORNER = np.array([1e4, 1e4, -1e4])  # point whose image determines the scale from one NED frame to another [m]


@dataclass
class TrafficPicture:
    """Predictions in slots, one per UAV; a slot is rewritten at the first assessment after a new prediction."""

    _slots: dict[int, int] = field(default_factory=dict)  # slot by UAV id
    _pending: dict[int, Prediction] = field(default_factory=dict)  # received, not yet in a slot
    _newest_t: dict[int, float] = field(default_factory=dict)  # time of the newest prediction [s since 1970]
    _forecasts: list[GaussianForecast | None] = field(default_factory=list)
    first: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    rows: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    path: np.ndarray = field(default_factory=lambda: np.zeros((0, _ROWS, 3)))
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, _ROWS, 4)))
    uav: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    t: np.ndarray = field(default_factory=lambda: np.zeros(0))  # time of the prediction [s since 1970]
    origin: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # [1e-7 deg, 1e-7 deg, mm]
    corner: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # geodetic position of `_CORNER`, same units

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
            slot = self._slots.setdefault(uav, len(self._slots))
            if slot >= len(self.uav):
                self._grow(max(2 * len(self.uav), 8))
            self._write_slot(slot, uav, prediction)

    def _grow(self, slots: int) -> None:
        for name in ("first", "rows", "path", "covariance", "uav", "t", "origin", "corner"):
            old = getattr(self, name)
            new = np.zeros((slots, *old.shape[1:]), old.dtype)
            new[: len(old)] = old
            setattr(self, name, new)
        self._forecasts += [None] * (slots - len(self._forecasts))

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
