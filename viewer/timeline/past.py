"""A UAV as it was: a `Vehicle` that every drawing and every sentence takes for one of now."""

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

TRAIL_S = 90.0  # of the fine trail [s]
PAST_S = 60.0  # of the predictions before [s]
UNTOLD = (State.IDENTIFYING, State.WAITING, State.UNCLAIMED)  # whoever stands so claims no path


class Flown:
    """The path flown until then, in the form of a `Track` or a `Trail`."""

    def __init__(self, rows: np.ndarray) -> None:
        self._rows = rows

    def rows(self) -> np.ndarray:
        """Return all points, (n, 4) or (n, 5): t [s], scene ENU [10 m], and of a trail Va [m/s]."""
        return self._rows


class Past(Vehicle):
    """One UAV at a time gone by; it stands still, and its histories end there."""

    tape: Tape
    then: float  # data time shown [s since 1970]
    stood: Stood

    def clock(self, now: float) -> float:
        """Return the data time shown [s], whatever the time is now."""
        return self.then

    def state(self, now: float) -> State:
        """Return the state it had then."""
        return self.stood.state

    def late(self, now: float) -> float:
        """Return nothing: what was late then may have come since."""
        return 0.0

    def still(self, now: float) -> "Past":
        """Return itself: nobody changes it."""
        return self

    @property
    def recorded(self) -> bool:
        """Tell that it is played again: its trails are laid by data time."""
        return True

    @property
    def trail(self) -> Flown:  # type: ignore[override]
        """Return the fine trail until then: rows of time [s], scene ENU [10 m], Va [m/s]."""
        return Flown(self.tape.flown(self.then - TRAIL_S, self.t))

    @property
    def track(self) -> Flown:  # type: ignore[override]
        """Return all the path that is kept until then."""
        return Flown(self.tape.path(-np.inf, self.t))

    @property
    def past(self) -> list[Forecast]:  # type: ignore[override]
        """Return the predictions of the minute before, oldest first."""
        return [one for one in self.tape.told if self.then - PAST_S <= one.t <= self.then]

    @property
    def fits(self) -> list[tuple[float, float]]:  # type: ignore[override]
        """Return the fits until then: time [s], mean over the states [%]."""
        return [(one.t, one.fit) for one in self.tape.stood if one.fit is not None and one.t <= self.then]

    @property
    def events(self) -> tuple[Event, ...]:  # type: ignore[override]
        """Return what had happened by then."""
        return tuple(event for event in self.tape.events if event.t <= self.then)


def as_it_was(vehicle: Vehicle, tape: Tape, then: float, rate: float = 0.0) -> Past | None:
    """Turn a UAV of now into that of another time.

    Args:
        vehicle: as it is now
        tape: what is kept of it
        then: data time [s since 1970]
        rate: data seconds per wall second it is played at; 0 paused
    Returns:
        None where nothing was known of it yet
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
    """Return what of a UAV was another then."""
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
    """Make a flock that of a time gone by; `now` is monotonic [s]."""
    flock.meet(list(pasts), now)
    shown = [past for past in pasts if flock.index(past.uav) is not None]
    flock.at = np.array([past.where(now) for past in shown]).reshape(-1, 3)
    flock.quat = scene_quat(*np.array([past.attitude for past in shown]).reshape(-1, 3).T)
    minute = [placed(past.tape.path(past.then - MINUTE[0], past.t), past.then - MINUTE, np.inf) for past in shown]
    ring = [np.where(np.isfinite(rows), rows, at) for rows, at in zip(minute, flock.at, strict=True)]
    flock.ring = np.array(ring).reshape(-1, len(MINUTE), 3)
    flock.changes, flock.beats = min(flock.changes, 0) - 1, 0  # others than those of now, and others every time
