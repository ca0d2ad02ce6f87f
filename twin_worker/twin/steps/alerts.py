"""Alerts of a single aircraft: link, ground, geofence, short horizon, infeasible mission."""

from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from fleet.contract import Alert, AlertKind, BatteryForecast, Prediction
from fleet.frames import Origin, to_ned
from twin_worker.alerts.feasibility import MissionState, feasibility_hazard, read_limits
from twin_worker.alerts.gaussian_forecast import GaussianForecast, to_gaussian
from twin_worker.alerts.geofence import (
    MIN_HEIGHT_ROTORS_M,
    MIN_HEIGHT_WINGS_M,
    GeofenceLimits,
    geofence_hazard,
    ground_hazard,
    height_above_home,
    lowest_after,
    read_geofence,
)
from twin_worker.alerts.hysteresis import HazardEstimate
from twin_worker.confidence.table_files import UNCALIBRATED
from twin_worker.prediction.multirotor.rollout import RETURN_MODES
from twin_worker.prediction.route_cache import cached_route
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps.kinematic_prediction import is_hovering

_MIN_SCORED = 30  # minimum number of scored predictions; below it, the 90 % horizon comes from the prior table [-]
_TURN_RATE_REACH_S = 15.0  # ground and geofence look-ahead of turn-rate predictions [s]
_REACH_S = 90.0  # maximum look-ahead; beyond it, the tube is wider than usual geofence margins [s]
_DEFAULT_REACH_S = 30.0  # look-ahead for an uncalibrated tube, and for a new aircraft without a model [s]
_NEW_S = 60.0  # flight after which an aircraft is no longer new; the tubes are calibrated on longer ones [s]
_TURN_RATE_GRACE_S = (
    20.0  # on a mission, turn-rate predictions raise alerts only after this time without a better method [s]
)
_FEASIBILITY_PERIOD_S = 5.0
_LANDING_COMMANDS = (21, 85, 189)  # MAV_CMD: NAV_LAND, NAV_VTOL_LAND, DO_LAND_START
_RETURN_COMMAND, _LAST_NAV_COMMAND = 20, 95  # MAV_CMD
_LANDING_LOOKAHEAD = 3  # navigation items, the active one included, in which a landing suppresses ground alerts [-]


def link_alerts(twin: Twin, now: float) -> list[Alert]:
    """Raise or clear the link alert; its text has no age, as it is shown while the age grows."""
    sentence = "no samples; the twin predicts without telemetry"
    return twin.alerts.alarms.update(
        twin.config.uav,
        now,
        HazardEstimate(AlertKind.LINK_LOST, float(twin.telemetry.link_lost), sentence, "link back"),
    )


def prediction_alerts(twin: Twin, now: float, prediction: Prediction | None) -> list[Alert]:
    """Evaluate all alerts for the newest prediction at data time `now`; None if there is no prediction."""
    gaussian = to_gaussian(prediction) if prediction is not None else None
    _update_home_fallback(twin)
    twin.alerts.update_turn_rate(now, only=gaussian is not None and gaussian.prediction.method == "imm")
    hazards = [] if prediction is None else [battery_hazard(prediction.battery)]
    findings = [_not_predicted(kind) for kind in (AlertKind.GROUND, AlertKind.GEOFENCE)]
    if gaussian is not None:
        turn_rate_only = (
            gaussian.prediction.method == "imm"
            and not twin.no_route_reason()
            and now - twin.alerts.turn_rate_only_since < _TURN_RATE_GRACE_S
        )
        findings = [] if turn_rate_only else limit_hazards(twin, gaussian)
    findings += hazards
    if not twin.telemetry.link_lost:
        findings.append(_short_horizon(prediction))
        if twin.alerts.feasibility_timer.due(now, _FEASIBILITY_PERIOD_S):
            twin.alerts.feasibility_timer.restart(now)
            findings.append(mission_feasibility(twin, now))
    return [alert for finding in findings for alert in twin.alerts.alarms.update(twin.config.uav, now, finding)]


def _not_predicted(kind: AlertKind) -> HazardEstimate:
    return HazardEstimate(kind, 0.0, "", "no longer predicted")


def _update_home_fallback(twin: Twin) -> None:
    """Store the disarmed position as a fallback for home, and reset the maximum height."""
    if twin.onboard.status is None or twin.onboard.status.armed:
        return
    _, position = twin.telemetry.history.rows_since("position", twin.telemetry.history.newest - 2.0)
    twin.alerts.disarmed_at(Origin(*map(int, position[-1])) if len(position) else None)


def limit_hazards(twin: Twin, gaussian: GaussianForecast, *, to_the_end: bool = False) -> list[HazardEstimate]:
    """Evaluate ground clearance and geofence; neither without a home position.

    Args:
        twin: the aircraft; gaussian: its prediction
        to_the_end: beyond the look-ahead of the alerts, a mean path below the minimum height counts, with one half
    """
    home_origin, on_rotors = twin.home, is_hovering(twin)
    if home_origin is None:
        return [_not_predicted(AlertKind.GROUND), _not_predicted(AlertKind.GEOFENCE)]
    margin = MIN_HEIGHT_ROTORS_M if on_rotors else MIN_HEIGHT_WINGS_M
    twin.alerts.climbed_to(float(height_above_home(gaussian, home_origin)[0]))
    until = gaussian.prediction.t + reach_s(twin, gaussian.prediction)
    findings = [_not_predicted(AlertKind.GROUND)]
    near_ground = twin.alerts.max_height_m <= margin or _is_landing(
        twin, on_rotors
    )  # still taking off, possibly on rotors
    if not near_ground:
        ground = ground_hazard(gaussian, home_origin, margin, until, twin.terrain)
        if to_the_end and lowest_beyond_reach(twin, gaussian) < margin:
            ground = replace(ground, probability=max(ground.probability, 0.5))
        findings = [ground]
    limit = geofence(twin)
    if near_ground:
        limit = limit.without_floors()
    return [
        *findings,
        geofence_hazard(gaussian, limit, home_origin, until)
        if limit.any_limit()
        else _not_predicted(AlertKind.GEOFENCE),
    ]


def geofence(twin: Twin) -> GeofenceLimits:
    """Return the geofence of an aircraft: of its parameters, its fence items and the areas of the operator."""
    mission = twin.onboard.mission
    return read_geofence(_params(twin), mission.fence if mission is not None else (), twin.areas)


def lowest_beyond_reach(twin: Twin, gaussian: GaussianForecast) -> float:
    """Return the lowest mean height above ground beyond the look-ahead of the alerts [m].

    It is infinite without a home position, and where the rest of the flight contains a landing.
    """
    if twin.home is None or _is_landing(twin, is_hovering(twin), within=None):
        return np.inf
    return lowest_after(gaussian, twin.home, twin.terrain, gaussian.prediction.t + reach_s(twin, gaussian.prediction))


def reach_s(twin: Twin, prediction: Prediction) -> float:
    """Return the look-ahead up to which a prediction is used for ground and geofence alerts [s].

    A new aircraft without a model is predicted with a wind that is hardly known yet.
    """
    if prediction.method == "imm":
        return _TURN_RATE_REACH_S
    t, _ = twin.telemetry.history.rows_since("position")
    is_new = not len(t) or twin.telemetry.history.newest - t[0] < _NEW_S
    is_uncertain = is_new and not twin.models.has_model and not is_hovering(twin)
    return _DEFAULT_REACH_S if is_uncertain or prediction.calibration.startswith(UNCALIBRATED) else _REACH_S


def _is_landing(twin: Twin, on_rotors: bool, within: int | None = _LANDING_LOOKAHEAD) -> bool:
    """Return whether the aircraft is landing, or is about to: by its mode or the next items, None: all."""
    mode = twin.onboard.status.mode if twin.onboard.status is not None else ""
    if "LAND" in mode or (on_rotors and mode in RETURN_MODES):
        return True
    if twin.no_mission_reason() or twin.onboard.mission is None:
        return False
    items = sorted(twin.onboard.mission.items, key=lambda item: item.seq)
    commands = [item.command for item in items if item.seq >= twin.onboard.mission.seq]
    nav_commands = [command for command in commands if command < _LAST_NAV_COMMAND or command in _LANDING_COMMANDS][
        :within
    ]
    return any(command in _LANDING_COMMANDS or (on_rotors and command == _RETURN_COMMAND) for command in nav_commands)


def _short_horizon(prediction: Prediction | None) -> HazardEstimate:
    """Evaluate the early error of a route prediction, once enough past predictions are scored."""
    is_scored = prediction is not None and prediction.method != "imm" and prediction.coverage_n >= _MIN_SCORED
    probability = prediction.early_exceedance if prediction is not None and is_scored else 0.0
    sentence = f"predictions exceed an error of 10 % within 10 s with a probability of {probability:.0%}"
    return HazardEstimate(AlertKind.SHORT_HORIZON, probability, sentence, "predictions hold 10 s again")


def battery_hazard(forecast: BatteryForecast | None) -> HazardEstimate:
    """Evaluate whether the battery is empty before the end of the mission or before home."""
    clear = "the battery is sufficient again"
    if forecast is None:
        return HazardEstimate(AlertKind.BATTERY, 0.0, "", clear)
    probability = float(ndtr(-forecast.home / forecast.home_sigma)) if forecast.home_sigma > 0 else 0.0
    if forecast.end is not None and forecast.end_sigma:
        probability = max(probability, float(ndtr(-forecast.end / forecast.end_sigma)))
    return HazardEstimate(AlertKind.BATTERY, probability, f"battery: {forecast.sentence}", clear)


def mission_feasibility(twin: Twin, now: float) -> HazardEstimate:
    """Evaluate the feasibility of the legs ahead for a fixed wing that follows its mission."""
    no_alert = HazardEstimate(AlertKind.NOT_ACHIEVABLE, 0.0, "", "the mission is achievable")
    _, position = twin.telemetry.history.rows_since("position", twin.telemetry.history.newest - 3.0)
    if not twin.vehicle_class.has_wings or twin.no_mission_reason() or is_hovering(twin) or not len(position):
        return no_alert
    assert twin.telemetry.origin is not None and twin.onboard.mission is not None
    if twin.onboard.mission.seq < twin.first_item:
        return no_alert
    p = to_ned(twin.telemetry.origin, *position[-1:].T)[0]
    route = cached_route(
        twin.onboard.mission.items,
        twin.onboard.mission.seq,
        twin.telemetry.origin,
        _params(twin),
        twin.first_item,
        jumps=twin.onboard.jumps_taken,
    )
    wind = np.array([*twin.environment.wind.wind[:2], twin.environment.wind.sigma])
    return feasibility_hazard(
        MissionState(now, p, twin.telemetry.origin, wind, route), read_limits(_params(twin), position[-1, 2] * 1e-3)
    )


def _params(twin: Twin) -> dict[str, float]:
    return twin.onboard.params.values if twin.onboard.params else {}
