"""Step one aircraft's twin: `advance(twin, messages, now)`. Uses data time only: no bus, thread or wall clock."""

from collections.abc import Iterable, Iterator
from math import isfinite

import numpy as np
from msgspec.structs import replace

from fleet.contract import Alert, Event, FleetRow, Link, Message, Sample, State, Status
from fleet.frames import to_ned
from twin_worker.estimation.wind_filter import blow
from twin_worker.prediction import method_selection
from twin_worker.twin.state.checkpoint import EVERY_S, mark
from twin_worker.twin.state.events import note
from twin_worker.twin.state.flight_phase import watch as watch_events
from twin_worker.twin.state.schedule import SOON, Work
from twin_worker.twin.state.state import Twin, hear
from twin_worker.twin.state.vehicle_class import command_in_force
from twin_worker.twin.steps.alerts import link, watch
from twin_worker.twin.steps.extrapolate import overdue, renew, renewable
from twin_worker.twin.steps.identify_step import learn
from twin_worker.twin.steps.predict_step import LOOK_BACK_S, foresee
from twin_worker.twin.steps.rollouts import fly_put_off

LOST_S = 3.0  # link lost after this time without a sample [s]
_TICK_S = 1.0  # between steps without data, between scorings, and before a failed prediction is retried [s]
_BEFORE_S = 3.0  # overlap with positions already scored, so that none is skipped [s]
_SILENT_TURNS = 150  # maximum number of steps without data [-]
_LATE_S = 10.0  # older velocities are not used for the wind [s]
_AHEAD_S = 1.0  # data time further ahead of telemetry is set back to the next sample [s]
_LATEST = 4e9  # later times are invalid [s since 1970]


def advance(twin: Twin, messages: Iterable[Message], now: float = -np.inf) -> list[Message]:
    """Ingest messages, and identify, verify, predict and score whatever is due.

    Data time is the newest time in any message, on the time axis of telemetry. Due work runs after every message,
    so the result does not depend on how a driver groups them. Without data, the twin steps once a second. Silence is
    measured by arrival: arriving telemetry is not silent, whatever its time stamps
    (see `twin_worker.telemetry.arrival_delay`).

    Args:
        twin: the aircraft's twin, changed in place
        messages: Sample, Status, Mission, Params in order of reception
        now: data time from the wall clock when no data arrive [s since 1970]
    Returns:
        Model, Prediction and Alert messages to publish
    """
    results: list[Message] = []
    for message in messages:
        for at in silence(twin, message):
            results += _turn(twin, at)
        if isinstance(message, Sample):
            if not _take_sample(twin, message):
                continue
        else:
            _take_other(twin, message)
        results += _turn(twin, twin.data_t)
    return results + _turn(twin, now) if now > twin.data_t else results


def catch_up(twin: Twin, messages: Iterable[Message]) -> list[Message]:
    """Ingest queued messages, and step once per second of data time instead of after every message.

    Args:
        twin: the aircraft's twin, changed in place
        messages: as for `advance`, which ingests the newest one
    Returns:
        Model, Prediction and Alert messages to publish
    """
    results: list[Message] = []
    for message in messages:
        if not _heard(message) < twin.turned_t + _TICK_S:
            results += advance(twin, (message,))
            continue
        hear(twin, message)
        if isinstance(message, Sample) or np.isfinite(twin.data_t):
            twin.data_t = max(twin.data_t, _heard(message))
    return results


def silence(twin: Twin, message: Message) -> Iterator[float]:
    """Yield the times of the steps in the gap before `message` [s since 1970].

    One step per second; a gap longer than any useful prediction is skipped.
    """
    at, until = max(twin.data_t, twin.turned_t), _heard(message)
    if isinstance(message, Sample):
        if _leaps(twin, message):
            return
    else:
        until -= _delay(twin, message)
    for _ in range(_SILENT_TURNS):
        if not until - at > 2 * _TICK_S or not np.isfinite(at):
            return
        at += _TICK_S
        yield at


def _heard(message: Message) -> float:
    return message.t if 0 < message.t < _LATEST else -np.inf


def _take_sample(twin: Twin, sample: Sample) -> bool:
    """Ingest telemetry; return False if it was re-anchored and the status with the step has not arrived yet."""
    leaps = _leaps(twin, sample)
    hear(twin, sample)
    newest = twin.history.newest
    if isfinite(newest):
        twin.delay.take_sample(newest, leaps)
    ran_ahead = twin.data_t - newest > _AHEAD_S  # due to status messages while telemetry was silent or delayed
    twin.data_t = newest if ran_ahead and isfinite(newest) else max(twin.data_t, _heard(sample))
    return not leaps


def _leaps(twin: Twin, sample: Sample) -> bool:
    """Return whether telemetry time jumps by at most its delay: it was re-anchored, and no data are missing."""
    leap = _heard(sample) - twin.history.newest
    return _TICK_S < leap < twin.delay.now + _TICK_S and isfinite(twin.data_t)


def _take_other(twin: Twin, message: Message) -> None:
    """Ingest a message on the gateway's clock, with its time converted to telemetry time."""
    at, newest = _heard(message), twin.history.newest
    if isfinite(at):
        delay = _delay(twin, message)
        if isinstance(message, Status) and isfinite(newest):
            twin.delay.take_status(at, newest)
        at -= delay
        message = replace(message, t=at) if delay else message
    hear(twin, message)
    if isfinite(twin.data_t):  # after a clock jump, telemetry sets the data time
        twin.data_t = max(twin.data_t, at)


def _delay(twin: Twin, message: Message) -> float:
    """Return the delay of telemetry behind the clock of a message that is not telemetry [s]."""
    newest = twin.history.newest
    if not isinstance(message, Status) or not isfinite(newest) or not isfinite(_heard(message)):
        return twin.delay.now
    return twin.delay.of_status(message.t, newest)


def _turn(twin: Twin, now: float) -> list[Message]:
    """Run whatever is due at data time `now`, which can be earlier than the last step if telemetry is late."""
    if twin.origin is None or not (isfinite(twin.history.newest) and isfinite(now)):
        return []
    twin.turned_t = now
    results = _watch_link(twin, now)
    _blow(twin)
    if _due(now, twin.score_t, _TICK_S):
        twin.score_t = now
        _remember(twin)
        watch_events(twin, command_in_force(twin))
        _score(twin)
    pace = twin.pace
    if identify_due(twin) and twin.may(Work.IDENTIFY):
        results += identify(twin)
    if _due(now, twin.predict_t, pace.predict) and twin.may(Work.PREDICT):
        twin.predict_t = twin.renew_t = now
        made = foresee(twin, now)
        new = twin.prediction if made else None
        if new is None:  # telemetry has a gap, or is too short
            _again(twin, now)
        twin.base = new or twin.base  # which is not extrapolated without limit
        results += [*made, *watch(twin, now, new)]
    elif _due(now, twin.renew_t, SOON * _renew_s(twin, now)) and twin.may(Work.RENEW):
        twin.renew_t = now
        results += renew(twin)
        if not twin.lost and not renewable(twin, twin.history.newest):
            _again(twin, now)
    if twin.put_off is not None and not twin.lost and twin.may(Work.ENSEMBLE):
        fly_put_off(twin, LOOK_BACK_S)
    return results


def _renew_s(twin: Twin, now: float) -> float:
    """Return the period of extrapolated predictions [s]; they replace a rollout that waits for CPU time."""
    pace = twin.pace
    return min(pace.renew, max(pace.predict, _TICK_S)) if overdue(twin, now) else pace.renew


def _again(twin: Twin, now: float) -> None:
    """Schedule the next rollout soon."""
    twin.predict_t = min(twin.predict_t, now - max(twin.pace.predict - _TICK_S, 0.0))


def identify_due(twin: Twin) -> bool:
    """Return whether an identification is due at the data time of the last step."""
    ready = twin.origin is not None and isfinite(twin.history.newest) and isfinite(twin.turned_t)
    return ready and not twin.lost and _due(twin.turned_t, twin.identify_t, twin.pace.identify)


def identify(twin: Twin) -> list[Message]:
    """Identify and verify once, at the time of the last step."""
    twin.identify_t = twin.turned_t
    return learn(twin)


def _due(now: float, last: float, period: float) -> bool:
    return not last <= now < last + period


def _watch_link(twin: Twin, now: float) -> list[Message]:
    silent = now - twin.history.newest
    lost = silent > LOST_S or (twin.status is not None and twin.status.link is Link.LOST and silent > 1.0)
    if lost == twin.lost:
        return []
    twin.lost, twin.predict_t = lost, -np.inf
    twin.back_t = twin.back_t if lost else now
    twin.state = State.LINK_LOST if lost else State.WAITING if twin.plant is None else State.VERIFIED
    note(twin, Event.LINK_LOST if lost else Event.LINK_BACK, now, f"no sample for {silent:.1f} s" if lost else "")
    return list(link(twin, now, silent))


def _blow(twin: Twin) -> None:
    """Update the wind filter once a second."""
    if twin.history.newest - twin.wind_t >= 1.0:
        since = max(twin.wind_t, twin.history.newest - _LATE_S)
        twin.wind_t = blow(twin.wind, twin.history, twin.wind_t, since)


def _remember(twin: Twin) -> None:
    """Add a checkpoint when due, so that the models can restart before the onset of a fault."""
    t = twin.wind_t
    if np.isfinite(t) and not (twin.marks and twin.marks[-1].t <= t < twin.marks[-1].t + EVERY_S):
        twin.marks.append(mark(t, twin.wind, (twin.last, twin.plant), twin.hybrid))


def _score(twin: Twin) -> None:
    if twin.contest.waiting and twin.history.newest >= twin.contest.waiting[0][0] + method_selection.AT[-1]:
        assert twin.origin is not None
        t, position = twin.history.look("position", twin.contest.waiting[0][0] - _BEFORE_S)
        twin.contest.answer(t, to_ned(twin.origin, *position.T))
    if not twin.record.waits:
        return
    assert twin.origin is not None
    t, position = twin.history.look("position", twin.record.answered - _BEFORE_S)
    twin.record.answer(t, to_ned(twin.origin, *position.T))


def fleet_row(twin: Twin, now: float, alerts: Iterable[Alert] = (), **claim: object) -> FleetRow:
    """Return the aircraft's row of the fleet table.

    Args:
        twin: the aircraft's twin
        now: data time [s since 1970]
        alerts: active alerts
        claim: worker and epoch
    """
    made = twin.prediction
    t10, censored, n = twin.record.t10(made.method if made and made.method != "imm" else twin.method)
    return FleetRow(
        uav=twin.uav,
        state=twin.state,
        verdict=twin.standing,
        fit=(twin.in_force or twin.verdict).fit,
        horizon_s=made.horizon_s if made else 0.0,
        sample_age_s=max(now - twin.history.newest, 0.0) if np.isfinite(twin.history.newest) else None,
        prediction_age_s=max(now - made.t, 0.0) if made else None,
        t10_s=t10,
        t10_censored=censored,
        t10_n=n,
        alerts=tuple(alert.sentence for alert in alerts),
        **claim,  # type: ignore[arg-type]
    )
