"""The wrench and the rigid body against independent calculations: by hand, by differences, by laws of motion."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from fleet.frames import G
from fleet.physics.dynamics import DIVERGENCE_LIMIT, free_runs, jacobian, rates_of_change, step
from fleet.physics.wrench import N_AERO, N_PAR, NAMES, OFFSETS, ROW, WIND, terms, wrench, wrench_jacobian
from fleet.window import STATES
from tests.support.coupled_flights import AT, aircraft, fly, level
from tests.support.flights import DT

RANDOM = np.random.default_rng(7)
FORCES = "XYZLMN"
DRIVES = dict(zip(FORCES, (STATES.index(name) for name in ("u", "v", "w", "p", "q", "r")), strict=True))


def some(n: int = 30, *, speeds: tuple[float, float] = (0.5, 1.8)) -> list[tuple]:
    """Random parameters, states, inputs and trims: (par, x, delta, at)."""
    out = []
    for _ in range(n):
        at = np.array([RANDOM.uniform(12, 40), RANDOM.normal(1, 1)])
        par = RANDOM.normal(0, 2, N_PAR)
        x = RANDOM.normal(0, [0, 3, 3, 1, 1, 1, 0.7, 0.5, 3])
        x[0], x[7] = at[0] * RANDOM.uniform(*speeds), np.clip(x[7], -1.2, 1.2)
        out.append((par, x, RANDOM.uniform(-1, 1, 4), at))
    return out


def rate(par: np.ndarray, x: np.ndarray, delta: np.ndarray, at: np.ndarray) -> np.ndarray:
    out = np.empty(9)
    rates_of_change(x, delta, par, at, out)
    return out


# --- the wrench ------------------------------------------------------------------------------------------------------


def by_the_book(par, x, delta, at) -> list[float]:
    """The equations of the docstring, by name."""
    d = dict(zip(NAMES, par, strict=True))
    (u, v, w), (p, q, r), (da, de, dr, dt), (U0, W0) = x[:3], x[3:6], delta, at
    s = np.clip(u / U0, 0.4, 2.0)
    du, dw = u - U0, w - W0 * s
    X = d["X_0"] + d["X_u"] * du + d["X_w"] * dw + d["X_de"] * de * s**2 + d["X_dt"] * dt + d["X_ww"] * dw**2
    Z, M = (
        d[f"{k}_0"] * s**2 + d[f"{k}_u"] * du + (d[f"{k}_w"] * dw + d[f"{k}_q"] * q + d[f"{k}_de"] * de * s) * s
        for k in "ZM"
    )
    Y, L, N = (
        s * (d[f"{k}_v"] * v + d[f"{k}_p"] * p + d[f"{k}_r"] * r)
        + s**2 * (d[f"{k}_da"] * da + d[f"{k}_dr"] * dr)
        + d[f"{k}_0"]
        for k in "YLN"
    )
    return [X, Y, Z, L, M + d["M_dt"] * dt, N]


@pytest.mark.parametrize("speeds", [(0.5, 1.8), (-0.5, 0.39), (2.01, 3.0)])
def test_the_wrench_is_what_its_docstring_says(speeds):
    for par, x, delta, at in some(speeds=speeds):
        got = wrench(par, *x[:6], delta, at)
        assert got == pytest.approx(by_the_book(par, x, delta, at), rel=1e-12, abs=1e-12)


def test_it_is_affine_in_its_derivatives_and_the_terms_are_their_factors():
    term = np.empty(N_AERO)
    for par, x, delta, at in some():
        terms(*x[:3], x[3:6], delta, at, term)
        got, sums = wrench(par, *x[:6], delta, at), np.zeros(6)
        np.add.at(sums, [FORCES.index(name[0]) for name in NAMES[:WIND]], par[:WIND] * term)
        assert np.allclose(got, sums, rtol=1e-12, atol=1e-12)


def test_every_derivative_is_named_after_what_it_drives():
    assert [DRIVES[name[0]] for name in NAMES[:WIND]] == ROW.tolist()
    assert {NAMES[k] for k in OFFSETS} == {f"{row}_0" for row in FORCES} and NAMES[WIND:] == ("w_n", "w_e")


@pytest.mark.parametrize("speeds", [(0.41, 1.99), (0.1, 0.39), (2.01, 3.0)])
def test_slopes_are_slopes(speeds):
    by_air, by_rate, h = np.empty((6, 3)), np.empty((6, 3)), 1e-6
    for par, x, delta, at in some(speeds=speeds):
        wrench_jacobian(par, x[:3].copy(), x[3:6].copy(), delta, at, by_air, by_rate)
        ends = [[np.array(wrench(par, *(x[:6] + s * h * e), delta, at)) for s in (1, -1)] for e in np.eye(6)]
        want = np.array([(up - down) / (2 * h) for up, down in ends]).T
        assert np.allclose(np.hstack([by_air, by_rate]), want, rtol=1e-6, atol=1e-6)


# --- the rigid body --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("speeds", [(0.5, 1.8), (0.0, 0.2), (2.3, 3.0)])
def test_the_jacobian_is_the_derivative(speeds):
    F, by_wind, term, h = np.empty((9, 9)), np.empty((9, 2)), np.empty(N_AERO), 1e-6
    for par, x, delta, at in some(60, speeds=speeds):
        jacobian(x, delta, par, at, F, by_wind, term)
        want = [(rate(par, x + h * e, delta, at) - rate(par, x - h * e, delta, at)) / (2 * h) for e in np.eye(9)]
        assert np.allclose(F, np.array(want).T, rtol=1e-5, atol=1e-5)
        want = [(rate(par + h * e, x, delta, at) - rate(par - h * e, x, delta, at)) / (2 * h) for e in np.eye(N_PAR)]
        assert np.allclose(by_wind, np.array(want[WIND:]).T, rtol=1e-5, atol=1e-5)
        mine = np.zeros((9, N_AERO))
        mine[ROW, np.arange(N_AERO)] = term
        assert np.allclose(mine, np.array(want[:WIND]).T, rtol=1e-5, atol=1e-5)


def test_without_a_wrench_a_throw_keeps_its_energy_and_turns_no_more():
    """No force but gravity: in the earth's frame a parabola, whatever the body does."""
    x = np.array([20.0, 1.0, -2.0, 0.3, -0.2, 0.4, 0.2, 0.3, 1.0])
    spun, t, work = x.copy(), 0.0, np.empty((3, 9))
    earth = Rotation.from_euler("ZYX", x[8:5:-1]).apply(x[:3])
    for _ in range(100):
        step(spun, np.zeros(4), np.zeros(N_PAR), AT, 0.01, work)
        t += 0.01
        now = Rotation.from_euler("ZYX", spun[8:5:-1]).apply(spun[:3])
        assert np.allclose(now, earth + np.array([0.0, 0.0, G * t]), atol=1e-7)
        assert np.array_equal(spun[3:6], x[3:6])


def test_kinematics_are_those_of_a_rotation():
    """Body rates turn the attitude as the rotation vector says, whatever the angles are called."""
    for _, x, delta, at in some(20):
        now, work = x.copy(), np.empty((3, 9))
        step(now, delta, np.zeros(N_PAR), at, 1e-3, work)
        turned = Rotation.from_euler("ZYX", x[8:5:-1]) * Rotation.from_rotvec(1e-3 * x[3:6])
        away = Rotation.from_euler("ZYX", now[8:5:-1]).inv() * turned
        assert away.magnitude() < 1e-9


def test_steps_are_of_order_four():
    par, x = aircraft(1), level(aircraft(1))
    x[3:7] += [0.3, 0.2, -0.2, 0.4]
    delta = np.array([0.1, -0.05, 0.05, 0.6])
    want = solve_ivp(lambda _, y: rate(par, y, delta, AT), (0, 0.8), x, rtol=1e-11, atol=1e-11).y[:, -1]

    def miss(dt: float) -> float:
        now, work = x.copy(), np.empty((3, 9))
        for _ in range(round(0.8 / dt)):
            step(now, delta, par, AT, dt, work)
        return float(np.abs(now - want).max())

    assert miss(0.04) < 5e-3 and miss(0.01) < miss(0.02) / 10 < miss(0.04) / 100


def test_a_steady_wind_carries_the_flight_and_changes_nothing_else():
    """Galilei: through the air the windy flight is the windless one."""
    windy, calm = aircraft(2, wind=(6.0, -4.0)), aircraft(2, wind=(0.0, 0.0))
    delta = np.repeat(fly(calm, 8.0, seed=3, noise=0.0).u, 8, axis=0)
    flown = []
    for par in (windy, calm):
        out = np.empty((len(delta), 9))
        free_runs(level(par)[None], np.zeros(1, np.int64), len(delta), delta, par, AT, DT / 8, out)
        flown.append(out)
    assert np.ptp(flown[1][:, 8]) > 0.5  # it turns, so that the wind turns in the body
    assert np.allclose(flown[0][:, 3:], flown[1][:, 3:], atol=1e-6)
    over, through = (Rotation.from_euler("ZYX", out[:, 8:5:-1]).apply(out[:, :3]) for out in flown)
    assert np.allclose(over - through, [6.0, -4.0, 0.0], atol=1e-5)


def test_level_trim_stays_level():
    for seed in range(5):
        par = aircraft(seed)
        assert np.abs(rate(par, level(par), np.array([0, 0, 0, 0.5]), AT)).max() < 0.02


# --- free runs -------------------------------------------------------------------------------------------------------


def test_free_runs_begin_end_and_leave_their_envelope():
    par, delta = aircraft(0), np.tile([0.0, 0.0, 0.0, 0.5], (40, 1))
    out, begins = np.empty((40, 9)), np.array([2, 12, 35])
    free_runs(np.array([level(par)] * 3), begins, 8, delta, par, AT, DT, out)
    told = np.isfinite(out).all(axis=1)
    assert np.flatnonzero(told).tolist() == [*range(2, 10), *range(12, 20), *range(35, 40)]
    assert np.allclose(out[begins], level(par))
    wild = par.copy()
    wild[NAMES.index("M_q")] = 400.0
    start = level(par) + 0.1
    free_runs(start[None], np.zeros(1, np.int64), 40, delta, wild, AT, DT, out)
    lost = np.flatnonzero(~np.isfinite(out).all(axis=1))
    assert 0 < lost[0] < 40 and (np.diff(lost) == 1).all() and np.abs(out[: lost[0]]).max() < DIVERGENCE_LIMIT


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_what_is_no_number_is_not_flown(value):
    par, delta, out = aircraft(0), np.zeros((10, 4)), np.empty((10, 9))
    start = level(par)
    start[3] = value
    free_runs(start[None], np.zeros(1, np.int64), 10, delta, par, AT, DT, out)
    assert np.isnan(out).all()
    par[0] = value
    free_runs(level(aircraft(0))[None], np.zeros(1, np.int64), 10, delta, par, AT, DT, out)
    assert np.isfinite(out[0]).all() and np.isnan(out[1:]).all()
