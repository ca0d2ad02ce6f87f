"""Actual flight of one aircraft and cases to score: positions, and the events that end the scoring of a prediction."""

from dataclasses import dataclass

import numpy as np

from fleet.autopilots import arduplane
from fleet.contract import Item, Message, Mission, Params, Sample, Status
from fleet.frames import Origin, to_ned
from twin_worker.telemetry.history import TelemetryHistory

_MAX_GAP_S = 2.0  # an instant without a position within this time is in a telemetry gap [s]
_LANDING = (21, 85)  # MAV_CMD: NAV_LAND, NAV_VTOL_LAND
_TARGET_MOVED_M = 2.0  # a guidance target that moves further is a new one [m]
_UNLIMITED_S = 1e9  # [s]


class ReferenceFlight:
    """Positions and events between two clock jumps."""

    def __init__(self) -> None:
        self.first_t = np.nan  # first sample [s since 1970]
        self.events: list[tuple[float, str]] = []
        self.status: Status | None = None
        self.items: tuple[Item, ...] = ()
        self._history = TelemetryHistory(keep_s=_UNLIMITED_S)
        self._params: dict[str, float] = {}
        self._mission_complete = False
        self._was_armed = False
        self._target: np.ndarray | None = None
        self._positions: tuple[np.ndarray, np.ndarray] | None = None

    def add(self, message: Message) -> None:
        """Add one message of the recording."""
        if isinstance(message, Sample):
            self._add_sample(message)
        elif isinstance(message, Status):
            self._add_status(message)
        elif isinstance(message, Mission):
            if message.complete:
                if self._mission_complete and message.items[1:] != self.items[1:]:  # item 0 is home, which moves
                    self.events.append((message.t, "mission changed"))
                self.items, self._mission_complete = message.items, True
        elif isinstance(message, Params):
            law_params = {name: value for name, value in message.values.items() if name in arduplane.DEFAULTS}
            if any(self._params.get(name, value) != value for name, value in law_params.items()):
                self.events.append((message.t, "parameters changed"))
            self._params.update(law_params)

    def _add_sample(self, sample: Sample) -> None:
        self.first_t = sample.t if np.isnan(self.first_t) else self.first_t
        self._history.add(Sample(uav=sample.uav, t=sample.t, position=sample.position, leg=sample.leg))
        self._positions = None
        self._add_target(sample)
        if sample.leg is None:
            return
        t, seq = self._history.rows("leg", sample.t - 1.0)
        if len(t) and any(item.seq == seq[-1, 0] and item.command in _LANDING for item in self.items):
            self.events.append((float(t[-1]), "landing"))

    def _add_target(self, sample: Sample) -> None:
        """Record a new guidance target in GUIDED: a command, as a mode change is."""
        if self.status is None or self.status.mode != "GUIDED":
            self._target = None
        elif sample.target is not None:
            target = sample.target.x.numpy()[-1].astype(float)
            if self._target is not None:
                before = Origin(*(int(x) for x in self._target))
                if np.linalg.norm(to_ned(before, *target[:, None])) > _TARGET_MOVED_M:
                    self.events.append((sample.t, "target changed"))
            self._target = target

    def _add_status(self, status: Status) -> None:
        if self.status and self.status.mode and status.mode != self.status.mode:
            self.events.append((status.t, "mode changed"))
        if self._was_armed and not status.armed:  # repeated while disarmed: those starts are on the ground
            self.events.append((status.t, "disarmed"))
        self.status, self._was_armed = status, self._was_armed or status.armed

    def next_event(self, t: float) -> tuple[float, str]:
        """Return the time of the first event after `t`, or of the recording's end [s since 1970], and its name."""
        position_t, _ = self._position_rows()
        end = (float(position_t[-1]) if len(position_t) else -np.inf, "recording ends")
        return min([end, *(event for event in self.events if event[0] > t)])

    def positions_at(self, origin: Origin, instants: np.ndarray) -> np.ndarray:
        """Return the positions at some instants, NED, interpolated linearly across gaps, (n, 3) [m]."""
        t, geodetic = self._position_rows()
        return np.column_stack([np.interp(instants, t, column) for column in to_ned(origin, *geodetic.T).T])

    def has_position(self, instants: np.ndarray) -> np.ndarray:
        """Return whether a position was received close to each instant, (n,) bool."""
        t, _ = self._position_rows()
        right = np.clip(np.searchsorted(t, instants), 1, len(t) - 1)
        return np.minimum(np.abs(t[right] - instants), np.abs(instants - t[right - 1])) <= _MAX_GAP_S

    def _position_rows(self) -> tuple[np.ndarray, np.ndarray]:
        if self._positions is None:
            self._positions = self._history.rows("position")
        return self._positions


OURS = "ours"


@dataclass(frozen=True)
class MethodForecast:
    """Forecast of one method at one start.

    Attributes:
        path: NED, (k, 3) [m]
        source: the method itself, or the fallback that replaced it
        tube: half-axes along, cross, vertical, (k, 3) [m]; None where the method has none
        horizon_s: confidence horizon [s]; nan where the method has none
    """

    path: np.ndarray
    source: str
    tube: np.ndarray | None = None
    horizon_s: float = float("nan")


@dataclass(frozen=True)
class EvaluationStart:
    """One start with the data available at that time.

    Attributes:
        flight, uav: flight name and UAV id
        t: time of look-ahead 0 [s since 1970]
        first_s: time since the first sample [s]
        ahead: look-ahead of every method, rising, (k,) [s]
        origin: of the NED frame of all paths
        speed: over ground, climb included [m/s]
        no_route_reason: why the aircraft follows no mission; empty: it follows one
        group: calibration group of ours: method / law / vehicle / parameters
        forecasts: by method
        spread: ensemble spread of ours along, cross, vertical, (k, 3) [m]; nan without an ensemble
    """

    flight: str
    uav: int
    t: float
    first_s: float
    ahead: np.ndarray
    origin: Origin
    speed: float
    no_route_reason: str
    group: str
    forecasts: dict[str, MethodForecast]
    spread: np.ndarray


@dataclass(frozen=True)
class EvaluationCase:
    """One start and the actual flight after it.

    Attributes:
        start: the start
        positions: flown positions, NED, nan where unknown, (k, 3) [m]
        length: path length flown, at least two seconds of ground speed, (k,) [m]
        phase: climb, level, turn or descent, from the flight after the start
        route: mission on board, NED, (n, 3) [m]
        exclusion: reason for exclusion; empty: included
    """

    start: EvaluationStart
    positions: np.ndarray
    length: np.ndarray
    phase: str
    route: np.ndarray
    exclusion: str
