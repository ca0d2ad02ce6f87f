"""Publish a fallback prediction for a late or locked twin: its last path, shifted to the newest position."""

import time
from collections.abc import Callable

import numpy as np

from fleet.contract import Message, Prediction
from twin_worker.ownership.twin_store import Held
from twin_worker.twin.state.schedule import SOON
from twin_worker.twin.steps.extrapolate import LATEST_S, OVERDUE_S, renewed

LOOK_S = 0.4  # between checks for aircraft without a prediction [s]
OLD_S = 1.0  # minimum age of the last published prediction before a fallback is due [s]
_LATE = 1.2  # the same in scheduled prediction periods [-]
_LACKING = 2.0  # multiple of that age at which the aircraft counts as without a prediction [-]
_BACK_S = 1.0  # telemetry this far before the last prediction means that the clock was set back [s]
_FARTHEST = 2e9  # larger coordinates are invalid [1e-7 deg, mm]


def stand_in(held: Held) -> Prediction | None:
    """Propagate the last prediction of a locked twin, without a change to the twin."""
    twin, rows = held.twin, held.placed
    if rows is None or not held.ready:
        return None
    try:
        t, x = rows.t.numpy(), rows.x.numpy().astype(float)
    except ValueError:
        return None
    if not len(t) or x.shape != (len(t), 3) or not (np.abs(x[-1]) < _FARTHEST).all():
        return None
    said = max(held.stood, twin.prediction.t if twin.prediction else -np.inf)
    if not t[-1] >= said + SOON * min(twin.pace.renew, twin.pace.predict):
        return None
    made = renewed(twin, float(t[-1]), x[-1])
    if made is not None:
        held.stood = made.t
    return made


def stand_in_for(holding: list[Held], publish: Callable[[Message, Held], None]) -> None:
    """Propagate the predictions of all twins that are overdue, due to lack of CPU time or a lock."""
    for held in holding:
        late = time.monotonic() - held.published > _due_s(held)
        if late and (made := stand_in(held)) is not None:
            publish(made, held)


def lacks_prediction(held: Held, now: float) -> bool:
    """Return whether an aircraft has no recent prediction, not even a propagated one, at `now`, monotonic [s]."""
    return now - held.published > _LACKING * _due_s(held)


def _due_s(held: Held) -> float:
    pace = held.twin.pace
    return max(OLD_S, _LATE * min(pace.predict, pace.renew))


def said_already(result: Message, held: Held) -> bool:
    """Return whether a late prediction is older than the fallback published meanwhile."""
    if not isinstance(result, Prediction) or not held.stood - OVERDUE_S < result.t <= held.stood:
        return False
    return result.t > held.stood - LATEST_S or held.placed is None or _newest(held) > held.stood - _BACK_S


def _newest(held: Held) -> float:
    """Return the time of the newest received position [s since 1970]."""
    try:
        t = held.placed.t.numpy() if held.placed is not None else np.empty(0)
    except ValueError:
        return np.inf
    return float(t[-1]) if len(t) else np.inf
