"""A UAV at a past time, with the interface of `Vehicle` for drawing and texts; comparison with what was flown."""

from typing import NamedTuple

import msgspec
import numpy as np

from fleet.contract import FleetRow, TwinState
from viewer.scene.fleet_arrays import TRAIL_AGES_S, FleetArrays
from viewer.scene.selection.pins import path_frame
from viewer.store.forecast import ScenePrediction
from viewer.store.inbox import DataTime
from viewer.store.place import UNIT_M, scene_quat
from viewer.store.track import positions_at
from viewer.store.vehicle import Vehicle
from viewer.theme.events import TimelineEvent
from viewer.timeline.recording import StateRecord, UavRecording

TRAIL_S = 90.0  # length of the fine trail [s]
PAST_S = 60.0  # age of the past predictions [s]
NO_PREDICTION = (TwinState.IDENTIFYING, TwinState.WAITING, TwinState.UNCLAIMED)  # states without a predicted path


class PastVehicle(Vehicle):
    """One UAV at a past time; immutable, its histories end there."""

    recording: UavRecording
    shown_t: float  # data time shown [s since 1970]
    state_record: StateRecord

    def data_time(self, now: float) -> float:
        """Return the data time shown [s]; ignore `now`."""
        return self.shown_t

    def state(self, now: float) -> TwinState:
        """Return the state at the time shown."""
        return self.state_record.state

    def prediction_lag_s(self, now: float) -> float:
        """Return 0: the lag at a past time is unknown."""
        return 0.0

    def snapshot(self, now: float) -> "PastVehicle":
        """Return itself, as it is immutable."""
        return self

    @property
    def recorded(self) -> bool:
        """Return True: it is replayed, so trails use data time."""
        return True

    def trail_rows(self) -> np.ndarray:
        """Return the fine trail up to the time shown: (n, 5) time [s], scene ENU [10 m], Va [m/s]."""
        return self.recording.trail_rows(self.shown_t - TRAIL_S, self.t)

    def track_rows(self) -> np.ndarray:
        """Return the recorded path up to the time shown: (n, 4) time [s], scene ENU [10 m]."""
        return self.recording.path(-np.inf, self.t)

    @property
    def past(self) -> list[ScenePrediction]:  # type: ignore[override]
        """Return the predictions of the preceding minute, oldest first."""
        begin, end = self.shown_t - PAST_S, self.shown_t
        return [prediction for prediction in self.recording.predictions if begin <= prediction.t <= end]

    @property
    def fits(self) -> list[tuple[float, float]]:  # type: ignore[override]
        """Return the fits up to the time shown: time [s], mean over the states [%]."""
        records = [record for record in self.recording.states if record.t <= self.shown_t]
        return [(record.t, record.fit) for record in records if record.fit is not None]

    @property
    def events(self) -> tuple[TimelineEvent, ...]:  # type: ignore[override]
        """Return the events up to the time shown."""
        return tuple(event for event in self.recording.events if event.t <= self.shown_t)


def vehicle_at(vehicle: Vehicle, recording: UavRecording, shown_t: float, rate: float = 0.0) -> PastVehicle | None:
    """Return a UAV at a past time.

    Args:
        vehicle: current UAV
        recording: its recording
        shown_t: data time [s since 1970]
        rate: data seconds per wall second; 0 paused
    Returns:
        the UAV; None before its first record
    """
    record = recording.state_at(shown_t)
    if record is None or not len(recording) or shown_t < recording.t[0] - 1.0:
        return None
    row, status = recording.row_at(shown_t), vehicle.status
    forecast = recording.prediction_at(shown_t) if record.state not in NO_PREDICTION else None
    if status is not None:
        fields = {"mode": record.mode, "armed": record.armed, "link": record.link, "sentence": record.sentence}
        status = msgspec.structs.replace(status, **fields)
    fit = {} if record.fit is None else {"mean": record.fit}
    past = object.__new__(PastVehicle)
    past.__dict__.update({name: value for name, value in vehicle.__dict__.items() if name not in _OVERRIDDEN})
    past.recording, past.shown_t, past.state_record = recording, shown_t, record
    past.record_cache = None
    past.t, past.time = float(min(shown_t, recording.t[-1])), DataTime(shown_t, rate=rate)
    past.at, past.Va = row[:3], float(row[6])
    past.alt_m = vehicle.alt_m + (row[2] - vehicle.at[2]) * UNIT_M if vehicle.at is not None else np.nan
    past.attitude = float(row[3]), float(row[4]), float(row[5])
    past.status, past.model, past.forecast = status, None, forecast
    past.prediction = forecast.message if forecast is not None else None
    past.mismatch, past.alerts, past.ended = record.mismatch, record.alerts, False
    past.proposals = {}
    past.row = FleetRow(uav=vehicle.uav, state=record.state, verdict=record.verdict, fit=fit)
    return past


_OVERRIDDEN = ("past", "fits", "events")


def update_past_arrays(fleet_arrays: FleetArrays, pasts: list[PastVehicle], now: float) -> None:
    """Update fleet arrays to a past time; `now` is monotonic [s]."""
    fleet_arrays.update_fleet(list(pasts), now)
    shown = [past for past in pasts if fleet_arrays.index(past.uav) is not None]
    fleet_arrays.at = np.array([past.position(now) for past in shown]).reshape(-1, 3)
    fleet_arrays.quat = scene_quat(*np.array([past.attitude for past in shown]).reshape(-1, 3).T)
    trails = []
    for past, at in zip(shown, fleet_arrays.at, strict=True):
        path = past.recording.path(past.shown_t - TRAIL_AGES_S[0], past.t)
        rows = positions_at(path, past.shown_t - TRAIL_AGES_S, np.inf)
        trails.append(np.where(np.isfinite(rows), rows, at))
    fleet_arrays.trails = np.array(trails).reshape(-1, len(TRAIL_AGES_S), 3)
    fleet_arrays.revision = min(fleet_arrays.revision, 0) - 1  # differs from live revisions and on every call
    fleet_arrays.trail_steps = 0


STEPS_S = (5.0, 10.0, 20.0, 30.0, 60.0, 120.0)  # look-aheads compared in the text [s]
ERROR_LINE_S = 5.0  # between error lines [s]


class LeadTimeError(NamedTuple):
    """Prediction error at one look-ahead."""

    ahead: float  # from the time shown [s]
    distance: float  # distance between predicted and flown position [m]
    band: float  # cross-track half-axis of the prediction region [m]
    inside: bool  # flown position within all three half-axes


def predicted_and_actual(forecast: ScenePrediction, track: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return predicted and flown positions at times (k,) [s since 1970], each (k, 3) [10 m]; `track` is (n, 4)."""
    actual = np.stack([np.interp(t, track[:, 0], track[:, k]) for k in (1, 2, 3)], axis=-1)
    return forecast.position_at(t - forecast.t), actual


def answered_until(forecast: ScenePrediction, track: np.ndarray) -> float:
    """Return the time up to which a prediction can be compared: horizon or newest row [s since 1970]."""
    return min(forecast.t + forecast.horizon_s, float(track[-1, 0])) if len(track) else forecast.t


def lead_time_errors(forecast: ScenePrediction, track: np.ndarray, shown_t: float) -> list[LeadTimeError]:
    """Compute the errors at the look-aheads `STEPS_S` from the time shown, `shown_t` [s since 1970]."""
    ahead = np.array([step for step in STEPS_S if shown_t + step <= answered_until(forecast, track)])
    if not len(ahead):
        return []
    times = shown_t + ahead
    predicted, actual = predicted_and_actual(forecast, track, times)
    cross, up = path_frame(forecast.path)
    k = np.clip(np.searchsorted(forecast.ahead, times - forecast.t), 0, len(forecast.path) - 1)
    along = np.cross(cross, up)[k]
    offsets = (actual - predicted) * UNIT_M
    parts = np.abs(np.stack([np.sum(offsets * axis, axis=1) for axis in (along, cross[k], up[k])], axis=-1))
    axes = forecast.half_axes_at(times - forecast.t) * UNIT_M
    inside = (parts <= axes).all(axis=1)
    return [
        LeadTimeError(float(s), float(np.linalg.norm(d)), float(a[1]), bool(h))
        for s, d, a, h in zip(ahead, offsets, axes, inside, strict=True)
    ]


def error_lines(forecast: ScenePrediction, track: np.ndarray, shown_t: float) -> np.ndarray:
    """Return lines from predicted to flown positions every 5 s from the time shown: (k, 2, 3) [10 m]."""
    times = np.arange(shown_t + ERROR_LINE_S, answered_until(forecast, track), ERROR_LINE_S)
    return np.stack(predicted_and_actual(forecast, track, times), axis=1) if len(times) else np.zeros((0, 2, 3))
