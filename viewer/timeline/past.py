"""A UAV at a past time, with the interface of `Vehicle` for drawing and texts."""

from typing import Any

import msgspec
import numpy as np

from fleet.contract import FleetRow, State
from viewer.scene.fleet_arrays import MINUTE, Flock
from viewer.store.forecast import Forecast
from viewer.store.place import UNIT_M, scene_quat
from viewer.store.received.datatime import DataTime
from viewer.store.track import placed
from viewer.store.vehicle import Vehicle
from viewer.theme.events import Event
from viewer.timeline.recording import Tape
from viewer.timeline.state_at import Stood

TRAIL_S = 90.0  # length of the fine trail [s]
PAST_S = 60.0  # age of the past predictions [s]
UNTOLD = (State.IDENTIFYING, State.WAITING, State.UNCLAIMED)  # states without a predicted path


class Flown:
    """Path up to the time shown, with the interface of `FlightTrack` and `Trail`."""

    def __init__(self, rows: np.ndarray) -> None:
        self._rows = rows

    def rows(self) -> np.ndarray:
        """Return all points, (n, 4) or (n, 5): t [s], scene ENU [10 m], for a trail also Va [m/s]."""
        return self._rows


class Past(Vehicle):
    """One UAV at a past time; immutable, its histories end there."""

    tape: Tape
    then: float  # data time shown [s since 1970]
    stood: Stood

    def clock(self, now: float) -> float:
        """Return the data time shown [s]; ignore `now`."""
        return self.then

    def state(self, now: float) -> State:
        """Return the state at the time shown."""
        return self.stood.state

    def late(self, now: float) -> float:
        """Return 0: the lag at a past time is unknown."""
        return 0.0

    def still(self, now: float) -> "Past":
        """Return itself, as it is immutable."""
        return self

    @property
    def recorded(self) -> bool:
        """Return True: it is replayed, so trails use data time."""
        return True

    @property
    def trail(self) -> Flown:  # type: ignore[override]
        """Return the fine trail up to the time shown: time [s], scene ENU [10 m], Va [m/s]."""
        return Flown(self.tape.flown(self.then - TRAIL_S, self.t))

    @property
    def track(self) -> Flown:  # type: ignore[override]
        """Return the recorded path up to the time shown."""
        return Flown(self.tape.path(-np.inf, self.t))

    @property
    def past(self) -> list[Forecast]:  # type: ignore[override]
        """Return the predictions of the preceding minute, oldest first."""
        return [one for one in self.tape.told if self.then - PAST_S <= one.t <= self.then]

    @property
    def fits(self) -> list[tuple[float, float]]:  # type: ignore[override]
        """Return the fits up to the time shown: time [s], mean over the states [%]."""
        return [(one.t, one.fit) for one in self.tape.stood if one.fit is not None and one.t <= self.then]

    @property
    def events(self) -> tuple[Event, ...]:  # type: ignore[override]
        """Return the events up to the time shown."""
        return tuple(event for event in self.tape.events if event.t <= self.then)


def as_it_was(vehicle: Vehicle, tape: Tape, then: float, rate: float = 0.0) -> Past | None:
    """Return a UAV at a past time.

    Args:
        vehicle: current UAV
        recording: its recording
        shown_t: data time [s since 1970]
        rate: data seconds per wall second; 0 paused
    Returns:
        the UAV; None before its first record
    """
    how = tape.stood_at(then)
    if how is None or not len(tape) or then < tape.t[0] - 1.0:
        return None
    row, told = tape.row(then), tape.told_by(then) if how.state not in UNTOLD else None
    past = object.__new__(Past)
    past.__dict__.update({name: value for name, value in vehicle.__dict__.items() if name not in _OWN})
    past.__dict__.update(_figures(vehicle, row, how, told))
    past.tape, past.then, past.stood = tape, then, how
    past.t = float(min(then, tape.t[-1]))
    past.time = DataTime(then, pace=rate)
    return past


_OWN = ("trail", "track", "past", "fits", "events")


def _figures(vehicle: Vehicle, row: np.ndarray, how: Stood, told: Forecast | None) -> dict[str, Any]:
    """Return the fields of a UAV that differ at a past time."""
    status = vehicle.status
    if status is not None:
        status = msgspec.structs.replace(status, mode=how.mode, armed=how.armed, link=how.link, sentence=how.sentence)
    return {
        "at": row[:3],
        "alt_m": vehicle.alt_m + (row[2] - vehicle.at[2]) * UNIT_M if vehicle.at is not None else np.nan,
        "attitude": tuple(float(angle) for angle in row[3:6]),
        "Va": float(row[6]),
        "status": status,
        "model": None,
        "prediction": told.message if told is not None else None,
        "forecast": told,
        "mismatch": how.mismatch,
        "alerts": how.alerts,
        "row": FleetRow(
            uav=vehicle.uav, state=how.state, verdict=how.verdict, fit={} if how.fit is None else {"mean": how.fit}
        ),
        "ended": False,
    }


def remember(flock: Flock, pasts: list[Past], now: float) -> None:
    """Update fleet arrays to a past time; `now` is monotonic [s]."""
    flock.meet(list(pasts), now)
    shown = [past for past in pasts if flock.index(past.uav) is not None]
    flock.at = np.array([past.where(now) for past in shown]).reshape(-1, 3)
    flock.quat = scene_quat(*np.array([past.attitude for past in shown]).reshape(-1, 3).T)
    minute = [placed(past.tape.path(past.then - MINUTE[0], past.t), past.then - MINUTE, np.inf) for past in shown]
    ring = [np.where(np.isfinite(rows), rows, at) for rows, at in zip(minute, flock.at, strict=True)]
    flock.ring = np.array(ring).reshape(-1, len(MINUTE), 3)
    flock.changes, flock.beats = min(flock.changes, 0) - 1, 0  # differs from live revisions and on every call
