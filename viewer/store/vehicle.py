"""State of one UAV in the viewer: the latest message of each topic and bounded histories."""

from collections import deque
from dataclasses import dataclass, field
from math import isfinite
from typing import Any

import numpy as np

from fleet.contract import (
    About,
    Alert,
    AlertKind,
    Controller,
    FleetRow,
    Link,
    Mismatch,
    Mission,
    Model,
    Prediction,
    Rows,
    State,
    Status,
)
from viewer.store.event_detection import Known, hear
from viewer.store.forecast import Forecast, Kept
from viewer.store.place import UNIT_M, Place
from viewer.store.received.datatime import DataTime
from viewer.store.received.inbox import Head
from viewer.store.received.rows import last, stacked
from viewer.store.track import Track, Trail
from viewer.theme.events import Event, closed, merged

SILENT_S = 3.0  # without a sample for this long the link counts as lost [s]
ABANDONED_S = 30.0  # without a worker message for this long the UAV counts as unclaimed [s]
LATE_S = 5.0  # a prediction older than this is reported as late, wall time [s]
ENDED_S = 3.0  # a replay without messages for this long has ended [s]
JUMP_S = 5.0  # a larger step back in time is another flight: reset [s]
AWAY_S = 86_400.0  # a status farther from the sample time belongs to another flight [s]


@dataclass
class Vehicle:
    """One UAV on the page."""

    uav: int
    believed: float = -np.inf  # last accepted worker result, monotonic [s]
    heard: float = -np.inf  # arrival of the last sample, monotonic [s]
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
    forecast: Forecast | None = None
    row: FleetRow | None = None
    time: DataTime = field(default_factory=DataTime)
    player: float = -np.inf  # last message of the replaying gateway, monotonic [s]; -inf: live
    judged: tuple[float, State] | None = None  # of a snapshot: time and value of the last computed state
    ended: bool = False  # the recording has ended: the page shows its last instant
    known: Known = field(default_factory=Known)
    events: tuple[Event, ...] = ()  # oldest first; immutable, replaced as a whole
    alerts: dict[About, Alert] = field(default_factory=dict)  # replaced as a whole, never mutated
    refused: tuple[float, str] = (-np.inf, "")  # last rejected message: time, monotonic [s], and reason
    trail: Trail = field(default_factory=Trail)  # newest stretch of the flight, as received
    track: Track = field(default_factory=Track)  # the whole flight, thinned
    past: deque[Kept] = field(default_factory=lambda: deque(maxlen=65))  # predictions of the last minute
    sure: Forecast | None = None  # newest prediction made with current telemetry
    fits: deque = field(default_factory=lambda: deque(maxlen=64))  # t, mean fit [%]

    @property
    def name(self) -> str:
        """Return the display name of the UAV."""
        return f"UAV-{self.uav:03d}"

    def state(self, now: float) -> State:
        """Return the state of the twin; the most severe condition wins. `now` is monotonic [s]."""
        if self.judged is None:
            return self._judge(now)
        if self.judged[0] != now:
            self.judged = now, self._judge(now)
        return self.judged[1]

    def _judge(self, now: float) -> State:
        silent = now - self.heard > SILENT_S / min(self.time.pace, 1.0)  # a slow replay has longer gaps
        if silent or (self.status is not None and self.status.link is Link.LOST):
            return State.LINK_LOST
        if now - self.believed > ABANDONED_S:
            return State.WAITING if self.believed == -np.inf else State.UNCLAIMED
        if self.row is not None:
            return self.row.state
        if self.prediction is not None:
            return self.prediction.state
        if self.model is not None:
            return State.VERIFIED if self.model.in_force is not None else State.IDENTIFYING
        return State.WAITING

    def still(self, now: float) -> "Vehicle":
        """Return an immutable copy; the histories stay shared, read them through the store.

        A recording that has ended stays at its last instant: later worker messages do not belong to the flight.
        """
        copy = object.__new__(Vehicle)
        copy.__dict__.update(self.__dict__)
        copy.judged = np.nan, State.WAITING
        if self.recorded and now - self.player > ENDED_S and now - self.heard > ENDED_S:
            copy.ended, copy.events = True, closed(self.events, self.time.t)
            copy.alerts = {
                about: alert for about, alert in self.alerts.items() if alert.kind is not AlertKind.LINK_LOST
            }
            copy.forecast = self.sure
            copy.prediction = copy.forecast.message if copy.forecast is not None else self.prediction
        return copy

    @property
    def recorded(self) -> bool:
        """Return whether the UAV is replayed from a recording."""
        return self.player > -np.inf

    def age(self, now: float) -> float:
        """Return the data time since the last sample [s]; infinite before the first."""
        return max(self.clock(now) - self.t, 0.0) if np.isfinite(self.t) else np.inf

    def late(self, now: float) -> float:
        """Return the lag of the newest prediction behind data time [s]; 0 below `LATE_S`."""
        behind = self.clock(now) - self.forecast.t if self.forecast is not None else 0.0
        return behind if behind > LATE_S * max(self.time.pace, 1.0) else 0.0

    def clock(self, now: float) -> float:
        """Estimate the current data time [s] from the newest message; it stops at the end of a recording."""
        if self.ended:
            return self.time.t
        if self.time.t == -np.inf and self.forecast is not None:
            return self.forecast.t + (now - self.forecast.heard)
        return self.time.at(now)

    def note(self, message: Any, now: float) -> None:
        """Update data time and events from a message."""
        if isinstance(message, Head | Status) and abs(message.t - self.t) < AWAY_S:  # also rejects NaN
            self.time = self.time.hear(message.t, now)
        if isinstance(message, Head) and self._no_news(message):
            return
        self.known, fresh = hear(self.known, message)
        if fresh:
            self.events = merged(self.events, fresh)

    def _no_news(self, sample: Head) -> bool:
        """Return whether a sample has no mission item or the active one."""
        leg = sample.leg
        return leg is None or (leg.x.shape == (1, 1) and leg.t.shape == (1,) and last(leg.x) == (self.known.seq,))

    def where(self, now: float) -> np.ndarray | None:
        """Return the position to draw, (3,) [10 m]: last sample, or the prediction when the link is lost."""
        if self.ended and self.at is not None:
            return self.at
        if self.forecast is not None and (self.at is None or self.state(now) is State.LINK_LOST):
            return self.forecast.at(self.clock(now) - self.forecast.t)
        return self.at

    def hear_sample(self, sample: Head, place: Place, now: float) -> None:
        """Update from the newest rows of a sample."""
        if not isfinite(sample.t):
            raise ValueError(
                f"uav-{self.uav}: sample has time {sample.t}, expected seconds since 1970; check the gateway"
            )
        if sample.t < self.t - JUMP_S:
            self.forget()
        self.heard, self.t = now, max(sample.t, self.t)
        if sample.air is not None and (air := last(sample.air.x)) and isfinite(air[0]):
            self.Va = air[0]
        if sample.attitude is not None and (turn := last(sample.attitude.x)) and all(map(isfinite, turn[:3])):
            self.attitude = turn[0], turn[1], turn[2]
        if sample.position is not None:
            self._hear_position(sample.position, place)

    def _hear_position(self, position: Rows, place: Place) -> None:
        t, x = stacked(self.uav, position)
        spots = [
            (float(at), *place.spot(lat, lon, alt))
            for at, (lat, lon, alt, *_) in zip(t, x, strict=True)
            if isfinite(at) and isfinite(lat) and isfinite(lon) and isfinite(alt) and (lat or lon)
        ]
        if not spots:
            return
        if self.track.add(spots):
            self.trail.clear()
            self.floor = np.nan
        for spot in spots:
            self.trail.add(*spot, self.Va)
        up = spots[-1][3]
        if self.status is not None and self.status.mode and not self.status.armed:  # no mode: status unknown
            self.floor = min(self.floor, up) if isfinite(self.floor) else up
        self.at, self.alt_m = np.array(spots[-1][1:]), up * UNIT_M + place.origin.alt_mm * 1e-3

    def forget(self) -> None:
        """Clear the state of a flight after a clock step back or a new scene origin."""
        self.at, self.alerts, self.floor = None, {}, np.nan
        self.time, self.known, self.events = DataTime(), Known(), ()
        self.t, self.forecast, self.prediction, self.model, self.row = -np.inf, None, None, None, None
        self.controller = self.mismatch = self.sure = None
        for history in (self.trail, self.past, self.fits, self.track):
            history.clear()
