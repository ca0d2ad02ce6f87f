"""How far to trust: first passage, the relative error's floor, a tube that learns to hold nine of ten."""

import numpy as np
import pytest

from twin_worker.horizon import AHEAD, LIMIT, Made, Record, axes_error, first_passage, path_length, track_frame

V = 20.0
LINE = np.column_stack([V * AHEAD, 0 * AHEAD, 0 * AHEAD - 100.0])
TIMES = np.arange(0.0, 61.5, 0.1)


def off(path: np.ndarray, error: np.ndarray) -> np.ndarray:
    """The flown path at TIMES that misses `path` by `error`, both (61, 3)."""
    return np.column_stack([np.interp(TIMES, AHEAD, c) for c in (path + error).T])


def kept(record: Record, t: float = 0.0, method: str = "paper") -> Made:
    made = Made(t, method, LINE, record.tube(method), V)
    record.keep(made)
    return made


def scored(record: Record, error: np.ndarray, method: str = "paper") -> None:
    kept(record, 0.0, method)
    assert record.answer(TIMES, off(LINE, error)) == 1


# --- first passage and the relative error ----------------------------------------------------------------------------


def test_first_passage_lies_between_the_points():
    relative = np.zeros(61)
    relative[10:] = 0.3
    relative[9] = 0.05
    assert first_passage(relative) == (pytest.approx(9.0 + (LIMIT - 0.05) / 0.25), False)


def test_first_passage_is_the_first_and_never_is_censored():
    relative = np.zeros(61)
    relative[20], relative[40:] = 0.2, 0.9
    assert first_passage(relative) == (pytest.approx(19.5), False)
    assert first_passage(np.full(61, LIMIT)) == (60.0, True)  # at the limit is not past it
    assert first_passage(np.full(61, 0.2)) == (0.0, False)


def test_the_relative_error_has_a_floor_of_two_seconds_of_flight():
    assert path_length(LINE, V)[:4].tolist() == [40.0, 40.0, 40.0, 60.0]
    standing = np.zeros((5, 3))
    assert path_length(standing, 0.0).tolist() == [1.0] * 5  # never a division by nothing
    assert path_length(LINE[::-1], V)[-1] == pytest.approx(60 * V)


def test_errors_along_across_and_down():
    east = np.column_stack([0 * AHEAD, V * AHEAD, 0 * AHEAD])
    error = axes_error(east, east + np.array([3.0, 4.0, 12.0]))
    assert np.allclose(error, [4.0, 3.0, 12.0, 13.0])
    assert np.allclose(track_frame(np.zeros((4, 3))), [1.0, 0.0])  # standing still: north, not nan


# --- scoring ---------------------------------------------------------------------------------------------------------


def test_a_prediction_is_scored_once_and_only_when_flown():
    record = Record()
    kept(record)
    assert record.answer(TIMES[:-20], off(LINE, 0 * LINE)[:-20]) == 0 and record.held[1] == 0
    assert record.answer(TIMES, off(LINE, 0 * LINE)) == 1
    assert record.answer(TIMES, off(LINE, 0 * LINE)) == 0
    assert record.held == (1.0, 1)
    assert record.t10("paper") == (60.0, 1.0, 1)  # never past 10 %: censored


def test_known_errors_give_known_first_passages():
    record = Record()
    assert record.t10("paper") == (None, None, 0) and np.isnan(record.held[0])
    for share in (0.2, 0.4):  # crosses 10 % where share * t V > 0.1 path, from the first steps on
        scored(record, np.outer(np.clip(AHEAD - 10.0, 0, None) * V * share, [0, 1, 0]))
    scored(record, 0 * LINE)
    median, censored, n = record.t10("paper")
    assert n == 3 and censored == pytest.approx(1 / 3)
    # e = s V (t - 10), L = V (10 + (t - 10) sqrt(1 + s^2)) is 10 % of the flown path at t - 10 = 1 / (s - 0.1 root)
    assert median == pytest.approx(10.0 + 1.0 / (0.2 - 0.1 * np.sqrt(1.04)), abs=0.4)


def test_a_hole_in_the_flown_path_gives_no_score():
    record = Record()
    kept(record)
    hole = (TIMES < 20.0) | (TIMES > 30.0)
    record.answer(TIMES[hole], off(LINE, 0 * LINE)[hole])
    assert record.held[1] == 0 and not record.waiting
    kept(record)
    record.answer(TIMES[30:], off(LINE, 0 * LINE)[30:])  # the path begins after the prediction
    assert record.held[1] == 0 and record.t10("paper")[2] == 0


def test_predictions_are_kept_now_and_then_and_forgotten_at_an_event():
    record = Record()
    for t in np.arange(0.0, 60.0, 0.5):
        kept(record, float(t))
    assert 3 <= len(record.waiting) <= 20
    record.forget()
    assert record.answer(TIMES + 30.0, off(LINE, 0 * LINE)) == 0


# --- the tube --------------------------------------------------------------------------------------------------------


def calibrated(scale: float, n: int = 160, seed: int = 4) -> tuple[list[float], Record]:
    """Fly n times with errors of a known law; give the share of each flight inside the tube drawn before it."""
    rng, record, inside = np.random.default_rng(seed), Record(), []
    growth = scale * (0.3 + 0.05 * AHEAD**1.5)[:, None]
    for _ in range(n):
        error = growth * rng.standard_normal(3) * [1.0, 0.6, 0.3]
        tube = record.tube("paper")
        inside.append(float((axes_error(LINE, LINE + error)[1:, :3] <= tube[1:]).all(axis=1).mean()))
        scored(record, error)
    return inside, record


@pytest.mark.parametrize("scale", [0.2, 1.0, 5.0])
def test_the_tube_learns_to_hold_nine_of_ten(scale):
    inside, record = calibrated(scale)
    late = np.array(inside[60:])
    assert 0.85 <= late.mean() <= 0.985
    assert 0.85 <= (late >= 0.9).mean() <= 0.985  # flights of which nine tenths lie inside
    assert record.held[0] == pytest.approx(np.mean(inside[-60:]), abs=0.02)


def test_the_tube_is_as_wide_as_the_errors_were():
    wide, narrow = (calibrated(scale)[1].tube("paper")[30] for scale in (5.0, 0.2))
    assert (wide > 8 * narrow).all()


@pytest.mark.parametrize("method", ["dynamics", "paper", "copter", "greybox", "imm"])
def test_the_tube_is_finite_and_grows_before_and_after_scoring(method):
    record = Record()
    for _ in range(3):
        for ahead in (AHEAD, np.arange(0.0, 200.0)):
            tube = record.tube(method, ahead)
            assert tube.shape == (len(ahead), 3)
            assert np.isfinite(tube).all() and (tube > 0).all()
            assert (np.diff(tube, axis=0) >= 0).all()
        bump = np.exp(-(((AHEAD - 20) / 5) ** 2))  # errors that shrink again
        scored(record, np.outer(bump, [2e3, 2e3, 2e3]), method)


def test_methods_learn_apart():
    record = Record()
    before = record.tube("imm")
    for _ in range(5):
        scored(record, np.outer(AHEAD, [5.0, 5.0, 5.0]))
    assert np.array_equal(record.tube("imm"), before)
    assert (record.tube("paper")[30] > Record().tube("paper")[30]).all()


# --- the horizon -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("slope", [0.15, 0.3])
def test_the_horizon_learns_when_nine_of_ten_were_still_within_a_tenth(slope):
    rng, record = np.random.default_rng(6), Record()
    times = rng.uniform(5.0, 40.0, 60)
    for begin in times:
        scored(record, np.outer(np.clip(AHEAD - begin, 0, None) * V * slope, [0, 1, 0]))
    found = [time for time, _ in record.passages["paper"]]
    horizon, open_end = record.horizon("paper")
    assert not open_end
    assert np.quantile(found, 0.03) <= horizon <= np.quantile(found, 0.15)  # the lower side, a prior among them


def test_perfect_predictions_open_the_horizon_in_the_end():
    record = Record()
    before, _ = record.horizon("paper")
    for _ in range(60):
        scored(record, 0 * LINE)
    assert 0 < before < record.horizon("paper")[0] == AHEAD[-1] and record.horizon("paper")[1]
    assert record.horizon("imm")[0] <= before  # methods learn apart
