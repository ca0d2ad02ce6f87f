"""Computational experiment: predict one aircraft with a changed plan, as its twin would after the change.

Each experiment flies a copy of the twin through the same closed loop as a prediction, with its ensemble: on the present
route for the time that a person needs to decide, then on the changed one. A multirotor changes its route at once, as
its kinematic model has no scheduled change.
"""

import copy
from collections.abc import Iterable
from dataclasses import dataclass
from math import atan2
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.special import ndtri

from fleet.autopilots.modes import ModeEntry
from fleet.contract import AlertKind, BatteryForecast, Change, Item, Mission, Prediction
from fleet.frames import to_ned
from fleet.mission import SPEED, Route
from twin_worker.alerts.gaussian_forecast import GaussianForecast, to_gaussian
from twin_worker.alerts.geofence import area_margin, ground_clearance, height_above_home
from twin_worker.alerts.hysteresis import RULES
from twin_worker.prediction.autopilot_parameters import SPEED_PARAMETERS, RouteOverride
from twin_worker.proposals.candidates import (
    DECISION_S,
    LAND_MODE,
    MODES,
    Candidate,
    Deficit,
    Plan,
    entered_area,
    to_change,
)
from twin_worker.twin.state.events import invalidate_prediction
from twin_worker.twin.state.routes import route_of_mode
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps.alerts import (
    battery_hazard,
    geofence,
    limit_hazards,
    lowest_beyond_reach,
    mission_feasibility,
    reach_s,
)
from twin_worker.twin.steps.kinematic_prediction import predict_battery, recent_track
from twin_worker.twin.steps.predict_step import LOOK_BACK_ROTORS_S, predict
from twin_worker.whatif import active_seq

LIMITS = (AlertKind.GROUND, AlertKind.GEOFENCE, AlertKind.NOT_ACHIEVABLE, AlertKind.BATTERY)
"""Hazards of one aircraft alone that an experiment assesses."""
_MARGIN_SHARE = 0.1  # probability aimed at, of that at which an alert is cleared [-]
_NO_ROUTE = "imm"  # method of a prediction from the turn rate alone: the change has no effect on it


@dataclass(frozen=True)
class PlanExperiment:
    """Prediction of one aircraft under a candidate change.

    Attributes:
        candidate: the change; None: the present plan
        change: what is sent to the aircraft; None: nothing
        forecast: its prediction on the common grid
        hazards: probabilities of ground, geofence, an infeasible mission and an empty battery
        margin_m: smallest distance to the minimum height and to the geofence within the look-ahead, by hazard [m]
        over_terrain: whether the heights are above terrain that is given, not above home
        battery: of a multirotor at the end of the changed plan and at home; None: not known
    """

    candidate: Candidate | None
    change: Change | None
    forecast: GaussianForecast
    hazards: dict[AlertKind, float]
    margin_m: dict[AlertKind, float]
    over_terrain: bool = False
    battery: BatteryForecast | None = None

    @property
    def prediction(self) -> Prediction:
        """Return the prediction."""
        return self.forecast.prediction

    @property
    def uav(self) -> int:
        """Return the aircraft."""
        return self.prediction.uav


def present(twin: Twin) -> PlanExperiment | None:
    """Predict the present plan of a twin now; None without a prediction on a route."""
    return _fly(_changeable(twin), None, None)


def run(plan: Plan, candidates: Iterable[Candidate]) -> list[PlanExperiment]:
    """Predict one aircraft under each candidate; omit candidates that its plan does not admit."""
    experiments = []
    for candidate in candidates:
        change = to_change(plan, candidate)
        experiment = None if change is None else run_change(plan, candidate, change)
        if experiment is not None:
            experiments.append(experiment)
    return experiments


def run_change(
    plan: Plan, candidate: Candidate | None, change: Change, after_s: float = DECISION_S
) -> PlanExperiment | None:
    """Predict one aircraft with a change that begins `after_s` from now [s]; None without a prediction on a route.

    A change that begins at 0 was executed: the current item and the mode are those that the aircraft reports.
    """
    twin = _changeable(plan.twin)
    if after_s and plan.is_circling(after_s) and not change.mode:
        if change.items is not None:
            return None  # the upload may begin the circle anew
        after_s = after_s if change.seq is not None else 0.0  # a speed alone does not
    _apply(twin, change, None if twin.vehicle_class.is_rotorcraft or not after_s else _Start(plan, after_s))
    return _fly(twin, candidate, change)


class _Start(NamedTuple):
    """A change that begins later, on the present plan."""

    plan: Plan
    after_s: float

    def mode_route(self, mode: str) -> Route | None:
        """Return the route of a mode that is entered then."""
        before, entry = self.plan.at(self.after_s - 0.5), self.plan.at(self.after_s)
        return route_of_mode(self.plan.twin, mode, entry, atan2(*(entry - before)[1::-1]))


def _changeable(twin: Twin) -> Twin:
    """Return a copy of a twin for one experiment; telemetry and models, which it only reads, are shared."""
    parts = {name: copy.deepcopy(getattr(twin, name)) for name in ("onboard", "prediction", "confidence", "alerts")}
    return msgspec.structs.replace(twin, budget=None, **parts)


def _fly(twin: Twin, candidate: Candidate | None, change: Change | None) -> PlanExperiment | None:
    """Predict a copy of a twin, to which the change was applied."""
    twin.prediction.forget_published()
    messages = predict(twin, twin.telemetry.history.newest)
    prediction = next((message for message in messages if isinstance(message, Prediction)), None)
    forecast = None if prediction is None else to_gaussian(prediction)
    if forecast is None or forecast.prediction.method == _NO_ROUTE:
        return None
    battery = _battery(twin, lands_here=change is not None and _lands_by_mode(change))
    _report_change(twin)
    hazards = [
        *limit_hazards(twin, forecast, to_the_end=True),
        mission_feasibility(twin, twin.telemetry.history.newest),
    ]
    hazards.append(battery_hazard(battery))
    probabilities = {hazard.kind: hazard.probability for hazard in hazards if hazard.kind in LIMITS}
    margins = _margins(twin, forecast)
    return PlanExperiment(candidate, change, forecast, probabilities, margins, twin.terrain is not None, battery)


def _battery(twin: Twin, *, lands_here: bool) -> BatteryForecast | None:
    """Predict the battery of a multirotor under its plan; a landing at the present position needs no return."""
    if twin.environment.battery_forecast is None:
        return None
    recent = recent_track(twin, LOOK_BACK_ROTORS_S, with_attitude=False)
    forecast = None if recent is None else predict_battery(twin, recent)
    if forecast is None or not lands_here or forecast.end is None:
        return forecast
    return msgspec.structs.replace(forecast, home=forecast.end, home_sigma=forecast.end_sigma or 0.0)


def _apply(twin: Twin, change: Change, start: _Start | None) -> None:
    """Change the plan of a copy; `start`: when it begins, None: now."""
    mode_route, mission = None, twin.onboard.mission
    if change.mode and not _lands_by_mode(change):
        mode_route = None if start is None else start.mode_route(MODES[change.mode])
        if mode_route is None and twin.mode == MODES[change.mode]:
            return
        if mode_route is None:
            _enter_mode(twin, MODES[change.mode])
            return
    present = mission.items if mission is not None else ()
    items, seq = change.items or present, active_seq(twin)
    jumps = twin.onboard.jumps_taken if change.items is None else {}
    if _lands_by_mode(change):
        items, seq = _landing_here(twin)
    parameters = {} if change.speed is None else dict.fromkeys(SPEED_PARAMETERS, change.speed)
    if change.speed is not None:  # in place of the speed commanded so far; later items of the mission command theirs
        items = tuple(
            msgspec.structs.replace(item, param2=change.speed) if item.command == SPEED and item.seq < seq else item
            for item in items
        )
    after_s = 0.0
    if start is not None:
        seq, after_s = start.plan.seq_after(change, start.after_s), start.after_s
    restart = start is not None or items != present or _lands_by_mode(change)
    twin.prediction.set_override(
        RouteOverride(items, seq, parameters, restart, None, twin.first_item, jumps, after_s, mode_route)
    )
    twin.confidence.tracker.censor_open()  # earlier predictions flew another plan


def _lands_by_mode(change: Change) -> bool:
    return change.mode != "" and MODES[change.mode] == LAND_MODE


def _landing_here(twin: Twin) -> tuple[tuple[Item, ...], int]:
    """Return a mission that lands at the present position, and its item to fly to."""
    lat, lon, _ = (int(x) for x in twin.telemetry.history.rows("position")[1][-1])
    first, home = twin.first_item, twin.home
    land = Item(seq=first, command=21, lat_e7=lat, lon_e7=lon)
    if home is None or not first:
        return (land,), first
    lat, lon, alt_mm = home
    return (Item(seq=0, command=16, frame=0, lat_e7=lat, lon_e7=lon, alt_m=alt_mm * 1e-3), land), first


def _enter_mode(twin: Twin, mode: str) -> None:
    """Enter a mode now, as when the autopilot reports it."""
    now, status = twin.telemetry.history.newest, twin.onboard.status
    _, positions = twin.telemetry.history.rows("position")
    _, velocities = twin.telemetry.history.rows("velocity")
    assert status is not None
    twin.onboard.set_status(msgspec.structs.replace(status, mode=mode))
    lat, lon, alt = (float(x) for x in positions[-1])
    twin.onboard.enter_mode(ModeEntry(now, (lat, lon, alt), atan2(velocities[-1, 1], velocities[-1, 0])))
    invalidate_prediction(twin, None, now)


def _report_change(twin: Twin) -> None:
    """Store mission and parameters of the override as reported, for the alerts that read them."""
    override = twin.prediction.override
    if override is None:
        return
    now = twin.telemetry.history.newest
    known = twin.onboard.mission or Mission(uav=twin.config.uav, t=now)
    mission = msgspec.structs.replace(known, t=now, items=override.items, seq=override.seq, complete=True)
    twin.onboard.set_mission(mission, twin.first_item)
    if twin.onboard.params is not None:
        values = twin.onboard.params.values
        changed = {name: value for name, value in override.parameters.items() if name in values}
        twin.onboard.set_params(msgspec.structs.replace(twin.onboard.params, values=values | changed))


class _Extremes(NamedTuple):
    """Extremes of the mean path, each with its standard deviation [m].

    Attributes:
        low: lowest height above the terrain, or above home where the terrain is unknown
        floor: lowest height above home
        high: highest height above home
        far: largest distance from home
        later: lowest mean height above the terrain beyond that look-ahead [m]
    """

    low: tuple[float, float]
    floor: tuple[float, float]
    high: tuple[float, float]
    far: tuple[float, float]
    later: float


def _extremes(twin: Twin, forecast: GaussianForecast) -> _Extremes:
    """Return the extremes of a forecast within the look-ahead of the ground and geofence alerts."""
    assert twin.home is not None
    until = forecast.prediction.t + reach_s(twin, forecast.prediction)
    k = max(int(np.searchsorted(forecast.t, until, side="right")), 1)
    home = to_ned(forecast.prediction.ned_origin(), *(np.array([float(x)]) for x in twin.home))[0]
    distance = np.hypot(*(forecast.path[:k] - home)[:, :2].T)
    height, sigma = height_above_home(forecast, twin.home)[:k], forecast.sigma
    low, high, far = int(height.argmin()), int(height.argmax()), int(distance.argmax())
    clearance = ground_clearance(forecast, twin.home, twin.terrain, until)
    near = int(clearance.height.argmin())
    sigma_far = float(sigma[far, :2].max())
    return _Extremes(
        (float(clearance.height[near]), float(clearance.sigma[near])),
        (float(height[low]), float(sigma[low, 2])),
        (float(height[high]), float(sigma[high, 2])),
        (float(distance[far]), sigma_far),
        lowest_beyond_reach(twin, forecast),
    )


def _margins(twin: Twin, forecast: GaussianForecast) -> dict[AlertKind, float]:
    """Return the lowest height above ground of the mean path, and its smallest distance to the geofence [m]."""
    if twin.home is None:
        return {}
    extremes, fence = _extremes(twin, forecast), geofence(twin)
    inside = min(
        fence.radius - extremes.far[0],
        fence.ceiling - extremes.high[0],
        extremes.floor[0] - fence.floor,
        area_margin(forecast, fence, forecast.prediction.t + reach_s(twin, forecast.prediction)),
    )
    return {AlertKind.GROUND: min(extremes.low[0], extremes.later), AlertKind.GEOFENCE: inside}


def deficit(plan: Plan, experiment: PlanExperiment, kind: AlertKind) -> Deficit:
    """Return by how much the present plan violates the limits of an alert, with the uncertainty of the prediction.

    The margin is such that the probability falls to a tenth of that at which the alert is cleared.
    """
    if kind not in (AlertKind.GROUND, AlertKind.GEOFENCE) or plan.twin.home is None:
        return Deficit()
    extremes, z = _extremes(plan.twin, experiment.forecast), -float(ndtri(_MARGIN_SHARE * RULES[kind].clear_below))
    (low, sigma_low), (floor, sigma_floor), (high, sigma_high), (far, sigma_far), later = extremes
    if kind is AlertKind.GROUND:
        return Deficit(plan.min_height_m + max(z * sigma_low - low, -later, -plan.min_height_m))
    fence = geofence(plan.twin)
    too_high = min(fence.ceiling - z * sigma_high - high, 0.0)
    too_low = max(fence.floor + z * sigma_floor - floor, 0.0)
    overshoot = far - (fence.radius - z * sigma_far)
    radius = fence.radius - overshoot - z * sigma_far if overshoot > 0 else np.inf
    return Deficit(too_low or too_high, radius, _distance_around(plan, experiment.forecast, z))


def _distance_around(plan: Plan, forecast: GaussianForecast, z: float) -> float:
    """Return the distance to keep from the no-fly area that is entered, `z` standard deviations there; else nan [m]."""
    area = entered_area(plan)
    if area is None:
        return np.nan
    n = max(int(np.searchsorted(forecast.t, forecast.prediction.t + reach_s(plan.twin, forecast.prediction))), 1)
    depth = area.depth(forecast.path[:n], forecast.prediction.ned_origin())
    k = int((depth > 0.0).argmax()) if depth.max() > 0.0 else int(depth.argmax())  # where it is entered, or nearest
    keep = z * float(forecast.sigma[k, :2].max())
    return keep if depth[k] > -keep else np.nan
