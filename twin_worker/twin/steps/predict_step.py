"""Predict one path: the route flown by the best available model, else a turn-rate prediction; tube and horizon."""

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from fleet.contract import (
    EVENT_TEXTS,
    AlternativePath,
    Array,
    Controller,
    Event,
    Message,
    Outcome,
    Prediction,
    TwinState,
)
from twin_worker.confidence.table_files import INCOMPLETE, UNCONFIRMED, airframe_class, group_name
from twin_worker.confidence.tube_and_horizon import AHEAD, NOMINAL_COVERAGE, Confidence, PointForecast
from twin_worker.identification.fixed_wing.plant import DYNAMICS
from twin_worker.prediction.autopilot_parameters import IDENTIFIED, ControllerTwin
from twin_worker.prediction.closed_loop import MIN_ROLLOUT_S
from twin_worker.prediction.constant_turn import constant_turn_prediction
from twin_worker.telemetry.track import Track
from twin_worker.twin.state.events import record_event
from twin_worker.twin.state.reported_path import reported_path
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps.kinematic_prediction import (
    PathForecast,
    is_hovering,
    no_prediction,
    predict_without_model,
    recent_track,
    update_battery_forecast,
)
from twin_worker.twin.steps.rollouts import BOTH, HYBRID, ensemble_spread, predict_route, select_method

LOOK_BACK_S = 62.0  # telemetry used for a prediction [s]
LOOK_BACK_ROTORS_S = 130.0  # the same of a rotorcraft: its circles last longer
_REPORT_PERIOD_S = 10.0  # between reports of unchanged law and parameters [s]
_STALE_S = 3.0  # maximum age of positions relative to other telemetry [s]
_MAX_ABSENT = 2  # maximum number of absent autopilot parameters in the group of known parameters [-]
_IDENTIFIED_METHODS = (BOTH, HYBRID, DYNAMICS)
_MAX_LAW_ERROR_M = 0.5  # median over 10 s, of a multirotor that flies the law of the calibration flights: theirs [m]
_IMM_LAW, _NO_LAW = "none: turn rate only", "none: on the ground"


def predict(twin: Twin, now: float) -> list[Message]:
    """Predict from the newest telemetry at data time `now`; return nothing if data are insufficient.

    Without positions the prediction coasts: it continues from the last valid state until its confidence horizon ends.
    """
    assert twin.telemetry.origin is not None
    look_back_s = LOOK_BACK_ROTORS_S if twin.vehicle_class.is_rotorcraft else LOOK_BACK_S
    recent = recent_track(twin, look_back_s, with_attitude=False)
    if recent is None:
        return []
    coast_s = _coast_time(twin, recent, now)
    if coast_s and (twin.prediction.coasting_expired or _coasting_expired(twin, coast_s, now)):
        return _publish_expiry(twin, coast_s, now)
    twin.prediction.set_coasting_expired(False)
    ahead = AHEAD + round(coast_s)
    if not recent.ok[-1] or (not coast_s and twin.telemetry.history.newest - recent.t[-1] > _STALE_S):
        return []
    if twin.vehicle_class.is_rotorcraft and not coast_s and twin.prediction.override is None:
        update_battery_forecast(twin, recent, now)
    path_forecast, t0 = _best_forecast(twin, recent, ahead)
    n = _count_finite(path_forecast.path)
    if path_forecast.path is None or not n:
        return []
    speed = float(np.linalg.norm(recent.v[-1]))
    forecast = PointForecast(
        t0,
        path_forecast.method,
        _group(twin, path_forecast, recent),
        ahead[:n],
        path_forecast.path[:n],
        speed,
        ensemble_spread(twin, path_forecast.method, ahead[:n]),
    )
    confidence = twin.confidence.tracker.confidence_of(forecast)
    if path_forecast.known_s < confidence.horizon_s:
        confidence = replace(confidence, horizon_s=path_forecast.known_s, horizon_open=False)
    prediction = _to_message(twin, forecast, confidence)
    prediction = msgspec.structs.replace(
        prediction,
        seq=path_forecast.seq,
        sentence=" ".join(
            filter(None, (_coast_text(twin, coast_s), _effects_text(twin, path_forecast), path_forecast.sentence))
        ),
        coast_s=coast_s,
        law=path_forecast.law,
        alternatives=tuple(
            AlternativePath(probability=one.probability, path=Array.of(one.path[:n]), sentence=one.sentence)
            for one in path_forecast.alternatives
        ),
        controller=_changed_controller(twin, path_forecast, now),
        battery=twin.environment.battery_forecast,
        **_event_fields(twin),
    )
    twin.prediction.publish(prediction)
    if not coast_s:
        twin.confidence.tracker.add(forecast, confidence)
    return [prediction]


def _coast_time(twin: Twin, recent: Track, now: float) -> float:
    """Return the time since the last valid position [s]; 0 with telemetry. A position loss alone is an event."""
    newest, link_lost = twin.telemetry.history.newest, twin.telemetry.link_lost
    position_t = float(recent.t[-1])
    position_lost = not link_lost and newest - max(position_t, twin.telemetry.link_restored_t) > _STALE_S
    if position_lost != twin.prediction.position_lost and not link_lost:
        record_event(twin, Event.POSITION_LOST if position_lost else Event.POSITION_RESTORED, now)
    twin.prediction.set_position_lost(position_lost)
    twin.prediction.predict_timer.restart(now)
    if link_lost or position_lost:
        return max(now - (position_t if position_lost else newest), 0.0)
    return 0.0


def _coasting_expired(twin: Twin, coast_s: float, now: float) -> bool:
    """Return whether coasting, once published, exceeds the confidence horizon of the last prediction."""
    previous = twin.prediction.latest
    return coast_s > AHEAD[-1] or (
        previous is not None and previous.coast_s > 0 and now >= previous.t + previous.horizon_s
    )


def _publish_expiry(twin: Twin, coast_s: float, now: float) -> list[Message]:
    """Publish the end of the horizon once; after that nothing until telemetry returns."""
    if twin.prediction.coasting_expired or twin.prediction.latest is None:
        return []
    twin.prediction.set_coasting_expired(True)
    record_event(twin, Event.COASTING_EXPIRED, now, f"{_coast_text(twin, coast_s)} for {coast_s:.0f} s")
    _set_state(twin, twin.prediction.state)
    twin.prediction.predict_timer.restart(now)
    prediction = msgspec.structs.replace(
        twin.prediction.latest,
        state=twin.prediction.state,
        horizon_s=0.0,
        horizon_open=False,
        coast_s=coast_s,
        sentence=f"{_coast_text(twin, coast_s)}: the confidence horizon is over, the current position is unknown",
        **_event_fields(twin),
    )
    twin.prediction.publish(prediction)
    return [prediction]


def _coast_text(twin: Twin, coast_s: float) -> str:
    """Describe the missing telemetry; its age is `coast_s`, as the last text is shown while the age grows."""
    if not (coast_s or twin.telemetry.link_lost):
        return ""
    return "link lost" if twin.telemetry.link_lost else "positions stopped"


def _effects_text(twin: Twin, path_forecast: PathForecast) -> str:
    """Describe the fault effects in the model used; empty if there are none."""
    return (
        f"flown with {twin.models.active_effect};"
        if twin.models.active_effect is not None and path_forecast.method in _IDENTIFIED_METHODS
        else ""
    )


def _event_fields(twin: Twin) -> dict[str, Any]:
    """Return the newest event as fields of a prediction."""
    event = twin.prediction.latest_event
    return {} if event is None else {"event": event.event, "event_t": event.t, "event_text": event.message}


def _changed_controller(twin: Twin, path_forecast: PathForecast, now: float) -> Controller | None:
    """Return the active law and parameters if they changed or the last report is old; None otherwise."""
    control = path_forecast.control or ControllerTwin(path_forecast.law)
    if control == twin.prediction.controller and not twin.prediction.controller_timer.due(now, _REPORT_PERIOD_S):
        return None
    twin.prediction.set_controller(control, now)
    return control.to_message()


def _best_forecast(twin: Twin, recent: Track, ahead: np.ndarray) -> tuple[PathForecast, float]:
    """Return the forecast of the identified model, else kinematic, else turn rate; and its start."""
    window = twin.window(LOOK_BACK_S)
    usable = window is not None and bool(window.ok[-1])
    reason = twin.identification.verdict.sentence
    if twin.environment.flight_phase.landed and twin.prediction.override is None:
        _set_state(twin, twin.models.state)
        resting_path = np.tile(recent.p[-1], (len(ahead), 1))
        return PathForecast(resting_path, "imm", _NO_LAW, -1, EVENT_TEXTS[Event.TOUCH_DOWN]), float(recent.t[-1])
    if twin.models.has_model and not is_hovering(twin) and reported_path(twin) is None:
        model_forecast = no_prediction(twin.no_route_reason() or "telemetry has gaps: no initial state for the model")
        if window is not None and usable and not twin.no_route_reason():
            model_forecast = predict_route(twin, window, recent, ahead)
        if _is_usable(model_forecast):
            _set_state(twin, TwinState.PREDICTING)
            return model_forecast, float(window.t[-1])  # type: ignore[union-attr]
        reason = model_forecast.sentence
    kinematic = predict_without_model(twin, recent.with_attitude(twin.telemetry.history), ahead)
    if _is_usable(kinematic):
        _set_state(twin, TwinState.PREDICTING)
        text = kinematic.sentence if is_hovering(twin) else f"{kinematic.sentence}; {reason}"
        forecasts = {kinematic.method: replace(kinematic, sentence=text)}
        return select_method(twin, float(recent.t[-1]), forecasts, recent, ahead), float(recent.t[-1])
    _set_state(twin, _state_without_route(twin))
    parts = dict.fromkeys(part for part in (reason, kinematic.sentence, recent.sentence, "turn rate only") if part)
    path = constant_turn_prediction(recent, ahead)
    return PathForecast(path, "imm", _IMM_LAW, kinematic.seq if path is None else -1, "; ".join(parts)), float(
        recent.t[-1]
    )


def _state_without_route(twin: Twin) -> TwinState:
    """Return the state of a twin that predicts no route, as the identification sees it."""
    if twin.models.is_identified:
        return twin.models.state
    waits = twin.identification.verdict.outcome is Outcome.INSUFFICIENT_DATA
    return TwinState.WAITING if waits or not twin.vehicle_class.has_wings else TwinState.IDENTIFYING


def _is_usable(path_forecast: PathForecast) -> bool:
    return _count_finite(path_forecast.path) > 0


def _count_finite(path: np.ndarray | None) -> int:
    """Return the number of look-aheads before the first gap; 0 if the path is too short."""
    if path is None:
        return 0
    gaps = np.flatnonzero(~np.isfinite(path).all(axis=1))
    n = int(gaps[0]) if len(gaps) else len(path)
    return n if AHEAD[n - 1] >= MIN_ROLLOUT_S else 0


def _group(twin: Twin, path_forecast: PathForecast, recent: Track) -> str:
    """Return the calibration group of a forecast."""
    control = path_forecast.control
    provenance = "known"
    if control is not None and len(control.default_names) > _MAX_ABSENT:
        provenance = "identified" if IDENTIFIED in control.provenance.values() else "absent"
    follows_law = twin.models.multirotor.median_error < _MAX_LAW_ERROR_M
    if path_forecast.method == "copter" and provenance == "known" and not follows_law:
        provenance = UNCONFIRMED
    mission = twin.onboard.mission
    if path_forecast.method != "imm" and mission is not None and mission.items and not mission.complete:
        provenance = INCOMPLETE
    return group_name(
        path_forecast.method, path_forecast.law, airframe_class(twin.vehicle, _median_speed(recent.v)), provenance
    )


def _median_speed(v: np.ndarray) -> float:
    """Return the median speed of velocities, (n, 3) [m/s]."""
    squared = np.sort(np.einsum("ij,ij->i", v, v))
    n = len(squared)
    return 0.5 * float(np.sqrt(squared[(n - 1) // 2]) + np.sqrt(squared[n // 2]))


def _set_state(twin: Twin, state: TwinState) -> None:
    twin.prediction.set_state(TwinState.LINK_LOST if twin.telemetry.link_lost else state)


def _to_message(twin: Twin, forecast: PointForecast, confidence: Confidence) -> Prediction:
    """Build the message of a path with its tube and confidence horizon."""
    overall, overall_n = twin.confidence.tracker.coverage
    renewed, renewed_n = twin.confidence.tracker.extrapolated_coverage
    start = float(forecast.ahead[0])
    assert twin.telemetry.origin is not None
    return Prediction(
        uav=twin.config.uav,
        t=forecast.t + start,
        state=twin.prediction.state,
        method=forecast.method,
        origin=(twin.telemetry.origin.lat_e7, twin.telemetry.origin.lon_e7, twin.telemetry.origin.alt_mm),
        ahead=Array.of(forecast.ahead - start),
        path=Array.of(forecast.path),
        prediction_region_half_axes=Array.of(confidence.tube),
        quantile=NOMINAL_COVERAGE,
        axis_quantile=confidence.axis_quantile,
        horizon_s=max(confidence.horizon_s - start, 0.0),
        horizon_open=confidence.horizon_open,
        early_exceedance=confidence.early_exceedance,
        coverage=overall,
        coverage_n=overall_n,
        coverage_propagated=renewed,
        coverage_propagated_n=renewed_n,
        calibration=confidence.sentence,
    )
