"""The exported matrices: slopes of one sample by differences, and flights near the trim, on any heading, in wind."""

import numpy as np
import pytest

from fleet.contract import LinearModel
from fleet.physics.dynamics import step
from fleet.physics.simulate import TAU, lagged
from fleet.physics.wrench import WIND
from fleet.window import INPUTS, STATES
from tests.support.coupled_flights import AT, aircraft, fly, known
from twin_worker.identification.fixed_wing.derivatives_model import linearise

FINE = 20  # steps of integration in one sample


def columns(axis: LinearModel) -> tuple[list[int], list[int]]:
    return [STATES.index(name) for name in axis.states], [INPUTS.index(name) for name in axis.inputs]


def sampled(par: np.ndarray, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
    """The state a sample later, inputs held."""
    now, work = x.copy(), np.empty((3, 9))
    for _ in range(FINE):
        step(now, u, par, AT, dt / FINE, work)
    return now


def windless(par: np.ndarray) -> np.ndarray:
    out = par.copy()
    out[WIND:] = 0.0
    return out


@pytest.mark.parametrize("wind", [(0.0, 0.0), (5.0, -6.0)])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_matrices_are_slopes_of_one_sample(wind, seed):
    par = aircraft(seed, wind=wind)
    window = fly(par, 40.0, seed=seed)
    axes = linearise(known(par), window)
    x, u = window.x.mean(axis=0), window.u.mean(axis=0)
    x[[1, 3, 4, 5, 6]] = 0.0
    for axis in axes:
        rows, inputs = columns(axis)
        assert axis.dt_s == window.dt

        def moved(dx: np.ndarray, du: np.ndarray, rows=rows, dt=axis.dt_s) -> np.ndarray:
            up, down = (sampled(windless(par), x + s * dx, u + s * du, dt) for s in (1e-5, -1e-5))
            return (up - down)[rows] / 2e-5

        A = np.array([moved(np.eye(9)[k], np.zeros(4)) for k in rows]).T
        B = np.array([moved(np.zeros(9), np.eye(4)[k]) for k in inputs]).T
        assert np.allclose(axis.A.numpy(), A, rtol=1e-2, atol=2e-3)
        assert np.allclose(axis.B.numpy(), B, rtol=1e-2, atol=2e-3)
        assert np.array_equal(axis.C.numpy(), np.eye(len(rows))) and not axis.D.numpy().any()


def flown(axis: LinearModel, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Run x' = A (x - x_trim) + B (u - u_trim) + x_trim."""
    rows, inputs = columns(axis)
    A, B, x_trim, u_trim = (part.numpy() for part in (axis.A, axis.B, axis.x_trim, axis.u_trim))
    out = [x[rows]]
    for k in range(len(u) - 1):
        out.append(x_trim + A @ (out[-1] - x_trim) + B @ (u[k, inputs] - u_trim))
    return np.array(out)


@pytest.mark.parametrize("wind", [(0.0, 0.0), (3.0, -2.0), (-6.0, 8.0)])
@pytest.mark.parametrize(("lively", "most"), [(0.2, 0.12), (1.0, 0.6)])
def test_near_the_trim_it_flies_two_seconds_like_the_coupled_model(wind, lively, most):
    """In shares of how far each state moves; the more lively, the more is lost."""
    par = aircraft(0, wind=wind)
    window = fly(par, 40.0, seed=1, noise=0.0, lively=lively)
    acting = lagged(window.u, window.dt, TAU)
    for axis in linearise(known(par), window):
        rows, _ = columns(axis)
        spread = window.x[:, rows].std(axis=0)
        miss = [
            np.abs(flown(axis, window.x[k], acting[k : k + 50]) - window.x[k : k + 50, rows]).max(axis=0) / spread
            for k in range(100, 900, 40)
        ]
        assert (np.median(miss, axis=0) < most).all()


def test_the_wind_and_the_heading_are_not_in_it():
    calm, windy = (aircraft(0, wind=wind) for wind in ((0.0, 0.0), (7.0, 3.0)))
    pairs = zip(*(linearise(known(par), fly(par, 40.0, seed=2, noise=0.0)) for par in (calm, windy)), strict=True)
    for one, other in pairs:
        for name in ("A", "B", "x_trim", "u_trim"):
            assert np.allclose(getattr(one, name).numpy(), getattr(other, name).numpy(), atol=1e-3), name
    lat = linearise(known(windy), fly(windy, 40.0, seed=2))[1]
    assert np.allclose(lat.A.numpy()[:, lat.states.index("psi")], np.eye(5)[lat.states.index("psi")], atol=1e-9)


def test_rows_nobody_measured_do_not_count():
    par = aircraft(0)
    window = fly(par, 40.0)
    window.ok[300:500] = False
    lon = linearise(known(par), window)[0]
    window.x[300:500], window.v[300:500], window.u[300:500] = 1e3, 1e3, 1e3
    assert np.array_equal(lon.x_trim.numpy(), linearise(known(par), window)[0].x_trim.numpy())
