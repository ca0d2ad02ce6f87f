"""What a worker does instead where CPU time is short: fallback predictions, and the newest telemetry only.

A fallback prediction of a late or locked twin is its last path, continued from the newest position.
"""

import time
from collections.abc import Callable

import numpy as np

from fleet.contract import Message, Prediction, Sample
from twin_worker.ownership.twin_store import OwnedTwin
from twin_worker.twin.state.budget import EARLY_FRACTION
from twin_worker.twin.steps.extrapolate import MAX_OVERDUE_AGE_S, MAX_ROLLOUT_AGE_S, propagate

CHECK_PERIOD_S = 0.4  # between checks for aircraft without a prediction [s]
NEWEST_S = 2.0  # of the telemetry of an aircraft that an overloaded worker processes [s]
MIN_OVERDUE_S = 1.0  # minimum age of the last published prediction before a fallback is due [s]
_OVERDUE_PERIODS = 1.2  # the same in scheduled prediction periods [-]
_MISSING_FACTOR = 2.0  # multiple of that age at which the aircraft counts as without a prediction [-]
_CLOCK_BACK_S = 1.0  # telemetry this far before the last prediction means that the clock was set back [s]
_MAX_COORDINATE = 2e9  # larger coordinates are invalid [1e-7 deg, mm]
_NO_VELOCITY = np.empty(0), np.empty((0, 3))  # times and velocities: one sample has too few


def fallback_prediction(owned: OwnedTwin) -> Prediction | None:
    """Propagate the last prediction of a locked twin, without a change to the twin."""
    twin, rows = owned.twin, owned.last_position
    if rows is None or not owned.ready:
        return None
    try:
        t, x = rows.t.numpy(), rows.x.numpy().astype(float)
    except ValueError:
        return None
    if not len(t) or x.shape != (len(t), 3) or not (np.abs(x[-1]) < _MAX_COORDINATE).all():
        return None
    published_t = max(owned.fallback_t, twin.prediction.latest.t if twin.prediction.latest else -np.inf)
    if not t[-1] >= published_t + EARLY_FRACTION * min(twin.config.schedule.renew, twin.config.schedule.predict):
        return None
    prediction = propagate(twin, t[-1:], x[-1:], *_NO_VELOCITY)
    if prediction is not None:
        owned.fallback_t = prediction.t
    return prediction


def take_backlog(owned: OwnedTwin, n: int, *, overloaded: bool) -> list[Message]:
    """Take n messages from the inbox; when overloaded drop and count samples older than the last `NEWEST_S`."""
    taken = [owned.inbox.popleft() for _ in range(n)]
    if not overloaded:
        return taken
    # the last to arrive, since a clock may be set back
    last = next((message.t for message in reversed(taken) if isinstance(message, Sample)), 0.0)
    newer = [message for message in taken if not isinstance(message, Sample) or message.t > last - NEWEST_S]
    owned.dropped += len(taken) - len(newer)
    return newer


def publish_fallbacks(owned_twins: list[OwnedTwin], publish: Callable[[Message, OwnedTwin], None]) -> None:
    """Propagate the predictions of all twins that are overdue, due to lack of CPU time or a lock; oldest first.

    With little CPU time a pass takes longer than a period, and the same order each time would let the last ones wait.
    """
    for owned in sorted(owned_twins, key=lambda one: one.published_at):
        overdue = time.monotonic() - owned.published_at > _due_s(owned)
        if overdue and (prediction := fallback_prediction(owned)) is not None:
            publish(prediction, owned)


def lacks_prediction(owned: OwnedTwin, now: float) -> bool:
    """Return whether an aircraft has no recent prediction, not even a propagated one, at `now`, monotonic [s]."""
    return now - owned.published_at > _MISSING_FACTOR * _due_s(owned)


def _due_s(owned: OwnedTwin) -> float:
    schedule = owned.twin.config.schedule
    return max(MIN_OVERDUE_S, _OVERDUE_PERIODS * min(schedule.predict, schedule.renew))


def is_superseded(result: Message, owned: OwnedTwin) -> bool:
    """Return whether a late prediction is older than the fallback published meanwhile."""
    if not isinstance(result, Prediction) or not owned.fallback_t - MAX_OVERDUE_AGE_S < result.t <= owned.fallback_t:
        return False
    return (
        result.t > owned.fallback_t - MAX_ROLLOUT_AGE_S
        or owned.last_position is None
        or _newest_position_t(owned) > owned.fallback_t - _CLOCK_BACK_S
    )


def _newest_position_t(owned: OwnedTwin) -> float:
    """Return the time of the newest received position [s since 1970]."""
    try:
        t = owned.last_position.t.numpy() if owned.last_position is not None else np.empty(0)
    except ValueError:
        return np.inf
    return float(t[-1]) if len(t) else np.inf
