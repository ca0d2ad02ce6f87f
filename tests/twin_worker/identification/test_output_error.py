"""Sweep and search: slopes are slopes, elimination is exact, known parameters come back within their own sigma."""

import numpy as np
import pytest

from fleet.physics.simulate import TAU, lagged
from fleet.physics.wrench import N_PAR, WIND
from tests.support.coupled_flights import AT, NOISE, SMALL, TRIM, aircraft, fly
from tests.support.flights import DT
from twin_worker.identification.fixed_wing import output_error as oe
from twin_worker.identification.fixed_wing.derivatives_model import prior
from twin_worker.identification.fixed_wing.output_error import (
    GROUP,
    N_COLUMN,
    EstimationProblem,
    estimate,
    line_fit_start,
    residuals_and_jacobian,
    unbroken_segments,
)

HELD = prior(SMALL, AT, TRIM, np.array([2.0, -3.0]))
LAMBDA = np.diag(HELD[1] ** -2.0)


def problem(
    seconds: float = 24.0, *, seed: int = 0, par: np.ndarray | None = None, discount=0.25, **more
) -> EstimationProblem:
    """A flight of `aircraft(seed)`; with one residual of four samples its information is a quarter."""
    window = fly(aircraft(seed) if par is None else par, seconds, seed=seed, **more)
    y, delta = window.over_ground, lagged(window.u, window.dt, TAU)
    return EstimationProblem(y, delta, unbroken_segments(window.ok, window.dt), AT, window.dt, discount)


def swept(
    par: np.ndarray, starts: np.ndarray, one: EstimationProblem, slopes: bool = False, weight: float = 1.0
) -> tuple:
    n = int((one.segments[:, 1] - one.segments[:, 0]).sum()) // GROUP
    e, J = np.empty((n, 9)), np.empty((n * slopes, 9, N_COLUMN))
    cost = residuals_and_jacobian(
        par, starts, one.segments, one.y, one.delta, one.trim_velocity, one.dt, np.full(9, weight), e, J
    )
    return cost, e, J


def beginnings(one: EstimationProblem) -> np.ndarray:
    return np.array([line_fit_start(one.y[a:b]) for a, b in one.segments])


# --- sweep -----------------------------------------------------------------------------------------------------------


def test_the_true_model_leaves_nothing():
    one = problem(16.0, noise=0.0)
    cost, e, _ = swept(aircraft(0), one.y[one.segments[:, 0]], one)
    assert 395 < GROUP * len(e) <= 401 and cost == pytest.approx((e**2).sum(), abs=1e-12)
    assert np.abs(e).max() < 1e-4  # a time since 1970 is good to 2e-7 s


@pytest.mark.parametrize("seed", [0, 1])
def test_sensitivities_are_slopes_to_a_few_percent(seed):
    one = problem(16.0, seed=seed)
    par, starts = aircraft(seed + 5), beginnings(one)
    _, _, J = swept(par, starts, one, slopes=True)
    h = 1e-4 * HELD[1]
    want = np.empty_like(J)
    for a in range(N_PAR):
        off = h[a] * np.eye(N_PAR)[a]
        want[:, :, a] = (swept(par - off, starts, one)[1] - swept(par + off, starts, one)[1]) / (2 * h[a])
    for a in range(9):
        off = 1e-4 * np.eye(9)[a]
        want[:, :, N_PAR + a] = (swept(par, starts - off, one)[1] - swept(par, starts + off, one)[1]) / 2e-4
    miss, size = (np.linalg.norm(part / NOISE[:, None], axis=(0, 1)) for part in (J - want, want))
    share = miss / size
    assert np.median(share) < 0.03 and (share < 0.2).all()  # what moves within a group is held over it
    assert (share[WIND:] < 0.1).all()


def test_in_steady_flight_the_wind_moves_the_ground_and_turns_nothing():
    """A model in more wind drifts with it, and neither rolls nor yaws for it."""
    par = aircraft(0, wind=(0.0, 0.0))
    one = problem(8.0, par=par, noise=0.0, lively=0.0)
    _, _, J = swept(par, one.y[one.segments[:, 0]], one, slopes=True)
    assert np.abs(J[-1, 3:6:2, WIND : WIND + 2]).max() < 2e-3
    psi = one.y[-1, 8]
    assert np.allclose(J[-1, 1, WIND : WIND + 2], [-np.sin(psi), np.cos(psi)], atol=0.05)


def test_weights_scale_residuals_and_slopes_alike():
    one = problem(8.0)
    cost, e, J = swept(aircraft(1), beginnings(one), one, slopes=True)
    cost_3, e_3, J_3 = swept(aircraft(1), beginnings(one), one, slopes=True, weight=3.0)
    assert cost_3 == pytest.approx(9 * cost) and np.allclose(e_3, 3 * e) and np.allclose(J_3, 3 * J)


def test_residuals_do_not_hang_on_whether_slopes_are_asked_for():
    one = problem(8.0)
    plain, sloped = (swept(aircraft(1), beginnings(one), one, slopes=slopes) for slopes in (False, True))
    assert plain[0] == sloped[0] and np.array_equal(plain[1], sloped[1])


@pytest.mark.parametrize("value", [400.0, np.nan, np.inf, 1e300])
@pytest.mark.parametrize("slopes", [False, True])
def test_what_leaves_every_envelope_costs_all_there_is(value, slopes):
    one = problem(8.0)
    par = aircraft(0)
    par[14] = value  # M_q
    assert swept(par, beginnings(one), one, slopes)[0] == np.inf


def test_a_lost_start_costs_all_there_is():
    one = problem(8.0)
    starts = beginnings(one)
    starts[0, 2] = np.nan
    assert swept(aircraft(0), starts, one)[0] == np.inf


# --- segments and starts ---------------------------------------------------------------------------------------------


def test_segments_cross_no_gap_and_are_whole_groups():
    rng = np.random.default_rng(0)
    for _ in range(200):
        ok = np.repeat(rng.random(40) > 0.2, rng.integers(1, 60, 40))
        pieces = unbroken_segments(ok, DT)
        assert all(ok[a:b].all() for a, b in pieces)
        assert all(
            (b - a) % GROUP == 0 and oe.MIN_SEGMENT_S / DT - GROUP <= b - a <= oe.SEGMENT_S / DT for a, b in pieces
        )
        assert (pieces[1:, 0] >= pieces[:-1, 1]).all()


@pytest.mark.parametrize(("seconds", "lengths"), [(1.8, []), (2.1, [52]), (8.0, [200]), (9.0, [112, 112])])
def test_segments_by_hand(seconds, lengths):
    pieces = unbroken_segments(np.ones(round(seconds / DT), bool), DT, 8.0)
    assert (pieces[:, 1] - pieces[:, 0]).tolist() == lengths
    assert pieces.dtype == np.int64 and pieces.shape == (len(lengths), 2)


def test_nothing_measured_has_no_segments():
    assert unbroken_segments(np.zeros(500, bool), DT).shape == (0, 2)


def test_a_start_is_read_off_a_line():
    k = np.arange(20.0)[:, None]
    assert np.allclose(line_fit_start(3.0 - 0.5 * k * np.ones(9)), 3.0)
    assert np.allclose(line_fit_start(np.full((1, 9), 2.0)), 2.0)
    rng = np.random.default_rng(1)
    starts = [line_fit_start(rng.standard_normal((20, 9))) for _ in range(400)]
    assert np.std(starts) < 0.8  # quieter than the first sample alone


# --- search ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_known_parameters_come_back_within_their_own_sigma(seed):
    one, par = problem(60.0, seed=seed), aircraft(seed)
    found = estimate(one, HELD[0], (HELD[0], LAMBDA), 12, None)
    sigma = np.sqrt(np.diag(np.linalg.inv(found.fisher_information + LAMBDA)))
    z = (found.par - par) / sigma
    assert np.sqrt((z**2).mean()) < 1.2 and np.abs(z).max() < 4.0
    assert np.median(sigma / HELD[1]) < 0.3  # and the data said most of it
    assert np.allclose(found.par[-2:], par[-2:], atol=0.1)  # the wind among them


def test_without_noise_the_truth_is_where_it_stays(monkeypatch):
    monkeypatch.setattr(oe, "LINE_SAMPLES", 1)  # starts are the first samples, and exact
    one, par = problem(24.0, noise=0.0), aircraft(0)
    found = estimate(one, par, (par, LAMBDA), 4, 1 / NOISE**2)
    assert np.abs((found.par - par) / HELD[1]).max() < 1e-3


def test_weights_become_those_of_the_noise():
    found = estimate(problem(60.0), HELD[0], (HELD[0], LAMBDA), 12, None)
    ratio = np.sqrt(1 / found.weight) / np.maximum(NOISE, oe.SIGMA)
    assert (ratio > 0.85).all() and (ratio < 1.6).all()  # the first model's misses among them


def full_step(look: oe._GaussNewton, par: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solve for parameters and every start state at once."""
    m, d = len(starts), look.problem.effective_fraction
    J = np.zeros((*look.e.shape, N_PAR + 9 * m))
    for s, (a, b) in enumerate(zip(look.bounds, look.bounds[1:], strict=False)):
        J[a:b, :, :N_PAR] = look.J[a:b, :, :N_PAR]
        J[a:b, :, N_PAR + 9 * s : N_PAR + 9 * s + 9] = look.J[a:b, :, N_PAR:]
    J = J.reshape(-1, J.shape[-1])
    H, g = d * J.T @ J, d * J.T @ look.e.ravel()
    H[:N_PAR, :N_PAR] += look.Lambda
    H[N_PAR:, N_PAR:] += np.diag(np.tile(look.K, m))
    g[:N_PAR] -= look.Lambda @ (par - look.par0)
    g[N_PAR:] -= (look.K * (starts - look.start_prior)).ravel()
    step = np.linalg.solve(H, g)
    return step[:N_PAR], step[N_PAR:].reshape(m, 9)


def test_elimination_solves_the_full_problem():
    one = problem(20.0)
    look = oe._GaussNewton(one, HELD[0], LAMBDA)
    par, starts = aircraft(3), look.start_prior + 0.5 * oe.SIGMA
    assert np.isfinite(look.simulate(par, starts, 1 / NOISE**2, True))
    H, g, back = look.normal_equations(par, starts)
    step = np.linalg.solve(H + LAMBDA, g)
    want, want_starts = full_step(look, par, starts)
    assert np.allclose(step / HELD[1], want / HELD[1], rtol=1e-6, atol=1e-9)
    moved = back[..., -1] - back[..., :-1] @ step
    assert np.allclose(moved, want_starts, rtol=1e-6, atol=1e-9)


def cost(one: EstimationProblem, par: np.ndarray, weight: np.ndarray) -> float:
    look = oe._GaussNewton(one, HELD[0], LAMBDA)
    return look.simulate(par, look.start_prior, weight, False)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("steps", [1, 4])
def test_it_never_ends_above_its_start(seed, steps):
    one, start = problem(16.0, seed=seed), HELD[0] + 0.3 * HELD[1] * np.random.default_rng(seed).standard_normal(N_PAR)
    weight = 1 / (3 * NOISE) ** 2
    found = estimate(one, start, (HELD[0], LAMBDA), steps, weight)
    before = cost(one, start, weight)
    assert found.cost <= before or not np.isfinite(before)
    assert found.steps == 0 or found.cost < before


def test_no_steps_is_the_start():
    one = problem(16.0)
    found = estimate(one, HELD[0], (HELD[0], LAMBDA), 0, 1 / NOISE**2)
    assert np.array_equal(found.par, HELD[0]) and found.steps == 0 and np.isfinite(found.cost)


def test_a_start_that_leaves_its_envelope_is_said():
    start = HELD[0].copy()
    start[14] = 400.0
    found = estimate(problem(16.0), start, (HELD[0], LAMBDA), 4, None)
    assert np.isnan(found.cost) and found.steps == 0


def test_what_no_datum_touches_stays_where_it_was_held():
    """Without rudder nothing is said of it; its derivatives stay the prior's, as firmly."""
    one = problem(24.0)
    still = EstimationProblem(
        one.y, one.delta * [1, 1, 0, 1], one.segments, one.trim_velocity, one.dt, one.effective_fraction
    )
    found = estimate(still, HELD[0], (HELD[0], LAMBDA), 6, None)
    for k in (21, 27, 33):  # Y_dr L_dr N_dr
        assert found.par[k] == pytest.approx(HELD[0][k], abs=1e-6 * HELD[1][k])
        assert found.fisher_information[k, k] == pytest.approx(0.0, abs=1e-6 * LAMBDA[k, k])


def test_more_doubt_about_the_data_means_less_said():
    tight, loose = (estimate(problem(16.0, discount=d), HELD[0], (HELD[0], LAMBDA), 8, None) for d in (0.25, 0.01))
    shares = [np.trace(np.linalg.solve(found.fisher_information + LAMBDA, LAMBDA)) for found in (tight, loose)]
    assert shares[0] < shares[1] < N_PAR
