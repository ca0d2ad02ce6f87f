"""Predictions that need no identified model, by vehicle class: kinematic fixed wing, multirotor."""

from dataclasses import dataclass, replace
from math import isfinite
from typing import NamedTuple

import numpy as np

from fleet.autopilots import greybox
from fleet.contract import BatteryForecast, Mission
from fleet.mission import route_items
from twin_worker.prediction import kinematic
from twin_worker.prediction.autopilot_parameters import ControllerTwin, RouteOverride, multirotor_controller
from twin_worker.prediction.constant_turn import STEP, imm_with_variance
from twin_worker.prediction.failsafe_route import FailsafePlan
from twin_worker.prediction.multirotor import fit, rollout
from twin_worker.prediction.multirotor.config import MultirotorConfig, multirotor_config, with_wing_limits
from twin_worker.prediction.multirotor.endurance import forecast_battery
from twin_worker.telemetry.track import SETTLING_S, Track, hovering_mask, resample_track
from twin_worker.twin.state.reported_path import ReportedPath, reported_path
from twin_worker.twin.state.routes import ROUTE_MODES, failsafe_plan, present_route
from twin_worker.twin.state.state import Twin

_FIT_WINDOW_S = 130.0  # flight time used to fit the kinematic models [s]
_TRIED_FIRST = 8  # fits of a multirotor in a row: each of its parameters twice
_RETURN_COMMAND = 20  # MAV_CMD: NAV_RETURN_TO_LAUNCH
_VTOL_COMMANDS = (84, 85)  # MAV_CMD: NAV_VTOL_TAKEOFF, NAV_VTOL_LAND
_KNOWN_PATH_S = 5.0  # part of a path that is commanded point by point which its course tells: the distance of L1 [s]
_WIND_MAX_AGE_S = 10.0  # maximum age of the autopilot's wind estimate [s]
_TURN_NAMES = {  # parameters of L1 with other autopilots, by their names with ArduPlane
    "NAVL1_PERIOD": ("NAVL1_PERIOD", "FW_L1_PERIOD"),
    "NAVL1_DAMPING": ("NAVL1_DAMPING", "FW_L1_DAMPING"),
    "ROLL_LIMIT_DEG": ("ROLL_LIMIT_DEG", "FW_R_LIM"),
}
_BATTERY_PERIOD_S = 15.0  # between forecasts of the battery [s]
_MIN_ROWS = 20  # of an unbroken track that a prediction begins with
_VELOCITY_ROWS = 11  # rows used for a multirotor's velocity and acceleration
_MANUAL_AFTER_S = 6.0  # a multirotor in a hold mode that still moves after this time is under manual control [s]


class PathAlternative(NamedTuple):
    """A path that may be flown instead of the predicted one.

    Attributes:
        probability: of this path [-]
        path: NED, (k, 3) [m]
        sentence: what the aircraft does on it
    """

    probability: float
    path: np.ndarray
    sentence: str


@dataclass(frozen=True)
class PathForecast:
    """A predicted path on the route, or the reason why there is none.

    Attributes:
        path: NED, (k, 3) [m]; None if this method cannot predict
        method, law: as in `Prediction`
        seq: mission item at the start, -1 none
        sentence: basis of the prediction, or the reason why there is none
        control: controller model used
        known_s: look-ahead at which a failsafe begins whose route is not known [s]
        alternatives: paths that may be flown instead
    """

    path: np.ndarray | None
    method: str
    law: str
    seq: int
    sentence: str
    control: ControllerTwin | None = None
    known_s: float = np.inf
    alternatives: tuple[PathAlternative, ...] = ()


def no_prediction(sentence: str, seq: int = -1) -> PathForecast:
    """Return a forecast without a path, with the reason."""
    return PathForecast(None, "", "", seq, sentence)


def recent_track(twin: Twin, seconds: float = _FIT_WINDOW_S, *, with_attitude: bool = True) -> Track | None:
    """Return the recent track from positions and velocities; `with_attitude` adds the attitude."""
    assert twin.telemetry.origin is not None
    return resample_track(
        twin.telemetry.history,
        twin.telemetry.origin,
        until=twin.telemetry.history.newest,
        seconds=seconds,
        with_attitude=with_attitude,
    )


def is_hovering(twin: Twin) -> bool:
    """Return whether the aircraft hovers on rotors now, or is about to by its mission."""
    if twin.vehicle_class.is_rotorcraft:
        return True
    if not twin.vehicle_class.is_vtol:
        return False
    newest = twin.telemetry.history.newest
    times = np.linspace(newest - SETTLING_S, newest, 7)
    if hovering_mask(times, twin.telemetry.history, twin.received_params, twin.onboard.mode_changes).any():
        return True
    command = active_command(twin)
    return twin.onboard.status is not None and twin.onboard.status.mode in ROUTE_MODES and command in _VTOL_COMMANDS


def active_command(twin: Twin) -> int:
    """Return the command of the active mission item; 0 unknown."""
    seq = rollout.item_in_force(
        twin.telemetry.history.newest, twin.telemetry.history.rows_since("leg"), twin.onboard.mission
    )
    items = twin.onboard.mission.items if twin.onboard.mission else ()
    return next((item.command for item in items if item.seq == seq), 0) if isfinite(seq) else 0


def _multirotor_config(twin: Twin, recent: Track, override: RouteOverride | None = None) -> MultirotorConfig:
    params, mission, autopilot = (
        twin.received_params,
        twin.onboard.mission,
        twin.onboard.status.autopilot if twin.onboard.status else "",
    )
    if override is not None:
        params = params | dict(override.parameters)
        mission = Mission(uav=twin.config.uav, t=twin.telemetry.history.newest, items=override.items, seq=override.seq)
    config = multirotor_config(
        mission,
        params,
        autopilot,
        twin.onboard.plan_changed_t,
        origin=twin.telemetry.origin,
        flown=recent,
        prefix=twin.vehicle_class.rotor_prefix,
        identified=twin.models.multirotor.identified,
        jumps_taken=twin.onboard.jumps_taken if override is None else override.jumps_taken,
        reported=twin.telemetry.history.rows_since("leg", twin.onboard.plan_changed_t)[1][:, 0],
    )
    return with_wing_limits(config) if twin.vehicle_class.rotor_prefix else config


def fixed_wing_config(twin: Twin) -> kinematic.KinematicConfig:
    """Return the configuration of the kinematic fixed-wing model from the present state of a twin."""
    assert twin.telemetry.origin is not None
    items = route_items(twin.onboard.mission)
    wind = twin.environment.wind.wind if np.isfinite(twin.environment.wind.t) else _reported_wind(twin)
    path = reported_path(twin)
    return kinematic.KinematicConfig(
        items,
        twin.received_params,
        twin.onboard.plan_changed_t if path is None else path.since,
        twin.telemetry.origin,
        wind,
        twin.prediction.override,
        twin.first_item,
        twin.onboard.entry,
        present_route(twin) if path is None else path.route,
        twin.telemetry.history,
        failsafe_plan(twin),
        _turn_parameters(twin) if path is None else path.law,
    )


def _reported_wind(twin: Twin) -> np.ndarray | None:
    """Return the wind that the autopilot estimates, NED, (3,) [m/s]; None without a recent report."""
    _, rows = twin.telemetry.history.rows_since("wind", twin.telemetry.history.newest - _WIND_MAX_AGE_S)
    return np.array([*rows[-1, :2], 0.0]) if len(rows) else None


def _turn_parameters(twin: Twin) -> dict[str, float]:
    """Return what is known of L1 and the bank limit beside the parameters of ArduPlane, by their names there."""
    known = twin.environment.autopilot.values | twin.received_params
    return {
        name: known[other]
        for name, others in _TURN_NAMES.items()
        if (other := next((other for other in others if other in known), None)) is not None
    }


def fit_kinematic_models(twin: Twin) -> None:
    """Fit the parameters of the kinematic models to the last minutes of flight."""
    if twin.no_route_reason() or (
        not twin.vehicle_class.is_rotorcraft
        and (not twin.vehicle_class.has_wings or twin.models.active_model is not None)
    ):
        return
    newest = twin.telemetry.history.newest
    if twin.models.multirotor.n_comparisons >= _TRIED_FIRST and not twin.models.kinematic_timer.due(
        newest, fit.START_INTERVAL_S
    ):
        return
    recent = recent_track(twin)
    if recent is None or len(recent) < 100:
        return
    twin.models.kinematic_timer.restart(newest)
    seq = rollout.items_in_force(recent.t, twin.telemetry.history.rows_since("leg"), twin.onboard.mission)
    if twin.vehicle_class.is_rotorcraft:
        config = _multirotor_config(twin, recent)
        twin.models.store_multirotor(fit.fit_model(recent, seq, config, twin.models.multirotor))
    elif not is_hovering(twin):
        model = kinematic.fit_model(recent, seq, fixed_wing_config(twin), twin.models.kinematic)
        twin.models.store_kinematic(model)


def update_battery_forecast(twin: Twin, recent: Track, now: float) -> None:
    """Predict the remaining battery of a multirotor in flight at the end of its mission and at home, if it is due."""
    if twin.environment.battery_timer.due(now, _BATTERY_PERIOD_S):
        twin.environment.store_battery_forecast(predict_battery(twin, recent), now)


def predict_battery(twin: Twin, recent: Track) -> BatteryForecast | None:
    """Predict the remaining battery of a multirotor with its present plan, or the overridden one; None: not known."""
    unbroken, status = recent.with_attitude(twin.telemetry.history).unbroken_tail(), twin.onboard.status
    if status is None or not status.armed or twin.environment.flight_phase.landed or len(unbroken) < _MIN_ROWS:
        return None
    override = twin.prediction.override
    config = _multirotor_config(twin, unbroken, override)
    seq = rollout.items_in_force(unbroken.t, twin.telemetry.history.rows_since("leg"), twin.onboard.mission)
    returns = status.mode in rollout.RETURN_MODES or (override is None and active_command(twin) == _RETURN_COMMAND)
    if twin.no_route_reason() or returns:  # the end of a return is home
        seq = np.full(len(unbroken), np.nan)
    elif override is not None:
        seq[-1] = override.seq
    models = config, twin.models.multirotor, twin.environment.battery
    return forecast_battery(unbroken, seq, models, twin.received_params)


def predict_without_model(twin: Twin, recent: Track, ahead: np.ndarray) -> PathForecast:
    """Predict the path on the route with the kinematic model of this vehicle class."""
    unbroken = recent.unbroken_tail()
    if len(unbroken) < _MIN_ROWS:
        return no_prediction("less than 2 s of unbroken positions")
    if is_hovering(twin):
        return _predict_multirotor(twin, unbroken, ahead)
    if not twin.vehicle_class.has_wings:
        return no_prediction(f"vehicle {twin.vehicle}: no controller model available")
    if reason := twin.no_route_reason():
        return no_prediction(reason)
    if twin.vehicle_class.is_vtol:
        hover_rows = np.flatnonzero(
            hovering_mask(unbroken.t, twin.telemetry.history, twin.received_params, twin.onboard.mode_changes)
        )
        unbroken = unbroken.part(int(hover_rows[-1]) + 1 if len(hover_rows) else 0, len(unbroken))
    seq = rollout.items_in_force(unbroken.t, twin.telemetry.history.rows_since("leg"), twin.onboard.mission)
    config = fixed_wing_config(twin)
    forecast = kinematic.fly(unbroken, seq, config, twin.models.kinematic, ahead)
    if forecast.path is None:
        return no_prediction(forecast.sentence, forecast.seq)
    text = f"{kinematic.describe(twin.models.kinematic)}. {forecast.sentence}".strip(". ")
    reported = reported_path(twin)
    path = forecast.path if reported is None or reported.repeats else _turn_after(forecast.path, ahead, reported)
    control, known_s = forecast.controller, forecast.known_s
    made = PathForecast(path, "greybox", greybox.LAW, forecast.seq, text, control, known_s)
    if known_s < np.inf or not mission_may_continue(twin, config.failsafe):
        return made
    other = kinematic.fly(unbroken, seq, replace(config, failsafe=None), twin.models.kinematic, ahead)
    return replace(made, alternatives=continued_mission(other.path))


_ONLY_DOWNLINK = 0.5  # nothing received tells which radio links are lost: both cases count alike [-]


def mission_may_continue(twin: Twin, plan: FailsafePlan | None) -> bool:
    """Return whether a mission is flown that a failsafe ends, unless the aircraft still receives its ground station."""
    return plan is not None and bool(plan.steps) and twin.mode in ROUTE_MODES


def continued_mission(path: np.ndarray | None) -> tuple[PathAlternative, ...]:
    """Return the path of the mission, (k, 3) [m], as alternative to a failsafe; none where it is not predicted."""
    if path is None or not np.isfinite(path).all():
        return ()
    text = "continues the mission: only telemetry is lost; which links are lost is not known, both cases count alike"
    return (PathAlternative(_ONLY_DOWNLINK, path, text),)


def _turn_after(path: np.ndarray, ahead: np.ndarray, reported: ReportedPath) -> np.ndarray:
    """Return the path with its expectation after the known part of a commanded path, (k, 3) [m].

    Nothing tells whether the aircraft turns. Two estimates are combined by their variances: straight flight and turns
    from the end of the known part on, and the positions of the flight so far, in whose area it stays.
    Source: Bar-Shalom 2001, 3.4.2 (linear minimum mean square error estimation).
    """
    times = ahead[0] + STEP * np.arange(int(_KNOWN_PATH_S / STEP) + 1)
    known = np.column_stack([np.interp(times, ahead, column) for column in path.T])
    after = ahead > times[-1]
    if len(known) < 4 or not after.any() or not np.isfinite(known).all():
        return path
    out = path.copy()
    turns, variance = imm_with_variance(known, np.gradient(known, STEP, axis=0), ahead[after] - times[-1])
    weight = reported.spread**2 / (reported.spread**2 + variance)
    turns[:, :2] = reported.centre + weight[:, None] * (turns[:, :2] - reported.centre)
    out[after] = turns
    return out


def _with_speed_override(recent: Track, override: RouteOverride) -> Track:
    """Return the track with the overridden speed in its newest rows."""
    if override.speed is None:
        return recent
    v = recent.v.copy()
    v[-_VELOCITY_ROWS:] = override.scale_to_speed(v[-1], float(np.nan_to_num(recent.euler[-1, 2])))
    return replace(recent, v=v)


def _predict_multirotor(twin: Twin, recent: Track, ahead: np.ndarray) -> PathForecast:
    mode = twin.onboard.status.mode if twin.onboard.status else ""
    config = _multirotor_config(twin, recent, twin.prediction.override)
    overridden = twin.prediction.override.parameters if twin.prediction.override else {}
    control = multirotor_controller(
        twin.received_params,
        twin.vehicle_class.rotor_prefix,
        config.limit,
        overridden,
        px4=config.smooths_velocity,
    )
    if twin.onboard.status is None or not twin.onboard.status.armed:
        return no_prediction("not armed")
    if mode in rollout.HOLD_MODES:
        if (
            twin.telemetry.history.newest - twin.onboard.plan_changed_t > _MANUAL_AFTER_S
            and np.linalg.norm(recent.v[-20:].mean(axis=0)) > 1.0
        ):
            return no_prediction(f"mode {mode}, but under manual control")
        hover_path = rollout.stop_and_hold(recent, config, twin.models.multirotor, ahead)
        return PathForecast(hover_path, "copter", config.law, -1, f"mode {mode} holds position", control)
    if mode in rollout.RETURN_MODES and twin.vehicle_class.is_rotorcraft:
        path = rollout.fly_home(recent, config, twin.models.multirotor, ahead)
        text = f"returns to launch; {rollout.describe(config, twin.models.multirotor)}"
        if path is None:
            return no_prediction("home position unknown")
        return PathForecast(path, "copter", config.law, -1, text, control)
    if reason := twin.no_route_reason():
        return no_prediction(reason)
    seq = rollout.items_in_force(recent.t, twin.telemetry.history.rows_since("leg"), twin.onboard.mission)
    if twin.prediction.override is not None:
        seq[-1], recent = twin.prediction.override.seq, _with_speed_override(recent, twin.prediction.override)
    path, problem = rollout.fly_route(recent, seq, config, twin.models.multirotor, ahead)
    item = int(seq[-1]) if np.isfinite(seq[-1]) else -1
    if path is None:
        return no_prediction(problem, item)
    hover_text = "hovering on rotors; " if twin.vehicle_class.is_vtol else ""
    text = " ".join(filter(None, (hover_text + rollout.describe(config, twin.models.multirotor), problem)))
    return PathForecast(path, "copter", config.law, item, text, control)
