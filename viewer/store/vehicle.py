"""State of one UAV in the viewer: the latest message of each topic and bounded histories."""

import re
from collections import deque
from dataclasses import dataclass, field
from functools import lru_cache
from math import inf, isfinite
from typing import Any, NamedTuple

import numpy as np

from fleet.bus.codec import Stamp
from fleet.contract import (
    Alert,
    AlertKey,
    AlertKind,
    Controller,
    Execution,
    FleetRow,
    Link,
    Mismatch,
    Mission,
    Model,
    Outcome,
    Prediction,
    Status,
    TwinState,
    claimed_horizon_s,
)
from viewer.store.event_detection import DetectorState, detect_events
from viewer.store.forecast import PastPrediction, ScenePrediction
from viewer.store.inbox import DataTime, SampleSubset, SampleValues, last_row, position_rows
from viewer.store.place import UNIT_M, SceneFrame
from viewer.store.proposal import SceneProposal
from viewer.store.track import FlightTrack, Trail
from viewer.theme.events import TimelineEvent, closed_at, merged

SILENT_S = 3.0  # without a sample for this long the link counts as lost [s]
UNCLAIMED_S = 30.0  # without a worker message for this long the UAV counts as unclaimed [s]
LATE_S = 5.0  # a prediction older than this is reported as late, wall time [s]
POSE_FIELDS = ("t", "at", "alt_m", "attitude", "Va", "time", "sample_received", "shown_t")  # change between records
ENDED_S = 3.0  # a replay without messages for this long has ended [s]
JUMP_S = 5.0  # a larger step back in time is another flight: reset [s]
OTHER_FLIGHT_S = 86_400.0  # a status farther from the sample time belongs to another flight [s]


TIMED = SampleSubset, Status  # messages that carry the data time of the aircraft
ProposalKey = tuple[AlertKind | None, int]
"""Identity of a proposal within one UAV, `Proposal.about`."""


class StatusRecord(NamedTuple):
    """State, fit, horizon and ages of one UAV at one instant: every text and colour of the page is made from it."""

    t: float  # data time [s since 1970]
    state: TwinState
    fit: float | None  # mean over the states of the active model, else of the newest verdict [%]; None before any
    horizon_s: float  # from the time of the prediction, as in its message [s]; 0: none, or its end has passed
    horizon_open: bool  # still below 10 % at the end of the prediction
    sample_age_s: float  # since the newest sample, data time [s]; inf before the first
    prediction_age_s: float | None  # since the newest prediction, data time [s]; None before the first
    prediction_lag_s: float  # the same where it is late, else 0 [s]
    result_age_s: float  # since the last accepted worker result, wall time [s]; inf before the first


@dataclass
class Vehicle:
    """One UAV on the page."""

    uav: int
    result_accepted: float = -np.inf  # last accepted worker result, monotonic [s]
    sample_received: float = -np.inf  # arrival of the last sample, monotonic [s]
    t: float = -np.inf  # fleet time of the newest sample [s]
    at: np.ndarray | None = None  # newest position, scene ENU, (3,) [10 m]
    floor: float = np.nan  # lowest height while disarmed, scene [10 m]
    alt_m: float = np.nan  # above mean sea level [m]
    attitude: tuple[float, float, float] = (0.0, 0.0, 0.0)  # phi theta psi [rad]
    Va: float = np.nan  # [m/s]
    status: Status | None = None
    mission: Mission | None = None
    model: Model | None = None
    prediction: Prediction | None = None
    mismatch: Mismatch | None = None
    controller: Controller | None = None  # active control law, as last received
    forecast: ScenePrediction | None = None
    row: FleetRow | None = None
    time: DataTime = field(default_factory=DataTime)
    replay_seen: float = -np.inf  # last message of the replaying gateway, monotonic [s]; -inf: live
    instant: float | None = None  # of a snapshot: its time, monotonic [s]
    record_cache: StatusRecord | None = None  # of a snapshot: the record of its instant
    ended: bool = False  # the recording has ended: the page shows its last instant
    detector_state: DetectorState = field(default_factory=DetectorState)
    events: tuple[TimelineEvent, ...] = ()  # oldest first; immutable, replaced as a whole
    alerts: dict[AlertKey, Alert] = field(default_factory=dict)  # replaced as a whole, never mutated
    proposals: dict[ProposalKey, SceneProposal] = field(default_factory=dict)  # replaced as a whole, never mutated
    execution: Execution | None = None  # newest of an approved proposal that changes this UAV
    refusal: tuple[float, str] = (-np.inf, "")  # last rejected message: time, monotonic [s], and reason
    trail: Trail = field(default_factory=Trail)  # newest stretch of the flight, as received
    track: FlightTrack = field(default_factory=FlightTrack)  # the whole flight, thinned
    past: deque[PastPrediction] = field(default_factory=lambda: deque(maxlen=65))  # predictions of the last minute
    last_updated_forecast: ScenePrediction | None = None  # newest prediction made with current telemetry
    fits: deque = field(default_factory=lambda: deque(maxlen=64))  # t, mean fit [%]
    fit_cache: list[tuple[dict[str, float], float | None]] = field(default_factory=lambda: [({}, None)])

    def trail_rows(self) -> np.ndarray:
        """Copy the newest stretch of the flown path: (n, 5) data time [s], scene ENU [10 m], Va [m/s]."""
        return self.trail.rows()

    def track_rows(self) -> np.ndarray:
        """Copy the whole flown path, thinned: (n, 4) data time [s], scene ENU [10 m]."""
        return self.track.rows()

    @property
    def name(self) -> str:
        """Return the display name of the UAV."""
        return f"UAV-{self.uav:03d}"

    def state(self, now: float) -> TwinState:
        """Return the state of the twin; the most severe condition wins. `now` is monotonic [s]."""
        is_silent = now - self.sample_received > SILENT_S / min(self.time.rate, 1.0)  # a slow replay has longer gaps
        if is_silent or (self.status is not None and self.status.link is Link.LOST):
            return TwinState.LINK_LOST
        if now - self.result_accepted > UNCLAIMED_S:
            return TwinState.WAITING if self.result_accepted == -np.inf else TwinState.UNCLAIMED
        if self.row is not None:
            return self.row.state
        if self.prediction is not None:
            return self.prediction.state
        if self.model is not None:
            active = self.model.active_verdict
            if active is None:
                return TwinState.IDENTIFYING
            return TwinState.PLAUSIBLE if active.outcome is Outcome.PLAUSIBLE else TwinState.VERIFIED
        return TwinState.WAITING

    def record(self, now: float) -> StatusRecord:
        """Return the record of this instant, monotonic [s]; a snapshot has only that of its own instant."""
        if self.instant is None:
            return self._compute_record(now)
        if self.record_cache is None:
            self.record_cache = self._compute_record(self.instant)
        return self.record_cache

    def _compute_record(self, now: float) -> StatusRecord:
        data_t, forecast, t = self.data_time(now), self.forecast, self.t
        lag_s, age_s, horizon_s, is_open = 0.0, None, 0.0, False
        if forecast is not None:
            lag_s = data_t - forecast.t
            age_s = max(lag_s, 0.0) if isfinite(data_t) else None
            horizon_s = claimed_horizon_s(forecast.horizon_s, age_s)
            is_open = horizon_s > 0.0 and forecast.message.horizon_open
        return StatusRecord(
            data_t,
            self.state(now),
            self._fit(),
            horizon_s,
            is_open,
            max(data_t - t, 0.0) if isfinite(t) else inf,
            age_s,
            self.prediction_lag_s(now) if lag_s > LATE_S else 0.0,
            now - self.result_accepted,
        )

    def _fit(self) -> float | None:
        source: dict[str, float] = self.row.fit if self.row is not None else {}
        if self.model is not None:
            source = (self.model.active_verdict or self.model.verdict).fit
        cached_source, cached = self.fit_cache[0]
        if cached_source is not source:
            cached = mean_fit(source)
            self.fit_cache[0] = source, cached
        return cached

    def at_pose_of(self, newest: "Vehicle", now: float) -> "Vehicle":
        """Return this snapshot at the newer pose and data time of another snapshot of the same UAV."""
        moved = object.__new__(type(self))
        moved.__dict__.update(self.__dict__)
        moved.__dict__.update({name: newest.__dict__[name] for name in POSE_FIELDS if name in newest.__dict__})
        moved.record_cache = self.record(now)
        return moved

    def snapshot(self, now: float) -> "Vehicle":
        """Return an immutable copy; the histories stay shared, read them through the store.

        A recording that has ended stays at its last instant: later worker messages do not belong to the flight.
        """
        copy = object.__new__(Vehicle)
        copy.__dict__ = self.__dict__.copy()
        copy.instant, copy.record_cache = now, None
        if self.recorded and now - self.replay_seen > ENDED_S and now - self.sample_received > ENDED_S:
            copy.ended, copy.events = True, closed_at(self.events, self.time.t)
            copy.alerts = {key: alert for key, alert in self.alerts.items() if alert.kind is not AlertKind.LINK_LOST}
            copy.forecast = self.last_updated_forecast
            copy.prediction = copy.forecast.message if copy.forecast is not None else self.prediction
        return copy

    @property
    def recorded(self) -> bool:
        """Return whether the UAV is replayed from a recording."""
        return self.replay_seen > -np.inf

    def sample_age_s(self, now: float) -> float:
        """Return the data time since the last sample [s]; infinite before the first."""
        return max(self.data_time(now) - self.t, 0.0) if np.isfinite(self.t) else np.inf

    def prediction_lag_s(self, now: float) -> float:
        """Return the lag of the newest prediction behind data time [s]; 0 below `LATE_S`."""
        lag_s = self.data_time(now) - self.forecast.t if self.forecast is not None else 0.0
        return lag_s if lag_s > LATE_S * max(self.time.rate, 1.0) else 0.0

    def open_proposals(self) -> list[SceneProposal]:
        """Return the proposals against active alerts, those without options included."""
        return [proposal for about, proposal in self.proposals.items() if about in self.alerts]

    def data_time(self, now: float) -> float:
        """Estimate the current data time [s] from the newest message; it stops at the end of a recording."""
        if self.ended:
            return self.time.t
        if self.time.t == -np.inf and self.forecast is not None:
            return self.forecast.t + (now - self.forecast.received)
        return self.time.estimate(now)

    def process(self, message: Any, now: float) -> None:
        """Update data time and events from a message."""
        if isinstance(message, TIMED) and abs(message.t - self.t) < OTHER_FLIGHT_S:  # also rejects NaN
            self.time = self.time.update(message.t, now)
        if isinstance(message, SampleSubset):
            leg, active = message.leg, (self.detector_state.seq,)
            if leg is None or (leg.x.shape == (1, 1) and leg.t.shape == (1,) and last_row(leg.x) == active):
                return
        self.detector_state, new_events = detect_events(self.detector_state, message)
        if new_events:
            self.events = merged(self.events, new_events)

    def position(self, now: float) -> np.ndarray | None:
        """Return the position to draw, (3,) [10 m]: last sample, or the prediction when the link is lost."""
        if self.ended and self.at is not None:
            return self.at
        if self.forecast is not None and (self.at is None or self.record(now).state is TwinState.LINK_LOST):
            return self.forecast.position_at(self.data_time(now) - self.forecast.t)
        return self.at

    def update_from_sample(self, sample: SampleSubset, scene_frame: SceneFrame, now: float) -> None:
        """Update from the newest rows of a sample."""
        if not isfinite(sample.t):
            raise ValueError(
                f"uav-{self.uav}: sample has time {sample.t}, expected seconds since 1970; check the gateway"
            )
        self._receive(sample.t, now)
        if sample.air is not None and (air := last_row(sample.air.x)) and isfinite(air[0]):
            self.Va = air[0]
        if sample.attitude is not None and (angles := last_row(sample.attitude.x)):
            phi, theta, psi = angles[:3]
            if isfinite(phi) and isfinite(theta) and isfinite(psi):
                self.attitude = phi, theta, psi
        if sample.position is not None:
            points: list[tuple[float, float, float, float]] = []
            for t, row in zip(*position_rows(self.uav, sample.position), strict=True):
                lat, lon, alt = row[:3]
                if isfinite(t) and isfinite(lat) and isfinite(lon) and isfinite(alt) and (lat or lon):
                    points.append((t, *scene_frame.from_geodetic_point(lat, lon, alt)))
            if points:
                self._add_points(points, scene_frame)

    def update_from_values(self, values: SampleValues, scene_frame: SceneFrame, now: float) -> None:
        """Update as `update_from_sample` and `process` do of a sample with the same mission item as before, or none."""
        t, attitude, Va, point, _ = values
        self._receive(t, now)
        if Va is not None and isfinite(Va):
            self.Va = Va
        if attitude is not None:
            self.attitude = attitude
        if point is not None:
            self._add_points([point], scene_frame)
        self.time = self.time.update(t, now)

    def _receive(self, t: float, now: float) -> None:
        """Note the time of a sample [s since 1970] and its arrival, monotonic [s]; reset after a step back."""
        if t < self.t - JUMP_S:
            self.reset()
        self.sample_received = now
        if t > self.t:
            self.t = t

    def _add_points(self, points: list[tuple[float, float, float, float]], scene_frame: SceneFrame) -> None:
        """Extend the path: time [s since 1970] and scene ENU [10 m] of each point."""
        if self.track.add(points):
            self.trail.clear()
            self.floor = np.nan
        for point in points:
            self.trail.add((*point, self.Va))
        up = points[-1][3]
        if self.status is not None and self.status.mode and not self.status.armed:  # no mode: status unknown
            self.floor = min(self.floor, up) if isfinite(self.floor) else up
        self.at, self.alt_m = np.array(points[-1][1:]), up * UNIT_M + scene_frame.origin.alt_mm * 1e-3

    def reset(self) -> None:
        """Clear the state of a flight after a clock step back or a new scene origin."""
        self.at, self.alerts, self.proposals, self.execution, self.floor = None, {}, {}, None, np.nan
        self.time, self.detector_state, self.events = DataTime(), DetectorState(), ()
        self.t, self.forecast, self.prediction, self.model, self.row = -np.inf, None, None, None, None
        self.controller = self.mismatch = self.last_updated_forecast = None
        for history in (self.trail, self.past, self.fits, self.track):
            history.clear()


def mean_fit(fit: dict[str, float]) -> float | None:
    """Return the mean of the fits per state [%]; None without a finite one."""
    values = [value for value in fit.values() if isfinite(value)]
    return sum(values) / len(values) if values else None


def stamp_of(row: FleetRow) -> Stamp:
    """Return the fencing token of a fleet table row; the writer is untrusted text."""
    return Stamp(row.epoch, _writer(row.worker) if len(row.worker) == 16 else 0)


@lru_cache(maxsize=256)
def _writer(worker: str) -> int:
    return int(worker, 16) if re.fullmatch("[0-9a-f]{16}", worker) else 0
