"""Step one aircraft's twin: `advance(twin, messages, now)`. Uses data time only: no bus, thread or wall clock."""

from collections.abc import Iterable, Iterator
from math import inf, isfinite

import numpy as np
from msgspec.structs import replace

from fleet.contract import Alert, Event, FleetRow, Link, Message, Sample, Status, TwinState
from fleet.frames import to_ned
from twin_worker.twin.state.budget import EARLY_FRACTION, Work
from twin_worker.twin.state.events import record_event
from twin_worker.twin.state.flight_phase import update_flight_phase
from twin_worker.twin.state.home import complete_home
from twin_worker.twin.state.routes import failsafe_plan
from twin_worker.twin.state.state import Twin, ingest
from twin_worker.twin.steps.alerts import link_alerts, prediction_alerts
from twin_worker.twin.steps.extrapolate import can_propagate, departure, extrapolate, rollout_overdue
from twin_worker.twin.steps.identify_step import identify_and_verify, update_information
from twin_worker.twin.steps.kinematic_prediction import active_command
from twin_worker.twin.steps.predict_step import LOOK_BACK_S, predict
from twin_worker.twin.steps.rollouts import run_deferred_ensemble

LINK_LOST_S = 3.0  # link lost after this time without a sample [s]
_TICK_S = 1.0  # between steps without data, between scorings, and before a failed prediction is retried [s]
_OVERLAP_S = 3.0  # overlap with positions already scored, so that none is skipped [s]
_MAX_SILENT_STEPS = 150  # maximum number of steps without data [-]
_MAX_TIME_LEAD_S = 1.0  # data time further ahead of telemetry is set back to the next sample [s]
_MAX_TIME = 4e9  # later times are invalid [s since 1970]


def advance(twin: Twin, messages: Iterable[Message], now: float = -np.inf) -> list[Message]:
    """Ingest messages, and identify, verify, predict and score whatever is due.

    Data time is the newest time in any message, on the time axis of telemetry. Due work runs after every message,
    so the result does not depend on how a driver groups them. Without data, the twin steps once a second. Silence is
    measured by arrival: arriving telemetry is not silent, whatever its time stamps
    (see `twin_worker.telemetry.history`).

    Args:
        twin: the aircraft's twin, changed in place
        messages: Sample, Status, Mission, Params in order of reception
        now: data time from the wall clock when no data arrive [s since 1970]
    Returns:
        Model, Prediction and Alert messages to publish
    """
    results: list[Message] = []
    for message in messages:
        for t in silent_step_times(twin, message):
            results += _step(twin, t)
        if isinstance(message, Sample):
            if not _ingest_sample(twin, message):
                continue
        else:
            _ingest_other(twin, message)
        results += _step(twin, twin.telemetry.data_t)
    return results + _step(twin, now) if now > twin.telemetry.data_t else results


def catch_up(twin: Twin, messages: Iterable[Message]) -> list[Message]:
    """Ingest queued messages, and step once per second of data time instead of after every message.

    Args:
        twin: the aircraft's twin, changed in place
        messages: as for `advance`, which ingests the newest one
    Returns:
        Model, Prediction and Alert messages to publish
    """
    published: list[Message] = []
    for message in messages:
        if not _message_time(message) < twin.telemetry.last_step_t + _TICK_S:
            published += advance(twin, (message,))
            continue
        ingest(twin, message)
        if isinstance(message, Sample) or np.isfinite(twin.telemetry.data_t):
            twin.telemetry.advance(_message_time(message))
    return published


def silent_step_times(twin: Twin, message: Message) -> Iterator[float]:
    """Yield the times of the steps in the gap before `message` [s since 1970].

    One step per second; a gap longer than any useful prediction is skipped.
    """
    t, until = max(twin.telemetry.data_t, twin.telemetry.last_step_t), _message_time(message)
    if isinstance(message, Sample):
        if _is_redated(twin, message):
            return
    else:
        until -= _telemetry_delay(twin, message)
    for _ in range(_MAX_SILENT_STEPS):
        if not until - t > 2 * _TICK_S or not np.isfinite(t):
            return
        t += _TICK_S
        yield t


def _message_time(message: Message) -> float:
    return message.t if 0 < message.t < _MAX_TIME else -np.inf


def _ingest_sample(twin: Twin, sample: Sample) -> bool:
    """Ingest telemetry; return False if it was re-anchored and the status with the step has not arrived yet."""
    redated = _is_redated(twin, sample)
    ingest(twin, sample)
    newest = twin.telemetry.history.newest
    if isfinite(newest):
        twin.telemetry.delay.on_sample(newest, redated)
    ran_ahead = (
        twin.telemetry.data_t - newest > _MAX_TIME_LEAD_S
    )  # due to status messages while telemetry was silent or delayed
    back = ran_ahead and isfinite(newest)
    twin.telemetry.advance(newest if back else _message_time(sample), back=back)
    return not redated


def _is_redated(twin: Twin, sample: Sample) -> bool:
    """Return whether telemetry time jumps by at most its delay: it was re-anchored, and no data are missing."""
    jump = _message_time(sample) - twin.telemetry.history.newest
    return _TICK_S < jump < twin.telemetry.delay.newest_sample_delay + _TICK_S and isfinite(twin.telemetry.data_t)


def _ingest_other(twin: Twin, message: Message) -> None:
    """Ingest a message on the gateway's clock, with its time converted to telemetry time."""
    t, newest = _message_time(message), twin.telemetry.history.newest
    if isfinite(t):
        delay = _telemetry_delay(twin, message)
        if isinstance(message, Status) and isfinite(newest):
            twin.telemetry.delay.on_status(t, newest)
        t -= delay
        message = replace(message, t=t) if delay else message
    ingest(twin, message)
    if isfinite(twin.telemetry.data_t):  # after a clock jump, telemetry sets the data time
        twin.telemetry.advance(t)


def _telemetry_delay(twin: Twin, message: Message) -> float:
    """Return the delay of telemetry behind the clock of a message that is not telemetry [s]."""
    newest = twin.telemetry.history.newest
    if not isinstance(message, Status) or not isfinite(newest) or not isfinite(_message_time(message)):
        return twin.telemetry.delay.newest_sample_delay
    return twin.telemetry.delay.delay_at_status(message.t, newest)


def _step(twin: Twin, now: float) -> list[Message]:
    """Run whatever is due at data time `now`, which can be earlier than the last step if telemetry is late."""
    if twin.telemetry.origin is None or not (isfinite(twin.telemetry.history.newest) and isfinite(now)):
        return []
    twin.telemetry.step(now)
    results = _update_link(twin, now)
    twin.telemetry.learn_servo_map()
    twin.environment.update_wind(twin.telemetry.history)
    if twin.vehicle_class.is_rotorcraft:
        twin.environment.update_battery(twin.telemetry.history, twin.models.multirotor.wind)
    if twin.confidence.timer.due(now, _TICK_S):
        twin.confidence.timer.restart(now)
        twin.models.checkpoint(twin.environment.wind_t, twin.environment.wind, twin.identification.prior_model)
        update_flight_phase(twin, active_command(twin))
        complete_home(twin)
        _score_predictions(twin)
        if twin.config.schedule.information and twin.vehicle_class.has_wings:
            update_information(twin)
    if identify_due(twin) and twin.budget_allows(Work.IDENTIFY):
        results += identify(twin)
    if _rollout_due(twin, now) and twin.budget_allows(Work.PREDICT):
        twin.prediction.restart_periods(now)
        messages = predict(twin, now)
        prediction = twin.prediction.latest if messages else None
        if prediction is None:  # telemetry has a gap, or is too short: the last rollout stays until it expires
            _retry_prediction(twin, now)
        else:
            twin.prediction.set_rollout(prediction)
        results += [*messages, *prediction_alerts(twin, now, prediction)]
    elif _extrapolation_due(twin, now) and twin.budget_allows(Work.RENEW):
        twin.prediction.renew_timer.restart(now)
        extrapolated = extrapolate(twin)
        results += extrapolated
        if extrapolated and twin.config.schedule.departure:
            results += prediction_alerts(twin, now, twin.prediction.latest)
        if not twin.telemetry.link_lost and not can_propagate(twin, twin.telemetry.history.newest):
            _retry_prediction(twin, now)
    if (
        twin.prediction.deferred_ensemble_t is not None
        and not twin.telemetry.link_lost
        and twin.budget_allows(Work.ENSEMBLE)
    ):
        run_deferred_ensemble(twin, LOOK_BACK_S)
    return results


def rollout_age_s(twin: Twin) -> float:
    """Return the time since the last rollout on the clock of the aircraft [s]; inf without a rollout or a step."""
    age = twin.telemetry.last_step_t - twin.prediction.predict_timer.last
    return age if isfinite(age) else inf


def _rollout_due(twin: Twin, now: float) -> bool:
    """Return whether a rollout is due: after its period, where the aircraft has departed from the last one.

    An event makes it due at once. Before a model was compared with flight, each rollout knows more than the last.
    """
    timer, schedule = twin.prediction.predict_timer, twin.config.schedule
    if not timer.due(now, schedule.predict):
        return False
    may_wait = schedule.departure and isfinite(timer.last) and twin.models.is_compared
    if not may_wait or rollout_overdue(twin, now):
        return True
    return _extrapolation_due(twin, now) and not departure(twin) < schedule.departure


def _extrapolation_due(twin: Twin, now: float) -> bool:
    return twin.prediction.renew_timer.due(now, EARLY_FRACTION * _propagation_period(twin, now))


def _propagation_period(twin: Twin, now: float) -> float:
    """Return the period of extrapolated predictions [s]; they replace a rollout that waits for CPU time."""
    schedule = twin.config.schedule
    return min(schedule.renew, max(schedule.predict, _TICK_S)) if rollout_overdue(twin, now) else schedule.renew


def _retry_prediction(twin: Twin, now: float) -> None:
    """Schedule the next rollout soon."""
    last = now - max(twin.config.schedule.predict - _TICK_S, 0.0)
    twin.prediction.predict_timer.restart(min(twin.prediction.predict_timer.last, last))


def identify_due(twin: Twin) -> bool:
    """Return whether an identification is due at the data time of the last step."""
    telemetry = twin.telemetry
    has_data = telemetry.origin is not None and isfinite(telemetry.history.newest) and isfinite(telemetry.last_step_t)
    schedule, identification = twin.config.schedule, twin.identification
    due = identification.timer.due(telemetry.last_step_t, schedule.identify)
    due = due and not identification.information < schedule.information
    return has_data and not telemetry.link_lost and due


def identify(twin: Twin) -> list[Message]:
    """Identify and verify once, at the time of the last step."""
    twin.identification.timer.restart(twin.telemetry.last_step_t)
    return identify_and_verify(twin)


def _update_link(twin: Twin, now: float) -> list[Message]:
    silence_s = now - twin.telemetry.history.newest
    status = twin.onboard.status
    lost = silence_s > LINK_LOST_S or (status is not None and status.link is Link.LOST and silence_s > 1.0)
    if lost == twin.telemetry.link_lost:
        return []
    twin.telemetry.set_link(lost, now)
    plan = failsafe_plan(twin) if lost else None
    if plan is not None and plan.steps:  # another route than that of the open predictions, which say nothing of it
        twin.confidence.tracker.censor_open()
        twin.prediction.expire()  # the newest ensemble flew that route as well
    twin.prediction.set_state(TwinState.LINK_LOST if lost else twin.models.state)
    record_event(
        twin, Event.LINK_LOST if lost else Event.LINK_RESTORED, now, f"no sample for {silence_s:.1f} s" if lost else ""
    )
    return list(link_alerts(twin, now))


def _score_predictions(twin: Twin) -> None:
    selector = twin.prediction.selector
    if selector.has_due_score(twin.telemetry.history.newest):
        assert twin.telemetry.origin is not None
        t, position = twin.telemetry.history.rows_since("position", selector.pending[0][0] - _OVERLAP_S)
        selector.score(t, to_ned(twin.telemetry.origin, *position.T))
    if not twin.confidence.tracker.has_open:
        return
    assert twin.telemetry.origin is not None
    t, position = twin.telemetry.history.rows_since("position", twin.confidence.tracker.evaluated_until - _OVERLAP_S)
    twin.confidence.tracker.evaluate(t, to_ned(twin.telemetry.origin, *position.T))


def fleet_row(twin: Twin, now: float, alerts: Iterable[Alert] = (), **claim: object) -> FleetRow:
    """Return the aircraft's row of the fleet table.

    Args:
        twin: the aircraft's twin
        now: data time [s since 1970]
        alerts: active alerts
        claim: worker and epoch
    """
    prediction = twin.prediction.latest
    t10, censored, n = twin.confidence.tracker.t10(
        prediction.method if prediction and prediction.method != "imm" else twin.config.method
    )
    return FleetRow(
        uav=twin.config.uav,
        state=twin.prediction.state,
        verdict=twin.verdict_text,
        fit=(twin.models.active_verdict or twin.identification.verdict).fit,
        horizon_s=prediction.horizon_s if prediction else 0.0,
        sample_age_s=max(now - twin.telemetry.history.newest, 0.0)
        if np.isfinite(twin.telemetry.history.newest)
        else None,
        prediction_age_s=max(now - prediction.t, 0.0) if prediction else None,
        t10_s=t10,
        t10_censored=censored,
        t10_n=n,
        alerts=tuple(alert.sentence for alert in alerts),
        wind=twin.wind_estimate,
        battery=prediction.battery.sentence if prediction and prediction.battery else "",
        **claim,  # type: ignore[arg-type]
    )
