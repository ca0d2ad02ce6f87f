"""Intervals of rates, scores of stated probabilities, and force predictions that the examiner repeats."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleet.blind_test.examiner import check_forces, held_out_gain, measured_force
from fleet.blind_test.mark import grade, score, score_rows
from fleet.blind_test.rates import Statement, median_interval, poisson, score_probabilities, wilson
from tests.fleet.blind_test.test_inject import record


def test_a_wilson_interval_is_that_of_the_books() -> None:
    interval = wilson(8, 10)
    assert interval is not None and interval == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert wilson(0, 0) is None
    never = wilson(0, 60)
    assert (
        never is not None
        and never.low == pytest.approx(0.0, abs=1e-12)
        and never.high == pytest.approx(0.0602, abs=1e-4)
    )


def test_a_count_per_flight_has_the_interval_of_a_poisson_mean() -> None:
    assert poisson(0, 10) == pytest.approx((0.0, 0.3689), abs=1e-4)
    assert poisson(4, 16) == pytest.approx((1.0899 / 16, 10.2416 / 16), abs=1e-4)
    assert poisson(0, 0) is None


def test_a_median_lies_in_its_interval_as_often_as_promised() -> None:
    rng = np.random.default_rng(1)
    within = 0
    for _ in range(400):
        interval = median_interval(rng.exponential(size=25).tolist())
        assert interval is not None
        within += interval.low <= np.log(2.0) <= interval.high
    assert 0.94 < within / 400 < 0.995
    assert median_interval([1.0] * 5) is None


def test_calibrated_probabilities_have_no_calibration_error_and_boasts_have_one() -> None:
    rng = np.random.default_rng(2)
    p = rng.random(4000)
    honest = score_probabilities([Statement(float(x), bool(rng.random() < x)) for x in p])
    boasting = score_probabilities([Statement(0.99, bool(k % 2)) for k in range(200)])
    assert honest is not None and honest.calibration_error < 0.03 and honest.brier == pytest.approx(1 / 6, abs=0.01)
    assert boasting is not None and boasting.calibration_error == pytest.approx(0.49) and len(boasting.bins) == 1
    assert honest.calibration_error < honest.calibrated_limit < 0.03 and boasting.calibrated_limit < 0.03
    assert sum(one.n for one in honest.bins) == 4000 and score_probabilities([]) is None


def test_the_calibration_error_of_a_small_sample_is_compared_with_that_of_exact_probabilities() -> None:
    rng = np.random.default_rng(3)
    below = 0
    for _ in range(200):
        scores = score_probabilities([Statement(p, bool(rng.random() < p)) for p in rng.choice([0.3, 0.7, 0.9], 80)])
        assert scores is not None and 0.02 < scores.calibrated_median < scores.calibrated_limit < 0.15
        below += scores.calibration_error <= scores.calibrated_limit
    assert 0.9 < below / 200 < 0.99


def label(*names: str) -> dict[str, Any]:
    effects = [{"name": name, "params": {}} for name in names]
    return {"role": "single" if names else "control", "airframe": "small", "effects": effects}


def report(*names: str, verdict: str = "named", **more: Any) -> dict[str, Any]:
    located = [{"channel": "drag", "surface": None, "segments": [[60.0, 200.0]]} for _ in names]
    numbers: list[dict[str, Any]] = [{} for _ in names]
    base = {"verdict": verdict, "named": list(names), "sentence": "", "equivalents": [[] for _ in names]}
    return base | {"located": located, "parameters": numbers, "sigma": numbers} | more


def test_stated_probabilities_are_taken_from_names_and_suspects_where_the_report_has_them() -> None:
    named = grade("a", label("icing"), report("icing", "stall", posterior=[0.9, 0.6]))
    suspects = [{"name": "icing", "posterior": 0.4}, {"name": "stall"}]
    suspected = grade("b", label("icing"), report(verdict="none", suspects=suspects))
    silent = grade("c", label(), report("icing"))
    assert named.statements == (Statement(0.9, True), Statement(0.6, False))
    assert suspected.statements == (Statement(0.4, True),) and silent.statements == ()
    scores = score([named, suspected, silent])
    assert scores["probabilities"]["n"] == 3 and "calibration error, probability of a class" in {
        row[1] for row in score_rows(scores)
    }
    assert score([silent])["probabilities"] is None


def test_a_probability_of_a_class_is_scored_by_the_class_and_that_of_a_name_by_the_name() -> None:
    numbers = {"equivalents": [["icing", "stall"]], "posterior": [0.98], "name_posterior": [0.6]}
    one = grade("a", label("icing"), report("drag_increase", **numbers))
    assert one.statements == (Statement(0.98, True),) and one.name_statements == (Statement(0.6, False),)
    doubt = {"name": "drag_increase", "equivalents": ["stall"], "posterior": 0.3, "name_posterior": 0.2}
    other = grade("b", label("icing"), report(verdict="none", suspects=[doubt]))
    assert other.statements == (Statement(0.3, False),) and other.name_statements == (Statement(0.2, False),)
    scores = score([one, other])
    assert scores["probabilities"]["n"] == scores["name_probabilities"]["n"] == 2
    assert scores["probabilities"]["brier"] < scores["name_probabilities"]["brier"]


def test_every_rate_is_printed_with_its_interval_and_counts() -> None:
    flights = [grade(f"{k}", label("icing"), report("icing" if k else "stall")) for k in range(5)]
    rows = {meaning: value for _, meaning, _, value in score_rows(score(flights))}
    assert rows["single effects named first"] == "0.8 (0.38 to 0.96), 4 of 5"


# --- force predictions -----------------------------------------------------------------------------------------------


def forces(n: int = 1500) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times, force and noise of 300 s at 5 Hz."""
    rng = np.random.default_rng(3)
    t = 0.2 * np.arange(n)
    return t, np.column_stack([np.sin(0.2 * t), np.cos(0.3 * t), 9.8 + np.sin(0.1 * t)]), rng.normal(size=(n, 3))


def test_a_gain_on_held_out_blocks_is_seen_and_its_interval_excludes_zero() -> None:
    t, force, noise = forces()
    valid = np.ones(len(t), bool)
    check = held_out_gain(t, force, (force + 0.4 * noise, force + 0.2 * noise), valid)
    assert check is not None and check.gain == pytest.approx(0.5) and check.proven
    rng, proven = np.random.default_rng(5), 0
    for _ in range(60):  # two predictions of equal error
        pair = tuple(force + 0.4 * rng.normal(size=force.shape) for _ in range(2))
        equal = held_out_gain(t, force, (pair[0], pair[1]), valid)
        assert equal is not None
        proven += equal.proven
    assert proven <= 6


def test_a_gain_on_the_blocks_of_the_fit_alone_is_none() -> None:
    t, force, noise = forces()
    fitted = (np.floor(t / 10.0) % 2 == 0)[:, None]
    check = held_out_gain(
        t, force, (force + 0.4 * noise, np.where(fitted, force, force + 0.5 * noise)), np.ones(len(t), bool)
    )
    assert check is not None and check.gain < 0 and not check.improves


def test_a_prediction_worse_than_a_constant_is_shown_as_such() -> None:
    t, force, noise = forces()
    check = held_out_gain(t, force, (force + 1e9 * noise, force + 1e6 * noise), np.ones(len(t), bool))
    assert check is not None and check.gain > 0.99 and not check.predicts
    scores = score([grade("a", label("icing"), report("icing"), check)])
    assert scores["named_improving"] == 1.0 and scores["named_predicting"] == 0.0


def test_too_little_held_out_flight_is_not_judged() -> None:
    t, force, noise = forces(200)
    assert held_out_gain(t, force, (force, force + noise), np.ones(len(t), bool)) is None


def test_the_examiner_measures_the_force_itself(tmp_path: Path) -> None:
    recording, stored = record(tmp_path / "rec.parauav"), tmp_path / "rec.npz"
    t = np.arange(5.0, 115.0, 0.2)
    measured, valid = measured_force(recording, t)
    assert valid.all() and np.abs(measured[:, 2] + 9.81).max() < 1.0  # roll and climb of the recorded flight
    rng = np.random.default_rng(4)
    np.savez(stored, t=t, f_base=measured + rng.normal(size=measured.shape), f_model=measured)
    check = check_forces(recording, stored)
    assert check is not None and check.gain > 0.99 and check.proven
    np.savez(stored, t=t, f_base=measured, f_model=measured + rng.normal(size=measured.shape))
    worse = check_forces(recording, stored)
    assert worse is not None and not worse.improves
    boast = report("icing", fit_before=9.0, fit_after=0.1)
    assert score([grade("a", label("icing"), boast, worse)])["named_improving"] == 0.0


def test_effects_that_forces_do_not_show_are_not_judged_by_them(tmp_path: Path) -> None:
    t, force, noise = forces()
    check = held_out_gain(t, force, (force, force + noise), np.ones(len(t), bool))
    assert grade("a", label("baro_bias"), report("baro_bias"), check).force is None
    assert grade("a", label("baro_bias"), report("baro_bias", "icing"), check).force is check
