"""How far to trust: answers as they come, a tube that learns to hold nine of ten, a horizon that holds."""

import numpy as np
import pytest

from tests.support import made_up
from tests.support.made_up import GROUP, LINE, V
from twin_worker.confidence import adaptive_conformal
from twin_worker.confidence.calibration.fit_table import fit
from twin_worker.confidence.prediction_log import CAPACITY
from twin_worker.confidence.table_files import TableSet
from twin_worker.confidence.tube_and_horizon import (
    AHEAD,
    EARLY_S,
    ERROR_LIMIT,
    ConfidenceTracker,
    PointForecast,
    axes_error,
    first_passage,
    path_length,
    track_frame,
)

TIMES = np.arange(-10, 1850) / 10.0
PLAIN = "paper/arduplane/fixed_wing/known"


def off(error: np.ndarray) -> np.ndarray:
    """The flown path at TIMES that misses LINE by `error`, (91, 3)."""
    return np.column_stack([np.interp(TIMES, AHEAD, c) for c in (LINE + error).T])


def moved(t: float) -> np.ndarray:
    """LINE from where it is at `t` [s]."""
    return LINE + np.array([V * t, 0.0, 0.0])


def kept(record: ConfidenceTracker, t: float = 0.0, group: str = PLAIN, path: np.ndarray = LINE) -> PointForecast:
    made = PointForecast(t, group.partition("/")[0], group, AHEAD[: len(path)], path, V)
    record.add(made, record.confidence_of(made))
    return made


def bare() -> ConfidenceTracker:
    return ConfidenceTracker(TableSet({}))


# --- first passage and the relative error ----------------------------------------------------------------------------


def test_first_passage_lies_between_the_points():
    relative = np.zeros(91)
    relative[10:] = 0.3
    relative[9] = 0.05
    assert first_passage(relative) == (pytest.approx(9.0 + (ERROR_LIMIT - 0.05) / 0.25), False)


def test_first_passage_is_the_first_and_never_is_censored():
    relative = np.zeros(91)
    relative[20], relative[40:] = 0.2, 0.9
    assert first_passage(relative) == (pytest.approx(19.5), False)
    assert first_passage(np.full(91, ERROR_LIMIT)) == (180.0, True)  # at the limit is not past it
    assert first_passage(np.full(91, 0.2)) == (0.0, False)


def test_the_relative_error_has_a_floor_of_two_seconds_of_flight_and_five_metres():
    assert path_length(LINE, V)[:4].tolist() == [40.0, 40.0, 40.0, 60.0]
    standing = np.zeros((5, 3))
    assert path_length(standing, 0.0).tolist() == [5.0] * 5  # position noise in hover
    assert path_length(LINE[::-1], V)[-1] == pytest.approx(180 * V)


def test_errors_along_across_and_down():
    east = np.column_stack([0 * AHEAD, V * AHEAD, 0 * AHEAD])
    error = axes_error(east, east + np.array([3.0, 4.0, 12.0]))
    assert np.allclose(error, [4.0, 3.0, 12.0, 13.0])
    assert np.allclose(track_frame(np.zeros((4, 3))), [1.0, 0.0])  # standing still: north, not nan


# --- answers as they come --------------------------------------------------------------------------------------------


def test_each_look_ahead_is_answered_as_soon_as_it_is_flown_and_once():
    record, flown = bare(), off(np.where(AHEAD[:, None] > 20.0, [0, 1e4, 0], 0.0))
    kept(record)
    assert np.isnan(record.coverage[0]) and record.coverage[1] == 0
    for until, held in ((0.5, None), (10.0, 1.0), (20.0, 1.0), (40.0, 0.5), (180.0, 20 / 90)):
        now = until + 1e-6 >= TIMES
        ended = record.evaluate(TIMES[now], flown[now])
        assert ended == (until == 180.0)
        if held is not None:
            assert record.coverage == (pytest.approx(held), 1)
    assert record.evaluate(TIMES, flown) == 0 and record.coverage[1] == 1 and not record.open_start_times


def test_in_steps_or_at_once_the_answer_is_the_same():
    rng, whole, steps = np.random.default_rng(3), bare(), bare()
    flown = off(np.cumsum(rng.standard_normal((91, 3)), axis=0))
    for record in (whole, steps):
        kept(record)
    whole.evaluate(TIMES, flown)
    for k in range(30, len(TIMES) + 1, 10):
        steps.evaluate(TIMES[k - 30 : k], flown[k - 30 : k])
    steps.evaluate(TIMES[-30:], flown[-30:])
    assert steps.coverage == whole.coverage
    assert steps.passages["paper"][0] == pytest.approx(whole.passages["paper"][0], abs=0.05)


@pytest.mark.parametrize("share", [0.2, 0.4])
def test_known_errors_give_known_first_passages(share):
    record = bare()
    kept(record)
    record.evaluate(TIMES, off(np.outer(np.clip(AHEAD - 10.0, 0, None) * V * share, [0, 1, 0])))
    ((time, censored),) = record.passages["paper"]
    # e = s V (t - 10), L = V (10 + (t - 10) sqrt(1 + s^2)) is 10 % of the flown path at t - 10 = 1 / (s - 0.1 root)
    assert not censored and time == pytest.approx(10.0 + 1.0 / (share - 0.1 * np.hypot(1, share)), abs=0.4)
    assert record.t10("paper") == (time, 0.0, 1) and record.t10("dynamics") == (None, None, 0)


def test_what_is_still_within_ten_percent_counts_once_it_is_a_minute_old():
    record = bare()
    kept(record)
    for until in (40.0, 75.0):
        record.evaluate(TIMES[until >= TIMES], off(0 * LINE)[until >= TIMES])
        assert record.t10("paper") == ((None, None, 0) if until < 60 else (72.0, 1.0, 1))
    assert len(record.open_start_times) == 1


def test_an_event_ends_predictions_where_they_are():
    record = bare()
    for t in np.arange(0.0, 60.0, 0.5):
        kept(record, float(t))
    assert len(record.open_start_times) == 12  # now and then
    record.evaluate(TIMES[TIMES <= 30.0], off(0 * LINE)[TIMES <= 30.0])
    record.censor_open()
    assert not record.open_start_times and record.scored == {"paper": 12}
    assert (30.0, True) in record.passages["paper"]
    assert record.evaluate(TIMES + 30.0, off(0 * LINE)) == 0


def test_a_hole_in_the_flown_path_gives_no_score_and_ends_the_wait_for_the_passage():
    record, hole = bare(), (TIMES < 20.05) | (TIMES > 30.05)
    kept(record)
    record.evaluate(TIMES[hole], off(np.where(AHEAD[:, None] > 50, [0, 1e4, 0], 0.0))[hole])
    assert record.passages["paper"][0] == (20.0, True)
    assert record.coverage[0] == pytest.approx((20 + 20) / 80)  # up to the hole, and from 31 to 50 s
    late = bare()
    kept(late)
    late.evaluate(TIMES[200:], off(0 * LINE)[200:])  # the path begins after the prediction
    assert late.passages["paper"][0] == (0.0, True)


def test_time_set_back_begins_anew():
    record = bare()
    kept(record, 1000.0)
    kept(record, 0.0)
    assert record.open_start_times == (0.0,)
    record.evaluate(TIMES, off(0 * LINE))
    assert record.coverage == (1.0, 1)


def test_memory_is_bounded():
    record = bare()
    for k in range(4 * CAPACITY):
        t = 5.0 * k
        kept(record, t, path=moved(t))
        at = t + np.arange(-3.0, 0.1, 0.5)
        record.evaluate(at, np.column_stack([V * at, 0 * at, 0 * at - 100.0]))
    assert len(record.open_start_times) <= 37 and record.coverage == (1.0, CAPACITY - 1)
    assert len(record.passages["paper"]) == 60 and record.scored["paper"] > 300


# --- the tube --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tables() -> TableSet:
    return TableSet({GROUP: fit(made_up.scored(10, 30, seed=1), GROUP)})


def flight(record: ConfidenceTracker, loud: np.ndarray, seed: int) -> np.ndarray:
    """Fly straight on, a prediction every 5 s, with errors so many times those of the tables' flights.

    Returns:
        share of look-aheads inside the tube drawn, horizon, first passage, and probability of an early one, (4, n)
    """
    rng, found = np.random.default_rng(seed), []
    for k, times in enumerate(loud):
        t, spread = 5.0 * k, made_up.spreads(rng)
        error = made_up.errors(rng, spread, times)
        made = PointForecast(t, "hybrid", GROUP, AHEAD, moved(t) - error, V, spread)
        trust = record.confidence_of(made)
        record.add(made, trust)
        miss = axes_error(made.path, made.path + error)
        passage, _ = first_passage(miss[:, 3] / path_length(LINE, V))
        found.append(
            (np.mean((miss[1:, :3] <= trust.tube[1:]).all(axis=1)), trust.horizon_s, passage, trust.early_exceedance)
        )
        at = t + np.arange(0.0, 5.1, 0.5)
        record.evaluate(at, np.column_stack([V * at, 0 * at, 0 * at - 100.0]))
    return np.array(found).T


def test_the_tube_holds_nine_of_ten_and_so_does_the_horizon(tables):
    inside, horizon, passage, _ = flight(ConfidenceTracker(tables), np.ones(300), seed=8)
    assert inside.mean() == pytest.approx(0.9, abs=0.03)
    assert np.mean(passage >= horizon) >= 0.9


@pytest.mark.parametrize(("times", "alone"), [(2.0, 0.75), (0.4, 0.97)])
def test_it_recovers_when_errors_change(tables, times, alone):
    record = ConfidenceTracker(tables)
    inside, horizon, passage, _ = flight(record, np.r_[np.ones(60), np.full(180, times)], seed=9)
    first, late = inside[60:70].mean(), inside[120:].mean()
    assert first < alone if times > 1 else first > alone
    assert late == pytest.approx(0.9, abs=0.04)
    assert np.mean(passage[120:] >= horizon[120:]) >= 0.88
    assert record.coverage[0] == pytest.approx(0.9, abs=0.05) and record.coverage[1] > 60


def test_calm_air_narrows_the_region_along_the_path_only(tables):
    """A wind that does not drift: errors along are a fifth of those of the tables' flights, the others as usual."""
    record = ConfidenceTracker(tables)
    inside, *_ = flight(record, np.tile([0.2, 1.0, 1.0], (150, 1)), seed=14)
    made = PointForecast(750.0, "hybrid", GROUP, AHEAD, moved(750), V, made_up.GROWTH)
    ratio = record.confidence_of(made).tube / ConfidenceTracker(tables).confidence_of(made).tube
    columns = np.searchsorted(AHEAD, [5, 16, 30, 60])
    assert (ratio[columns, 0] < 0.5).all() and (ratio[columns, 1:] > 0.75).all() and (ratio[columns, 1:] < 1.4).all()
    assert inside[75:].mean() == pytest.approx(0.9, abs=0.05)


@pytest.mark.parametrize("times", [0.3, 1.0, 5.0])
def test_untaught_it_learns_in_flight(times):
    inside, *_ = flight(ConfidenceTracker(TableSet({})), np.full(240, times), seed=10)
    assert inside[120:].mean() == pytest.approx(0.9, abs=0.06)


def test_short_look_aheads_speak_for_long_ones_before_those_are_answered(tables):
    record = ConfidenceTracker(tables)
    flight(record, np.full(12, 6.0), seed=11)  # a minute: nothing is known of 120 s yet
    made = kept(record, 60.0, GROUP, moved(60))
    trust = record.confidence_of(made)
    assert "adapted to 12 own predictions" in trust.sentence and GROUP in trust.sentence
    assert trust.tube[75, 0] > 1.3 * ConfidenceTracker(tables).confidence_of(made).tube[75, 0]


def test_groups_learn_apart(tables):
    record = ConfidenceTracker(tables)
    flight(record, np.full(60, 5.0), seed=12)
    made = PointForecast(400.0, "imm", "imm/none/fixed_wing/known", AHEAD, LINE, V)
    assert np.array_equal(record.confidence_of(made).tube, bare().confidence_of(made).tube)


# --- the horizon -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("times", [1.0, 4.0])
def test_an_early_error_is_as_probable_as_it_is_frequent(tables, times):
    _, _, passage, early = flight(ConfidenceTracker(tables), np.full(240, times), seed=15)
    happened = (passage[120:] < EARLY_S).mean()
    assert 0.02 < happened < 0.6 and early[120:].mean() == pytest.approx(happened, abs=0.08)


def test_the_horizon_tells_easy_minutes_from_hard_ones(tables):
    record = ConfidenceTracker(tables)
    easy, usual, hard = (
        PointForecast(0.0, "hybrid", GROUP, AHEAD, LINE, V, k * made_up.GROWTH) for k in (0.05, 1.0, 8.0)
    )
    horizons = [record.confidence_of(made).horizon_s for made in (easy, usual, hard)]
    assert horizons[0] == 180.0 and record.confidence_of(easy).horizon_open
    assert horizons[0] >= horizons[1] > 3 * horizons[2] and not record.confidence_of(hard).horizon_open


def test_first_passages_before_the_horizon_shorten_it(tables):
    record = ConfidenceTracker(tables)
    made = PointForecast(900.0, "hybrid", GROUP, AHEAD, LINE, V, 3.0 * made_up.GROWTH)
    before = record.confidence_of(made).horizon_s
    flight(record, np.full(150, 4.0), seed=13)
    assert record.confidence_of(made).horizon_s < 0.5 * before


def test_a_coasting_twin_counts_from_the_last_sample(tables):
    record = ConfidenceTracker(tables)
    late = PointForecast(0.0, "hybrid", GROUP, AHEAD + 100.0, moved(100.0), V, 0.02 * made_up.GROWTH)
    trust, fresh = (
        record.confidence_of(late),
        record.confidence_of(PointForecast(0.0, "hybrid", GROUP, AHEAD, LINE, V, 0.02 * made_up.GROWTH)),
    )
    assert np.isfinite(trust.tube).all() and (trust.tube[1:, 0] > fresh.tube[1:, 0]).all()
    assert 100.0 < trust.horizon_s <= 280.0


# --- nothing hostile -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", [0 * LINE, 1e30 * LINE, LINE[:5], np.tile([1e7, -1e7, 3.0], (91, 1))])
@pytest.mark.parametrize("spread", [None, np.nan, np.inf, -3.0, 0.0, 1e300])
@pytest.mark.parametrize("speed", [0.0, 1e6])
def test_whatever_it_is_given_tube_and_horizon_are_finite(tables, path, spread, speed):
    record = ConfidenceTracker(tables)
    n = len(path)
    for t in (0.0, 5.0, 10.0):
        given = None if spread is None else np.full((n, 3), spread)
        made = PointForecast(t, "hybrid", GROUP, AHEAD[:n], path, speed, given)
        trust = record.confidence_of(made)
        assert np.isfinite(trust.tube).all() and (trust.tube > 0).all()
        assert 0.0 <= trust.horizon_s <= AHEAD[n - 1]
        record.add(made, trust)
        at = t + np.arange(0.0, 5.1, 0.5)
        record.evaluate(at, 1e6 * np.column_stack([np.sin(at), np.cos(at), at]))
    assert np.isfinite(record.coverage[0]) and record.coverage[1] == 3


def test_too_little_flight_answers_nothing():
    record = bare()
    kept(record)
    for n in (0, 1):
        assert record.evaluate(TIMES[:n], off(0 * LINE)[:n]) == 0
    assert record.coverage[1] == 0


def test_another_grid_is_refused_with_a_sentence():
    record = bare()
    made = PointForecast(0.0, "paper", PLAIN, AHEAD + 3.0, LINE, V)
    with pytest.raises(
        ValueError, match=r"^prediction: found 91 look-aheads up to 183 s, expected the first 91 of AHEAD; resample it$"
    ):
        record.add(made, record.confidence_of(made))


def test_errors_that_outgrow_all_adaptation_are_held_less_often_and_the_prediction_says_so():
    """No coverage is guaranteed: levels and half-axes are bounded."""
    record, grown = bare(), 1.0
    assert "bound" not in record.confidence_of(PointForecast(0.0, "paper", PLAIN, AHEAD, LINE, V)).sentence
    for t in np.arange(0.0, 400.0, 5.0):
        kept(record, t, path=moved(t))
        grown *= 1.15
        at = np.arange(t - 3.0, t + 5.01, 0.1)
        flown = np.column_stack([V * at, np.full(len(at), grown * (-1.0) ** int(t / 5)), np.full(len(at), -100.0)])
        record.evaluate(at, flown)
    assert record.coverage[0] < 0.85
    said = record.confidence_of(PointForecast(400.0, "paper", PLAIN, AHEAD, moved(400.0), V)).sentence
    assert "adaptation is at its bound: coverage may be below the target" in said
    assert "whatever the flight does" not in (adaptive_conformal.__doc__ or "") and "Coverage is not guaranteed" in (
        adaptive_conformal.__doc__ or ""
    )


def test_another_origin_of_the_local_frame_is_no_path_flown():
    """The aircraft flies on at V; its positions are told from an origin 51 km away from t = 20 s on."""
    record, far = bare(), np.array([51e3, 0.0, 0.0])
    kept(record)
    line = np.column_stack([V * TIMES, 0 * TIMES, 0 * TIMES - 100.0])
    record.evaluate(TIMES[TIMES <= 20.0], line[TIMES <= 20.0])
    record.censor_open(frame_changed=True)
    kept(record, 20.0, path=moved(20.0) - far + [0.0, 100.0, 0.0])  # 100 m aside of where it flies
    for until in np.arange(21.0, 60.0):
        now = (until - 4.0 < TIMES) & (until >= TIMES)
        record.evaluate(TIMES[now], line[now] - far)
    assert record._log.exceeded[1] and record._log.followed[1] < 2.0


def test_renewed_predictions_are_scored_by_themselves_and_adapt_nothing():
    record = bare()
    assert record.extrapolated_coverage == (None, 0)
    line = np.column_stack([V * TIMES, 0 * TIMES, 0 * TIMES - 100.0])
    tube = np.full((91, 3), 5.0)
    for t in np.arange(0.0, 60.0, 0.5):  # every second one is 6 m aside from 10 s ahead on
        aside = np.where(AHEAD >= 10.0, 6.0, 0.0) * (
            len(record._extrapolated.t0[record._extrapolated.live]) % 2 if t else 0
        )
        record.add_extrapolated(t, "paper", moved(t) + np.outer(aside, [0.0, 1.0, 0.0]), tube)
    assert record.has_open and record.coverage[1] == 0
    for until in np.arange(1.0, 185.0):
        now = (until - 4.0 < TIMES) & (until >= TIMES)
        record.evaluate(TIMES[now], line[now])
    coverage, n = record.extrapolated_coverage
    assert n == 12 and coverage == pytest.approx((60.0 + 9.0) / 120.0, abs=0.01) and not record.has_open
    assert np.isnan(record.coverage[0]) and not record._levels and not record.scored
    record.add_extrapolated(10.0, "paper", moved(10.0), tube)  # the clock was set back
    assert record.extrapolated_coverage[1] == 0
