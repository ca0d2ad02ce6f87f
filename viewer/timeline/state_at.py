"""State of a UAV at a time, as its panel and table row need it."""

from typing import NamedTuple

from fleet.contract import Alert, AlertKey, Link, Mismatch, TwinState
from viewer.store.vehicle import Vehicle
from viewer.text.words import fit


class StateRecord(NamedTuple):
    """State of a UAV from a time until the next record."""

    t: float  # data time [s since 1970]
    state: TwinState
    link: Link
    mode: str
    armed: bool
    sentence: str  # of its status
    verdict: str  # of its newest identification
    fit: float | None  # mean over the states [%]
    alerts: dict[AlertKey, Alert]
    mismatch: Mismatch | None


def state_record(vehicle: Vehicle, at: float, now: float) -> StateRecord:
    """Return the state of a UAV at data time `at` [s since 1970]; `now` is monotonic [s]."""
    status, mean = vehicle.status, fit(vehicle)
    return StateRecord(
        at,
        vehicle.state(now),
        status.link if status is not None else Link.LIVE,
        status.mode if status is not None else "",
        status.armed if status is not None else False,
        status.sentence if status is not None else "",
        vehicle.model.verdict.sentence if vehicle.model is not None else "",
        None if mean is None else float(round(mean)),
        vehicle.alerts,
        vehicle.mismatch,
    )
