"""Scores of predictions: perfect, off by a known amount, censored; quantiles, coverage, horizon, comparison."""

import numpy as np
import pytest

from fleet.contract import Status
from tests.support import flights as f
from tests.support.flights import HERE, T0
from twin_worker.evaluation.scoring.compare import BEATEN, MATCHED, ONE_FLIGHT, WORSE, compare
from twin_worker.evaluation.scoring.log import OURS, EvaluationCase, EvaluationStart, MethodForecast, ReferenceFlight
from twin_worker.evaluation.scoring.score import LIMITS, passage_quantile, score_method, survival_at
from twin_worker.evaluation.scoring.summary import method_figures, summarise

V = 20.0
AHEAD = np.concatenate([np.arange(0.0, 61.0), np.arange(64.0, 93.0, 4.0)])  # steps that widen
EAST = np.column_stack([0 * AHEAD, V * AHEAD, 0 * AHEAD])
TUBE = np.tile([8.0, 4.0, 2.0], (len(AHEAD), 1))


def case(flight: str = "a", apart: str = "", flown: np.ndarray = EAST, **paths: np.ndarray) -> EvaluationCase:
    """A start flown due east at `V`; ours claims a tube and a horizon of 30 s."""
    told = {
        name: MethodForecast(path, name, TUBE if name == OURS else None, 30.0 if name == OURS else np.nan)
        for name, path in paths.items()
    }
    nothing = np.full((len(AHEAD), 3), np.nan)
    asked = EvaluationStart(flight, 1, 0.0, 200.0, AHEAD, HERE, V, "", "g", told, nothing)
    return EvaluationCase(asked, flown, np.maximum(V * AHEAD, 2 * V), "level", np.empty((0, 3)), apart)


def off(*error: float) -> np.ndarray:
    return EAST - np.array(error)


# --- one method ------------------------------------------------------------------------------------------------------


def test_a_perfect_prediction_is_never_wrong():
    found = method_figures(score_method([case(ours=EAST)] * 3, OURS))
    for name in ("m1_t10_lq_s", "m1_t10_median_s", "m1_t5_lq_s", "m1_t3_lq_s", "m2_t10_lq_s"):
        assert found[name] == AHEAD[-1]
    assert found["survive_60"] == 1.0 and found["starts"] == 3 and found["flights"] == 1
    assert set(found["p50_m"].values()) == {0.0} and set(found["coverage"].values()) == {1.0}
    assert found["half_axes_m"]["60"] == [8.0, 4.0, 2.0]
    assert list(found["p50_m"]) == ["5", "10", "16", "30", "60"]  # 120 s is beyond what was predicted


def test_a_known_offset_is_told_by_axis_and_passes_the_tighter_limits_at_once():
    one = score_method([case(ours=off(3.0, 0.0, 0.0))], OURS)  # north of the path: to the left of it
    assert np.allclose(one.error[0], [0.0, -3.0, 0.0]) and np.allclose(one.distance, 3.0)
    assert one.passages[0.10].tolist() == [[AHEAD[-1], 1.0]]  # 3 m of at least 40 m
    assert one.passages[0.05].tolist() == [[0.0, 0.0]] and one.passages[0.03].tolist() == [[0.0, 0.0]]
    assert np.allclose(score_method([case(ours=off(0.0, 6.0, 5.0))], OURS).error, [6.0, 0.0, 5.0])
    assert not score_method([case(ours=off(0.0, 9.0, 0.0))], OURS).inside.any()  # 9 m along, the half-axis is 8 m


def test_a_speed_error_passes_when_its_share_of_the_path_says_so():
    slow = EAST * 0.88  # 12 % of the path: at 10 % of 40 m it is past the limit, 40 m being two seconds
    assert score_method([case(ours=slow)], OURS).passages[0.10][0, 0] == pytest.approx(0.1 * 2 / 0.12, abs=0.05)
    assert score_method([case(ours=EAST * 0.92)], OURS).passages[0.10][0].tolist() == [AHEAD[-1], 1.0]


def test_displacement_is_the_stricter_measure_in_a_circle():
    angle = 2 * np.pi * AHEAD / 60.0
    circle = 60.0 * np.column_stack([np.sin(angle), 1 - np.cos(angle), 0 * angle])
    one = score_method([case(flown=circle, ours=circle + np.outer(AHEAD / 60.0, (7.0, 0.0, 0.0)))], OURS)
    assert one.passages[0.10][0, 1] == 1.0  # 7 m of a long way round
    assert (
        one.m2_passages[0, 1] == 0.0 and 50.0 < one.m2_passages[0, 0] < 60.0
    )  # back at the start, 7 m of nearly nothing


def test_what_was_not_followed_counts_for_nothing():
    known = np.where((AHEAD > 70.0)[:, None], np.nan, EAST)
    known[20] = np.nan  # a hole
    one = score_method([case(flown=known, ours=EAST)], OURS)
    assert one.passages[0.10].tolist() == [[68.0, 1.0]]
    assert np.isnan(one.inside[0, 20]) and np.isnan(one.inside[0, -1]) and one.inside[0, 60] == 1.0


# --- quantiles of censored times -------------------------------------------------------------------------------------


def test_quantiles_are_those_of_kaplan_and_meier():
    """The remission times of Freireich 1963, 6-MP arm, weeks; + censored. The median is 23, as in every textbook."""
    weeks = "6 6 6 6+ 7 9+ 10 10+ 11+ 13 16 17+ 19+ 20+ 22 23 25+ 32+ 32+ 34+ 35+"
    found = np.array([(float(w.strip("+")), float(w.endswith("+"))) for w in weeks.split()])
    shuffled = np.random.default_rng(0).permutation(found)
    assert passage_quantile(shuffled, 0.5) == 23.0 and passage_quantile(shuffled, 0.25) == 13.0
    assert passage_quantile(shuffled, 0.9) == 35.0  # never reached: the longest followed
    assert np.isnan(passage_quantile(found[:0], 0.5)) and np.isnan(survival_at(found[:0], 60.0))


def test_without_censoring_the_quantile_is_the_plain_one():
    times = np.random.default_rng(1).uniform(0, 60, 101)
    found = np.column_stack([times, 0 * times])
    assert passage_quantile(found, 0.25) == pytest.approx(np.percentile(times, 25))
    assert survival_at(found, 30.0) == np.mean(times >= 30)


# --- trust -----------------------------------------------------------------------------------------------------------


def test_coverage_is_pooled_and_of_the_worst_flight():
    cases = [case("a", ours=EAST)] * 3 + [case("b", ours=off(5.0, 0.0, 0.0))]
    found = method_figures(score_method(cases, OURS))
    assert found["coverage"]["30"] == 0.75 and found["coverage_worst_flight"]["30"] == 0.0


def test_a_horizon_holds_where_the_error_stayed_below_ten_per_cent_until_then():
    late = EAST.copy()
    late[AHEAD > 40] *= 0.5
    early = EAST.copy()
    early[AHEAD > 10] *= 0.5
    found = method_figures(score_method([case(ours=late), case(ours=EAST), case(ours=early)], OURS))
    assert found["horizon_hit_rate"] == pytest.approx(2 / 3, abs=1e-3)
    assert found["horizon_rank_corr"] is None  # one and the same horizon ranks nothing
    assert method_figures(score_method([case(cv=EAST)], "cv"))["horizon_hit_rate"] is None


def test_the_horizon_of_better_predictions_ranks_higher():
    cases = []
    for passes, horizon in ((10, 8.0), (20, 15.0), (40, 30.0), (90, 50.0)):
        path = np.where((passes < AHEAD)[:, None], 0.5, 1.0) * EAST
        told = {OURS: MethodForecast(path, OURS, TUBE, horizon)}
        one = case(ours=EAST)
        cases.append(
            EvaluationCase(
                EvaluationStart(**(vars(one.start) | {"forecasts": told})),
                one.positions,
                one.length,
                "level",
                one.route,
                "",
            )
        )
    assert method_figures(score_method(cases, OURS))["horizon_rank_corr"] == 1.0


# --- comparison ------------------------------------------------------------------------------------------------------


def pairs(gain: float, flights: int = 6, seed: int = 0) -> dict:
    """Starts of flights that differ, whose other method is off by `gain` metres more than ours, and by noise."""
    rng, cases = np.random.default_rng(seed), []
    for flight in "abcdefgh"[:flights]:
        wide = rng.uniform(20.0, 40.0)
        for _ in range(8):
            ours, other = wide + rng.uniform(-3, 3, 2) + [0.0, gain]
            cases.append(case(flight, ours=off(ours, 0.0, 0.0), cv=off(other, 0.0, 0.0)))
    return compare({name: score_method(cases, name) for name in (OURS, "cv")})["cv"]


def test_a_real_gain_is_told_from_none_and_from_a_loss():
    won = pairs(gain=10.0)["p50_16_m"]
    assert won["verdict"] == BEATEN and won["low"] <= won["difference"] <= won["high"] < 0
    assert won["difference"] == pytest.approx(-10.0, abs=2.0)
    assert pairs(gain=0.0)["p50_16_m"]["verdict"] == MATCHED
    assert pairs(gain=-10.0)["p50_60_m"]["verdict"] == WORSE
    assert pairs(gain=10.0)["skill_16"] == pytest.approx(0.25, abs=0.08)


def test_longer_within_the_limit_is_better():
    cases = [case(flight, ours=EAST, cv=EAST * 0.8) for flight in "abc" for _ in range(3)]
    told = compare({name: score_method(cases, name) for name in (OURS, "cv")})["cv"]["t10_s"]
    assert told["verdict"] == BEATEN and told["difference"] == pytest.approx(59.0, abs=0.1)  # up to 60 s


def test_one_flight_has_no_interval():
    told = pairs(gain=10.0, flights=1)["p50_16_m"]
    assert told["verdict"] == ONE_FLIGHT and told["low"] is None and told["difference"] < 0


# --- all of it -------------------------------------------------------------------------------------------------------


def test_the_summary_counts_what_counts_and_tells_the_rest_apart():
    told = summarise([case(ours=EAST, cv=off(3, 0, 0)), case(ours=EAST, apart="on the ground")])
    assert told[OURS]["starts"] == told["cv"]["starts"] == 1
    assert told["apart"] == {"on the ground": {"starts": 1, "m1_t10_lq_s": AHEAD[-1], "followed_s": AHEAD[-1]}}
    assert told[OURS]["phases"]["level"]["starts"] == 1 and set(told["compare"]) == {"cv"}
    assert summarise([]) == {"compare": {}, "apart": {}}


def test_every_limit_is_scored():
    assert sorted(score_method([case(ours=EAST)], OURS).passages) == sorted(LIMITS)


def test_a_new_target_in_guided_is_an_event():
    reference = ReferenceFlight()
    for k, (mode, north) in enumerate((("AUTO", 0), ("GUIDED", 900), ("GUIDED", 900), ("GUIDED", 5000))):
        reference.add(Status(uav=1, t=T0 + k, mode=mode))
        place = np.array([[470_000_000 + north, 80_000_000, 600_000]])
        reference.add(f.sample(1, T0 + k + 0.5, target=(np.array([T0 + k + 0.5]), place)))
    assert [(t - T0, reason) for t, reason in reference.events] == [(1.0, "mode changed"), (3.5, "target changed")]


def test_a_censored_start_counts_up_to_its_end() -> None:
    passages = np.array([[20.0, 1.0], [10.0, 0.0], [60.0, 1.0], [60.0, 1.0]])
    assert survival_at(passages, 60.0) == pytest.approx(0.75)  # one of four passed; the one censored at 20 s drops out
    assert survival_at(np.array([[20.0, 1.0], [30.0, 0.0], [60.0, 1.0]]), 60.0) == pytest.approx(0.5)
    assert np.isnan(survival_at(np.array([[20.0, 1.0], [10.0, 0.0]]), 60.0))
    assert survival_at(np.array([[20.0, 0.0], [10.0, 1.0]]), 60.0) == 0.0
