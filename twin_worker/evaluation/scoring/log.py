"""Actual flight of one aircraft: positions, and the events that end the scoring of a prediction."""

import numpy as np

from fleet.autopilots import arduplane
from fleet.contract import Item, Message, Mission, Params, Sample, Status
from fleet.frames import Origin, to_ned
from twin_worker.telemetry.history import History

_HOLE_S = 2.0  # an instant without a position within this time is in a telemetry gap [s]
_LANDING = (21, 85)  # MAV_CMD: NAV_LAND, NAV_VTOL_LAND
_FOR_EVER = 1e9  # [s]


class Log:
    """Positions and events between two clock jumps."""

    def __init__(self) -> None:
        self.begun = np.nan  # first sample [s since 1970]
        self.events: list[tuple[float, str]] = []
        self.status: Status | None = None
        self.items: tuple[Item, ...] = ()
        self._history = History(keep_s=_FOR_EVER)
        self._params: dict[str, float] = {}
        self._whole_mission = False
        self._armed = False
        self._positions: tuple[np.ndarray, np.ndarray] | None = None

    def hear(self, message: Message) -> None:
        """Add one message of the recording."""
        if isinstance(message, Sample):
            self._hear_sample(message)
        elif isinstance(message, Status):
            self._hear_status(message)
        elif isinstance(message, Mission):
            if message.complete:
                if self._whole_mission and message.items != self.items:
                    self.events.append((message.t, "mission changed"))
                self.items, self._whole_mission = message.items, True
        elif isinstance(message, Params):
            law = {name: value for name, value in message.values.items() if name in arduplane.DEFAULTS}
            if any(self._params.get(name, value) != value for name, value in law.items()):
                self.events.append((message.t, "parameters changed"))
            self._params.update(law)

    def _hear_sample(self, sample: Sample) -> None:
        self.begun = sample.t if np.isnan(self.begun) else self.begun
        self._history.add(Sample(uav=sample.uav, t=sample.t, position=sample.position, leg=sample.leg))
        self._positions = None
        if sample.leg is None:
            return
        t, seq = self._history.rows("leg", sample.t - 1.0)
        if len(t) and any(item.seq == seq[-1, 0] and item.command in _LANDING for item in self.items):
            self.events.append((float(t[-1]), "landing"))

    def _hear_status(self, status: Status) -> None:
        if self.status and self.status.mode and status.mode != self.status.mode:
            self.events.append((status.t, "mode changed"))
        if self._armed and not status.armed:  # repeated while disarmed: those starts are on the ground
            self.events.append((status.t, "disarmed"))
        self.status, self._armed = status, self._armed or status.armed

    def until(self, t: float) -> tuple[float, str]:
        """Return the time of the first event after `t`, or of the recording's end [s since 1970], and its name."""
        after = [(self.ended_at(), "recording ends"), *((at, why) for at, why in self.events if at > t)]
        return min(after)

    def ended_at(self) -> float:
        """Return the time of the last position [s since 1970]."""
        t, _ = self._rows()
        return float(t[-1]) if len(t) else -np.inf

    def flown(self, origin: Origin, at: np.ndarray) -> np.ndarray:
        """Return the positions at some instants, NED, interpolated linearly across gaps, (n, 3) [m]."""
        t, place = self._rows()
        return np.column_stack([np.interp(at, t, column) for column in to_ned(origin, *place.T).T])

    def seen(self, at: np.ndarray) -> np.ndarray:
        """Return whether a position was received close to each instant, (n,) bool."""
        t, _ = self._rows()
        right = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
        return np.minimum(np.abs(t[right] - at), np.abs(at - t[right - 1])) <= _HOLE_S

    def _rows(self) -> tuple[np.ndarray, np.ndarray]:
        if self._positions is None:
            self._positions = self._history.rows("position")
        return self._positions
