"""Resolution of conflicts: experiments with known paths, so that the right changes are known."""

from itertools import pairwise

import numpy as np
import pytest

from fleet.contract import AlertKind, Change
from tests.support.predicted import T, straight
from twin_worker.alerts.conflict_probability import Separation
from twin_worker.alerts.gaussian_forecast import to_gaussian
from twin_worker.proposals.assessment import Comparison, closest_approach
from twin_worker.proposals.candidates import Candidate, Kind
from twin_worker.proposals.experiment import PlanExperiment
from twin_worker.proposals.resolution import Airspace, Problem, pareto, solve

SPEED = 20.0
LEVEL = -100.0


def along(uav: int, turn: float, above: float = 0.0, speed: float = SPEED) -> PlanExperiment:
    """Fly through the origin after 60 s, on a course `turn` [rad], `above` the level [m]."""
    v = speed * np.array([np.cos(turn), np.sin(turn), 0.0])
    start = -60.0 * SPEED * np.array([np.cos(turn), np.sin(turn), 0.0]) + [0.0, 0.0, LEVEL - above]
    candidate, change = None, None
    if above:
        candidate, change = Candidate(uav, Kind.ALTITUDE, above), Change(uav=uav, seq=1)
    if speed != SPEED:
        candidate, change = Candidate(uav, Kind.SPEED, speed), Change(uav=uav, speed=speed)
    prediction = straight(uav, start, v, half=(8.0, 4.0, 4.0))
    return PlanExperiment(candidate, change, to_gaussian(prediction), {}, {})


def problem(present: list[PlanExperiment], owned: tuple[int, ...], others=()) -> Problem:
    forecasts = {one.uav: one.forecast for one in (*present, *others)}
    airspace = Airspace(forecasts, T, Separation())
    plans = {one.uav: one for one in present if one.uav in owned}
    comparisons = {uav: Comparison(one.prediction, np.zeros(3), True) for uav, one in plans.items()}
    first, second = present[0].uav, present[1].uav
    return Problem(AlertKind.CONFLICT, first, second, airspace, plans, comparisons, airspace.cluster((first, second)))


def lid(uav: int, above: float) -> PlanExperiment:
    """An aircraft on the course of the first, above or below it."""
    return along(uav, 0.0, above)


def test_one_change_is_preferred_to_two():
    given = problem([along(1, 0.0), along(2, 1.5)], (1, 2))
    offered = {1: [along(1, 0.0, 40.0), along(1, 0.0, 10.0)], 2: [along(2, 1.5, 10.0)]}
    solutions = solve(given, offered.__getitem__)
    assert [one.kinds for one in solutions] == [((1, Kind.ALTITUDE),)]
    assert solutions[0].probability < 0.05 and solutions[0].cost.deviation_m == pytest.approx(40.0, abs=0.1)


def test_two_share_a_change_that_neither_can_make_alone():
    given = problem([along(1, 0.0), along(2, 1.5)], (1, 2), [lid(4, 62.0), lid(5, -62.0)])
    offered = {
        1: [along(1, 0.0, 40.0), along(1, 0.0, 17.0)],  # the first would meet the aircraft above
        2: [along(2, 1.5, -17.0), along(2, 1.5, 17.0)],
    }
    solutions = solve(given, offered.__getitem__)
    assert solutions and all(len(one.experiments) == 2 for one in solutions)
    up, down = sorted(one.candidate.value for one in solutions[0].experiments)
    assert (up, down) == (-17.0, 17.0)
    assert solutions[0].cost.deviation_m == pytest.approx(17.0, abs=0.1)


def test_three_aircraft_are_separated_jointly():
    courses = {1: 0.0, 2: 2.0, 3: -2.0}
    given = problem([along(uav, turn) for uav, turn in courses.items()], (1, 2, 3))
    assert given.cluster == {1, 2, 3}
    offered = {uav: [along(uav, turn, dh) for dh in (-40.0, 40.0)] for uav, turn in courses.items()}
    solutions = solve(given, offered.__getitem__)
    assert solutions
    for solution in solutions:
        heights = dict.fromkeys(courses, 0.0) | {one.uav: one.candidate.value for one in solution.experiments}
        assert all(high - low >= 40.0 for low, high in pairwise(sorted(heights.values())))


def test_a_change_that_moves_the_conflict_to_another_aircraft_is_none():
    given = problem([along(1, 0.0), along(2, 1.5)], (1,), [lid(4, 40.0)])
    assert solve(given, {1: [along(1, 0.0, 40.0)]}.__getitem__) == []


def test_a_hazard_of_its_own_excludes_a_change():
    given = problem([along(1, 0.0), along(2, 1.5)], (1,))
    low = along(1, 0.0, -40.0)
    low.hazards[AlertKind.GROUND] = 0.6
    assert solve(given, {1: [low]}.__getitem__) == []


def test_a_hazard_of_the_present_plan_may_remain_but_not_grow():
    present = along(1, 0.0)
    present.hazards[AlertKind.NOT_ACHIEVABLE] = 0.9
    given = problem([present, along(2, 1.5)], (1,))
    same, worse = along(1, 0.0, 40.0), along(1, 0.0, 60.0)
    same.hazards[AlertKind.NOT_ACHIEVABLE] = 0.9
    worse.hazards[AlertKind.NOT_ACHIEVABLE] = 0.95
    (solution,) = solve(given, {1: [same, worse]}.__getitem__)
    assert solution.experiments == (same,)


def test_the_front_has_no_solution_that_another_surpasses():
    given = problem([along(1, 0.0), along(2, 1.5)], (1, 2))
    offered = {1: [along(1, 0.0, 40.0), along(1, 0.0, 60.0), along(1, 0.0, speed=14.0)], 2: [along(2, 1.5, 50.0)]}
    chosen = pareto(solve(given, offered.__getitem__))
    kinds = [solution.kinds for solution, _ in chosen]
    assert ((1, Kind.ALTITUDE),) in kinds and ((2, Kind.ALTITUDE),) in kinds and len(chosen) <= 3
    first = next(solution for solution, _ in chosen if solution.kinds == ((1, Kind.ALTITUDE),))
    assert first.experiments[0].candidate.value == 40.0
    assert len({advantage for _, advantage in chosen}) == len(chosen)


def test_the_cost_of_known_changes():
    present = along(1, 0.0)
    compare = Comparison(present.prediction, np.zeros(3), True)
    slow, high = (
        compare.cost(along(1, 0.0, **how).prediction, interrupts=False) for how in ({"speed": 16.0}, {"above": 40.0})
    )
    assert slow.delay_s == pytest.approx(36.0, abs=1.0)  # 180 s at 4 m/s less, flown at 20 m/s
    assert slow.deviation_m < 0.5 and slow.energy > 0.9
    assert high.delay_s == 0.0 and high.deviation_m == pytest.approx(40.0) and high.energy == pytest.approx(1.0)
    stopped = compare.cost(present.prediction, interrupts=True)
    assert stopped.delay_s == pytest.approx(180.0)


def test_the_closest_approach_of_crossing_paths():
    approach = closest_approach(along(1, 0.0).forecast, along(2, 1.5, 30.0).forecast)
    assert approach.distance == pytest.approx(30.0, abs=0.5) and approach.above == pytest.approx(-30.0, abs=0.5)
