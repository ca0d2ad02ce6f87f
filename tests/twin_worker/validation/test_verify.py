"""Verification: the fit of equation 22 by hand, what a model must beat, and every outcome."""

import re
from dataclasses import replace

import numpy as np
import pytest

from fleet.contract import Outcome
from fleet.window import STATES
from tests.support.flights import linear_flight, standstill, truth
from twin_worker.identification.linear.linear_model import AxisModel
from twin_worker.validation.held_out import HeldOut
from twin_worker.validation.verify import (
    _STEADY_STD,
    fit_and_persistence,
    fit_percent,
    mean_fit,
    persistence_forecast,
    verify,
)


def blurred(share: float, seed: int = 0):
    """The true model with every entry but its kinematics off by a share."""
    rng = np.random.default_rng(seed)
    lon, lat = truth()
    return tuple(replace(a, D=a.D * (1 + share * rng.standard_normal(a.D.shape))) for a in (lon, lat))


def test_fit_by_hand():
    y = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 3.0], [6.0, 3.0]])
    y_hat = np.array([[1.0, 0.0], [2.0, 1.5], [3.0, 1.5], [4.0, 3.0]])
    # mean 3: spread sqrt(4 + 1 + 0 + 9), error 2;  mean 1.5: spread 3, error sqrt(4.5)
    want = [100 * (1 - 2 / np.sqrt(14)), 100 * (1 - np.sqrt(4.5) / 3)]
    assert fit_percent(y, y_hat) == pytest.approx(want)
    assert fit_percent(y, y).tolist() == [100.0, 100.0]
    assert fit_percent(y, np.tile(y.mean(axis=0), (4, 1))) == pytest.approx([0.0, 0.0])


def test_fit_counts_only_rows_both_have_and_is_bounded():
    y = np.array([[0.0], [2.0], [50.0], [4.0]])
    y_hat = np.array([[0.0], [1.0], [np.nan], [4.0]])
    assert fit_percent(y, y_hat) == pytest.approx([100 * (1 - 1 / np.sqrt(8))])
    assert fit_percent(y, np.full((4, 1), np.nan)).tolist() == [-100.0]
    assert fit_percent(y, np.full((4, 1), 1e9)).tolist() == [-100.0]
    assert fit_percent(np.ones((4, 1)), np.ones((4, 1))).tolist() == [100.0]  # nothing moved, nothing missed


def test_hold_by_hand():
    y, ok = np.arange(7.0)[:, None], np.ones(7, bool)
    assert persistence_forecast(y, ok, 3)[:, 0].tolist() == [0, 0, 0, 3, 3, 3, 6]
    ok[4] = False
    assert np.array_equal(persistence_forecast(y, ok, 3)[:, 0], [0, 0, 0, 3, np.nan, 3, 6], equal_nan=True)
    ok[3] = False  # no measured start, no baseline
    assert np.isnan(persistence_forecast(y, ok, 3)[3:6]).all()


def halving() -> tuple[AxisModel, AxisModel]:
    """Models by which every state halves every sample."""
    lon, lat = truth()
    D = (np.hstack([0.5 * np.eye(len(a.D)), np.zeros((len(a.D), a.D.shape[1] - len(a.D)))]) for a in (lon, lat))
    lon, lat = (replace(a, D=each, y_mean=0 * a.y_mean) for a, each in zip((lon, lat), D, strict=True))
    return lon, lat


def test_free_runs_start_afresh_and_cross_no_hole():
    held = linear_flight(9.0).part(0, 11)
    held.x[:], held.ok[6] = 8.0, False
    runs = HeldOut(halving(), held, 2).runs(3)  # two rows it has seen, then three runs of three
    want = [8, 4, 2, np.nan, np.nan, np.nan, 8, 4, 2]
    assert np.array_equal(runs, np.tile(want, (9, 1)).T, equal_nan=True)


def test_standstill_is_holding():
    held = linear_flight(9.0)
    fit, still = fit_and_persistence(HeldOut(standstill(truth()), held, 0), 4.0)
    assert fit == pytest.approx(still)
    assert set(fit) == {"u", "v", "w", "p", "q", "r", "phi", "theta", "psi"}


def test_a_perfect_model_fits_perfectly():
    verdict = verify(truth(), linear_flight(20.0), 0)
    assert verdict.outcome is Outcome.VERIFIED
    assert min(verdict.fit.values()) > 99.9
    assert mean_fit(verdict.fit_persistence) < 50.0
    noisy = verify(truth(), linear_flight(20.0, noise=0.02), 0)
    assert 80.0 < mean_fit(noisy.fit) < mean_fit(verdict.fit)


@pytest.mark.parametrize(("seconds", "longest"), [(20.0, 16.0), (16.0, 16.0), (15.0, 8.0), (9.0, 8.0), (5.0, 4.0)])
def test_verified_at_the_longest_horizon_the_data_allow(seconds, longest):
    verdict = verify(truth(), linear_flight(seconds), 0)
    assert verdict.horizon_s == longest
    assert f"over {longest:.0f} s" in verdict.sentence


def test_a_model_good_for_a_while_is_verified_for_that_while():
    held, drifting = linear_flight(20.0, seed=2), truth(grow=0.004)
    fits = [mean_fit(fit_and_persistence(HeldOut(drifting, held, 0), h)[0]) for h in (16.0, 8.0, 4.0)]
    assert fits[0] < fits[1] < fits[2]
    for horizon, between in ((8.0, fits[:2]), (4.0, fits[1:])):
        verdict = verify(drifting, held, 0, threshold=sum(between) / 2)
        assert verdict.outcome is Outcome.VERIFIED and verdict.horizon_s == horizon


def test_the_threshold_is_a_threshold():
    held = linear_flight(20.0)
    fit = mean_fit(verify(blurred(0.01), held, 0).fit)
    assert verify(blurred(0.01), held, 0, threshold=fit - 0.1).outcome is Outcome.VERIFIED
    refused = verify(truth(), held, 0, threshold=100.0)
    assert refused.outcome is Outcome.BELOW_THRESHOLD
    assert refused.threshold == 100.0 and "100 % is needed" in refused.sentence


def test_no_better_than_holding_still_is_refused_however_low_the_threshold():
    verdict = verify(standstill(truth()), linear_flight(20.0), 0, threshold=-100.0)
    assert verdict.outcome is Outcome.BELOW_THRESHOLD


def test_steady_flight_identifies_nothing():
    window = linear_flight(40.0, lively=0.02, noise=0.1)
    verdict = verify(standstill(truth()), window, 500)
    assert verdict.outcome is Outcome.NOT_IDENTIFIABLE
    assert re.search(r"steady flight \(phi \d\.\d deg, theta \d\.\d deg, q \d\.\d deg/s\)", verdict.sentence)
    assert verify(truth(), window, 500).outcome is Outcome.NOT_IDENTIFIABLE  # however good it may look
    lively = linear_flight(40.0)
    window.x[:500] = lively.x[:500]  # what counts is the stretch it was learnt from
    assert verify(standstill(truth()), window, 500).outcome is not Outcome.NOT_IDENTIFIABLE


@pytest.mark.parametrize("name", ["phi", "theta", "q"])
def test_any_motion_is_enough_to_learn_from(name):
    window = linear_flight(40.0)
    window.x[:500] = window.x[0]
    for times, outcome in ((0.9, Outcome.NOT_IDENTIFIABLE), (1.1, Outcome.VERIFIED)):
        window.x[:500, STATES.index(name)] = times * _STEADY_STD[name] * np.resize([-1.0, 1.0], 500)
        assert verify(truth(), window, 500).outcome is outcome


def test_where_nothing_was_measured_before_nothing_is_said_of_it():
    window = linear_flight(40.0)
    window.ok[:500] = False
    assert verify(truth(), window, 500).outcome is Outcome.VERIFIED


def test_a_diverging_model_is_named_so():
    verdict = verify(truth(grow=0.5), linear_flight(20.0), 0)
    assert verdict.outcome is Outcome.DIVERGED
    assert all(np.isfinite(fit) for fit in verdict.fit.values())


def test_a_model_of_no_numbers_is_refused():
    lon, lat = truth()
    verdict = verify((replace(lon, D=np.full_like(lon.D, np.nan)), lat), linear_flight(20.0), 0)
    assert verdict.outcome is Outcome.DIVERGED
    assert all(np.isfinite(fit) for fit in verdict.fit.values())


def test_data_full_of_holes_verify_nothing():
    held = linear_flight(20.0)
    held.ok[::50] = False
    assert verify(truth(), held, 0).outcome is not Outcome.VERIFIED


def test_data_too_short_for_any_horizon_say_so():
    with pytest.raises(ValueError, match="needs 4 s"):
        verify(truth(), linear_flight(3.0), 0)


def test_one_axis_cannot_carry_the_other():
    lon, lat = truth()
    frozen_lon = standstill((lon, lat))[0]
    verdict = verify((frozen_lon, lat), linear_flight(20.0), 0, threshold=-100.0)
    assert verdict.outcome is Outcome.BELOW_THRESHOLD
    assert "no better than persistence" in verdict.sentence
