"""Coupled models on data they have not seen: fresh starts, fits, and every verdict; whiteness by hand."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from fleet.contract import Outcome
from fleet.physics.wrench import NAMES, WIND
from tests.support.coupled_flights import NOISE, SMALL, aircraft, broken, fly, known, window_of
from tests.support.flights import truth
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel
from twin_worker.validation.held_out import HeldOut
from twin_worker.validation.verify import AXES, LAGS, fit_and_persistence, mean_fit, verify, whiteness, with_diagnostics

START = 500


def changed(plant: DerivativesModel, **by: float) -> DerivativesModel:
    """The model with some parameters multiplied."""
    par = plant.par.copy()
    for name, factor in by.items():
        par[NAMES.index(name)] *= factor
    return replace(plant, par=par)


# --- free runs -------------------------------------------------------------------------------------------------------


def test_without_noise_every_run_of_the_truth_is_the_flight():
    window = fly(aircraft(1), 40.0, noise=0.0)
    unseen = HeldOut(known(aircraft(1)), window, START)
    runs = unseen.runs(100)
    assert np.array_equal(unseen.y, window.over_ground[START:])
    assert np.abs(runs - unseen.y).max() < 0.5  # starts are read off what was before
    assert all(value > 97.0 for value in fit_and_persistence(unseen, 4.0)[0].values())


def test_runs_start_afresh_near_what_was_measured_and_quieter():
    window = fly(aircraft(0), 60.0)
    quiet = fly(aircraft(0), 60.0, noise=0.0).over_ground[START:]
    unseen = HeldOut(known(aircraft(0)), window, START)
    begins = np.arange(0, len(unseen.y), 10)
    miss = (unseen.runs(10)[begins] - quiet[begins]).std(axis=0)
    assert (miss < 1.3 * NOISE).all() and np.median(miss / NOISE) < 0.9


def test_no_run_crosses_a_hole_and_nothing_after_the_start_leaks_in():
    window = fly(aircraft(0), 60.0)
    holed = broken(window, (30.0, 30.2))
    plant = known(aircraft(0))
    whole, runs = (HeldOut(plant, one, START).runs(100) for one in (window, holed))
    lost = np.flatnonzero(~np.isfinite(runs).all(axis=1))
    assert lost.tolist() == list(range(200, 300))  # the run from 28 s on
    far = np.r_[0:200, 400:1000]
    assert np.array_equal(runs[far], whole[far])
    later = replace(window, x=window.x.copy(), v=window.v.copy())
    later.x[START + 1 :], later.v[START + 1 :] = 0.0, 0.0  # what comes after its first row changes no first run
    assert np.array_equal(HeldOut(plant, later, START).runs(100)[:100], whole[:100])


def test_wind_in_the_model_moves_the_ground_speed_it_predicts():
    window = fly(aircraft(0), 60.0)
    fits = [
        mean_fit(fit_and_persistence(HeldOut(changed(known(aircraft(0)), w_n=by), window, START), 16.0)[0])
        for by in (1.0, 3.0)
    ]
    assert fits[0] > fits[1] + 10.0


# --- one step ahead --------------------------------------------------------------------------------------------------


def test_one_step_ahead_the_truth_misses_by_the_noise_and_little_more():
    exact = HeldOut(known(aircraft(1)), fly(aircraft(1), 40.0, noise=0.0), START)
    assert np.abs(exact.one_step() - exact.y).max() < 1e-6
    noisy = HeldOut(known(aircraft(0)), fly(aircraft(0), 60.0), START)
    missed = (noisy.one_step() - noisy.y).std(axis=0) / NOISE
    assert (missed > 0.95).all()  # nobody foresees noise
    assert (
        np.median(missed) < 1.6 and (missed < 5.0).all()
    )  # noise of what it starts from; a sideways one turns the nose
    other = HeldOut(changed(known(aircraft(0)), M_w=0.2, L_p=0.2, Z_w=0.2), fly(aircraft(0), 60.0), START)
    worse = (other.one_step() - other.y).std(axis=0) / NOISE / missed
    assert (worse > 0.98).all() and (worse[[2, 3, 4]] > [1.05, 2.0, 1.05]).all()


@pytest.mark.parametrize("plant", [known(aircraft(0)), truth()])
def test_a_step_ahead_sees_the_rows_before_it_and_none_after(plant):
    window = fly(aircraft(0), 40.0)
    before = HeldOut(plant, window, START).one_step()
    later = replace(window, x=window.x.copy(), v=window.v.copy())
    later.x[START + 301 :], later.v[START + 301 :] = 0.0, 0.0
    after = HeldOut(plant, later, START).one_step()
    same = (before == after) | (np.isnan(before) & np.isnan(after))
    assert same[:302].all() and not same[303:306].all()


@pytest.mark.parametrize("plant", [known(aircraft(0)), truth()])
def test_rows_nobody_measured_are_not_predicted_nor_predicted_from(plant):
    window = broken(fly(aircraft(0), 40.0), (30.0, 30.2))
    one_step = HeldOut(plant, window, START).one_step()
    gone = np.flatnonzero(~window.ok) - START
    assert len(gone) == 5 and np.isnan(one_step[gone[0] : gone[-1] + 2]).all()
    measured = np.isfinite(one_step).all(axis=1)
    assert measured.sum() == {True: len(one_step) - 6, False: 247}[isinstance(plant, DerivativesModel)]
    other = replace(window, x=np.where(window.ok[:, None], window.x, 7.0))
    assert np.array_equal(HeldOut(plant, other, START).one_step(), one_step, equal_nan=True)


def test_a_linear_model_predicts_every_second_row_from_the_one_before():
    window = fly(aircraft(0), 40.0)
    unseen = HeldOut(truth(), window, START)
    one_step, n = unseen.one_step(), len(unseen.y) // 2 * 2
    assert np.isnan(one_step[:n:2]).all()
    assert np.array_equal(one_step[1:n:2], unseen.runs(2)[1:n:2])


# --- verdicts --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("seconds", "longest"), [(62.0, 40.0), (40.0, 16.0), (30.0, 8.0), (25.0, 4.0)])
def test_the_truth_is_verified_at_the_longest_horizon_and_told_at_every(seconds, longest):
    plant, window = known(aircraft(2)), fly(aircraft(2), seconds, seed=2)
    verdict = verify(plant, window, START)
    assert verdict.outcome is Outcome.PLAUSIBLE and verdict.horizon_s == longest
    more = with_diagnostics(verdict, HeldOut(plant, window, START))
    assert set(more.fit_by_length) == {f"{axis}{h}" for axis in AXES for h in (40, 16, 4, 1) if h <= longest}
    for h in (40, 16, 4, 1):
        fit = fit_and_persistence(HeldOut(plant, window, START), h)[0]
        assert h > longest or all(
            more.fit_by_length[f"{axis}{h}"] == mean_fit(fit, states) for axis, states in AXES.items()
        )
    assert more.whiteness.keys() == verdict.fit.keys() and set(more.whiteness.values()) != {0.0}
    assert msgspec.structs.replace(more, fit_by_length={}, whiteness={}) == verdict  # nothing else changes


def test_a_worse_model_does_not_replace_the_last():
    window, best = fly(aircraft(0), 60.0), known(aircraft(0))
    worse = changed(best, Z_w=0.7, L_p=0.7)
    verdict = verify(worse, window, START, active=best)
    assert verdict.outcome is Outcome.WORSE_THAN_LAST and "the active model has" in verdict.sentence
    assert verify(worse, window, START).outcome is Outcome.PLAUSIBLE  # good enough by itself
    assert verify(best, window, START, active=worse).outcome is Outcome.PLAUSIBLE
    assert verify(best, window, START, active=best).outcome is Outcome.PLAUSIBLE  # its equal is no worse


def test_the_last_may_be_of_another_kind():
    window = fly(aircraft(0), 60.0)
    assert verify(known(aircraft(0)), window, START, active=truth()).outcome is Outcome.PLAUSIBLE


def test_when_neither_fits_the_aircraft_or_the_air_have_changed():
    window = fly(aircraft(0), 60.0)
    other = changed(known(aircraft(0)), L_da=-1.0, M_de=-1.0)
    verdict = verify(other, window, START, active=other)
    assert verdict.outcome is Outcome.DRIFTING and "has changed" in verdict.sentence
    alone = verify(other, window, START)
    assert alone.outcome in (Outcome.BELOW_THRESHOLD, Outcome.DIVERGED)
    beside = verify(other, window, START, active=known(aircraft(0)))
    assert beside.outcome is alone.outcome  # the last still fits: it is the new model that is wrong


def test_a_diverging_model_is_named_so():
    window = fly(aircraft(0), 60.0)
    verdict = verify(changed(known(aircraft(0)), M_w=-40.0), window, START)
    assert verdict.outcome is Outcome.DIVERGED and np.isfinite(list(verdict.fit.values())).all()


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["X_0", "N_dr", "w_e"])
def test_a_model_of_no_numbers_is_refused(name, value):
    plant = known(aircraft(0))
    plant.par[NAMES.index(name)] = value
    window = fly(aircraft(0), 40.0)
    verdict = with_diagnostics(verify(plant, window, START), HeldOut(plant, window, START))
    assert verdict.outcome is Outcome.DIVERGED and verdict.fit_by_length and verdict.whiteness
    assert np.isfinite([*verdict.fit.values(), *verdict.fit_by_length.values(), *verdict.whiteness.values()]).all()


def test_steady_cruise_is_not_identifiable_here_and_the_last_stays():
    window = fly(aircraft(0), 60.0, lively=0.0)
    for last in (None, known(aircraft(0))):
        verdict = verify(changed(known(aircraft(0)), M_w=0.5), window, START, active=last)
        assert verdict.outcome is Outcome.NOT_IDENTIFIABLE and "steady flight" in verdict.sentence


def test_too_short_says_so():
    with pytest.raises(ValueError, match=r"^verify: found 3\.\d s held out, needs 4 s; wait for more$"):
        verify(known(aircraft(0)), fly(aircraft(0), 23.5), START)


def test_shuffled_inputs_are_no_flight_of_this_aircraft():
    window = fly(aircraft(0), 60.0)
    mixed = window_of(window.over_ground, np.roll(window.u, 300, axis=0), aircraft(0))
    assert verify(known(aircraft(0)), mixed, START).outcome is not Outcome.PLAUSIBLE


def test_the_prior_alone_is_judged_like_any_model():
    window = fly(aircraft(0), 60.0)
    truth_fit = verify(known(aircraft(0)), window, START)
    prior = replace(known(aircraft(0)), par=known(aircraft(0)).prior_mean)
    assert mean_fit(verify(prior, window, START).fit) < mean_fit(truth_fit.fit)
    assert np.array_equal(prior.par[WIND:], aircraft(0)[WIND:]) and SMALL.scale


# --- whiteness -------------------------------------------------------------------------------------------------------


def test_white_noise_is_white_and_coloured_noise_is_not():
    rng = np.random.default_rng(0)
    e = rng.standard_normal((4000, 3))
    coloured = np.array([np.convolve(column, 0.9 ** np.arange(60))[:4000] for column in e.T]).T
    assert (whiteness(e, np.zeros_like(e)) >= 0.8).all()
    assert (whiteness(coloured, np.zeros_like(e)) <= 0.5).all()
    shares = [whiteness(rng.standard_normal((500, 1)), np.zeros((500, 1)))[0] for _ in range(300)]
    assert np.mean(shares) == pytest.approx(0.95, abs=0.01)


def test_whiteness_by_hand():
    """A residual that repeats after two rows: every even lag is one, every odd lag minus one."""
    e = np.tile([[1.0], [-1.0]], (100, 1))
    assert whiteness(e, 0 * e).tolist() == [0.0]
    rng = np.random.default_rng(3)
    e = rng.standard_normal((400, 1))
    e -= e.mean()
    rho = [float((e[k:] * e[:-k]).sum() / (e**2).sum()) for k in range(1, LAGS + 1)]
    assert whiteness(e, 0 * e)[0] == np.mean(np.abs(rho) < 1.96 / 20.0)


def test_fresh_starts_and_rows_without_a_prediction_do_not_count():
    rng = np.random.default_rng(4)
    e = rng.standard_normal((500, 2))
    spread, y_hat = np.zeros((1000, 2)), np.zeros((1000, 2))
    spread[1::2] = e
    assert np.array_equal(whiteness(spread, y_hat), whiteness(e, 0 * e))
    y_hat[::2] = np.nan
    spread[::2] = 99.0
    assert np.array_equal(whiteness(spread, y_hat), whiteness(e, 0 * e))


@pytest.mark.parametrize("e", [np.zeros((500, 2)), np.ones((10, 2)), np.full((500, 2), np.nan)])
def test_where_there_is_nothing_to_tell_by_it_is_not_white(e):
    assert whiteness(np.zeros_like(e), e).tolist() == [0.0, 0.0]


def test_a_constant_miss_has_no_colour_and_no_division_by_nothing():
    assert np.isfinite(whiteness(np.zeros((500, 2)), np.ones((500, 2)))).all()
