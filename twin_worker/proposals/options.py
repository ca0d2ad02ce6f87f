"""Options of a proposal: changes, predicted paths, figures, and one sentence each."""

from collections.abc import Iterable

import numpy as np

from fleet.contract import AlertKind, Array, Option, ProposedPath
from fleet.mission_jumps import JUMP
from twin_worker.prediction.multirotor.endurance import Z90
from twin_worker.proposals.assessment import Approach, closest_approach
from twin_worker.proposals.candidates import Candidate, Kind, Plan
from twin_worker.proposals.experiment import PlanExperiment
from twin_worker.proposals.resolution import Problem, Solution
from twin_worker.proposals.speeds import present_speed

_MAX_CLEARANCE_M = 1e5  # reported where nothing is near [m]
_MIN_DELAY_S = 0.5  # smaller delays are not mentioned [s]


def to_option(problem: Problem, solution: Solution, advantage: str, plans: dict[int, Plan], t: float) -> Option:
    """Return the option of a solution.

    Args:
        problem: the event that it avoids
        solution: changed plans
        advantage: in what it surpasses the other options
        plans: present plans, by id
        t: time of the proposal [s since 1970]
    """
    changes = [experiment.change for experiment in solution.experiments if experiment.change is not None]
    cost, (clearance, clearance_text) = solution.cost, _clearance(problem, solution)
    texts = [
        describe(experiment.candidate, plans[experiment.uav])
        for experiment in solution.experiments
        if experiment.candidate is not None
    ]
    delay = _delay_text(solution)
    sentence = f"{' and '.join(texts)}: {clearance_text}, {delay} ({advantage})"
    return Option(
        sentence=sentence,
        changes=tuple(changes),
        paths=tuple(to_path(experiment, t) for experiment in solution.experiments),
        probability=round(solution.probability, 3),
        clearance_m=round(clearance, 1),
        delay_s=round(cost.delay_s, 1),
        energy=round(cost.energy, 3),
        deviation_m=round(cost.deviation_m, 1),
    )


def to_path(experiment: PlanExperiment, t: float) -> ProposedPath:
    """Return the predicted path of an experiment, with look-aheads from the time `t` of the proposal [s since 1970]."""
    prediction = experiment.prediction
    ahead = prediction.ahead.numpy() + np.float32(prediction.t - t)
    return ProposedPath(
        uav=experiment.uav,
        origin=prediction.origin,
        ahead=Array.of(ahead),
        path=prediction.path,
        prediction_region_half_axes=prediction.prediction_region_half_axes,
    )


def describe(candidate: Candidate, plan: Plan) -> str:
    """Describe what an aircraft does, e.g. "UAV 7 climbs 40 m"."""
    name, value = f"UAV {candidate.uav}", candidate.value
    if candidate.kind is Kind.SPEED:
        verb = "slows down" if value < present_speed(plan.twin) else "speeds up"
        return f"{name} {verb} to {value:.0f} m/s"
    if candidate.kind is Kind.ALTITUDE:
        return f"{name} {'climbs' if value > 0 else 'descends'} {abs(value):.0f} m"
    if candidate.kind is Kind.DELAY:
        return f"{name} {'waits' if plan.twin.vehicle_class.is_rotorcraft else 'circles'} for {value:.0f} s"
    if candidate.kind is Kind.SKIP:
        return f"{name} leaves out item {value:.0f}"
    if candidate.kind is Kind.SHORTEN:
        last = f"its last {f'{value:.0f} waypoints' if value > 1 else 'waypoint'}" if value else ""
        repeats = "repetitions" if any(item.command == JUMP for item in plan.items) else ""
        return f"{name} leaves out {' and '.join(filter(None, (repeats, last)))}"
    if candidate.kind is Kind.SHRINK:
        return f"{name} stays within {value:.0f} m of home"
    if candidate.kind is Kind.DETOUR:
        return f"{name} passes the no-fly area on the {'right' if value > 0 else 'left'}"
    return f"{name} {candidate.kind.value}s" + (" to launch" if candidate.kind is Kind.RETURN else "")


def _delay_text(solution: Solution) -> str:
    delay = solution.cost.delay_s
    if any(kind in (Kind.HOLD, Kind.RETURN, Kind.LAND) for _, kind in solution.kinds):
        return "the mission is interrupted"
    if abs(delay) < _MIN_DELAY_S:
        return "without delay"
    return f"{abs(delay):.0f} s {'later' if delay > 0 else 'earlier'}"


def _clearance(problem: Problem, solution: Solution) -> tuple[float, str]:
    """Return the smallest distance to what is avoided [m], and its text."""
    own = next((one for one in solution.experiments if one.uav == problem.uav), solution.experiments[0])
    if problem.kind is AlertKind.CONFLICT:
        return _separation(problem, solution)
    if problem.kind is AlertKind.GROUND:
        height = own.margin_m.get(AlertKind.GROUND, 0.0)
        return height, f"stays {height:.0f} m above {'ground' if own.over_terrain else 'home'}"
    if problem.kind is AlertKind.BATTERY:
        return _MAX_CLEARANCE_M, _battery_text(own)
    if problem.kind is AlertKind.GEOFENCE:
        margin = own.margin_m.get(AlertKind.GEOFENCE, 0.0)
        return min(margin, _MAX_CLEARANCE_M), f"keeps {margin:.0f} m from the geofence"
    return _MAX_CLEARANCE_M, "every leg ahead is achievable"


def _battery_text(experiment: PlanExperiment) -> str:
    """Describe the battery at the end of a changed plan, or at home where no mission is flown to its end."""
    battery = experiment.battery
    if battery is None:
        return "battery unknown"
    share, sigma, where = battery.home, battery.home_sigma, "is at home with"
    if battery.end is not None:
        share, sigma, where = battery.end, battery.end_sigma or 0.0, "ends with"
    return f"{where} {100 * max(share, 0.0):.0f} ± {100 * Z90 * sigma:.0f} % of its battery"


def _separation(problem: Problem, solution: Solution) -> tuple[float, str]:
    """Return the closest approach within the cluster with the changed plans [m], and its text."""
    changed = {one.uav: one.forecast for one in solution.experiments}
    forecasts = {uav: changed.get(uav) or problem.airspace.forecasts[uav] for uav in sorted(problem.cluster)}
    nearest: tuple[Approach, int, int] | None = None
    for one, other in _pairs(problem.cluster):
        if one not in changed and other not in changed and {one, other} != {problem.uav, problem.other}:
            continue
        approach = closest_approach(forecasts[one], forecasts[other])
        if approach is not None and (nearest is None or approach.distance < nearest[0].distance):
            nearest = approach, one, other
    if nearest is None:
        return _MAX_CLEARANCE_M, "no conflict remains"
    approach, one, other = nearest
    first, second, above = (one, other, approach.above)
    if first not in changed:
        first, second, above = other, one, -approach.above
    limit = problem.airspace.separation.vertical
    if abs(above) >= limit and approach.distance < 1.5 * abs(above):
        where = f"{abs(above):.0f} m {'above' if above > 0 else 'below'}"
    else:
        where = f"{approach.distance:.0f} m from"
    subject = "passes" if len(changed) == 1 else f"UAV {first} passes"
    return approach.distance, f"{subject} {where} UAV {second}"


def _pairs(uavs: Iterable[int]) -> list[tuple[int, int]]:
    ordered = sorted(uavs)
    return [(one, other) for k, one in enumerate(ordered) for other in ordered[k + 1 :]]
