"""The filter behind every free run: gusts by hand, the flight itself, rows that are lost."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.frames import G
from fleet.physics.simulate import TAU as LAGS
from fleet.physics.simulate import lagged
from fleet.physics.wrench import OFFSETS
from fleet.window import Window
from tests.support.coupled_flights import NOISE, aircraft, fly, known
from twin_worker.validation.gust_observer import _ALPHA, _BETA, TAU, AlphaBetaFilter

DT = 0.02
IDLE = np.zeros((225, 4))  # inputs
GUST = 0.02  # [m/s2, rad/s2]
_par = np.zeros(37)
_par[OFFSETS[1]] = -G
GLIDE = replace(known(aircraft(0)), par=_par)  # lift bears the weight; nothing else acts


class Steady(AlphaBetaFilter):
    """Gusts that do not fade."""

    @property
    def gust_decay(self) -> np.ndarray:
        return np.ones(6)


def pushed(axis: int, rows: int, eye: type[AlphaBetaFilter], gust: float = GUST) -> np.ndarray:
    """The states of a body that glides at its airspeed and is pushed along or about one axis, (rows, 9)."""
    start = np.zeros((1, 15))
    start[0, 0], start[0, 9 + axis] = GLIDE.trim_velocity[0], gust
    return eye(GLIDE, DT).free_run(start, np.zeros(1, np.int64), rows, IDLE[:rows])[0]


def flight(seconds: float = 30.0, **more: float) -> tuple[AlphaBetaFilter, np.ndarray, np.ndarray, Window]:
    """A filter of the true model, states, inputs as they act, and the window."""
    window = fly(aircraft(0), seconds, **more)
    return AlphaBetaFilter(known(aircraft(0)), window.dt), window.over_ground, lagged(window.u, window.dt, LAGS), window


@pytest.mark.parametrize("axis", range(6))
def test_a_constant_gust_is_found_as_far_as_it_is_thought_to_last(axis):
    """Where alpha e = (gust - d) dt and (1 - left) d = beta e / dt, the filter stands still."""
    eye = AlphaBetaFilter(GLIDE, DT)
    found = eye.filter(pushed(axis, 75, Steady), IDLE[:75])[-1, 9:]
    renewed = _BETA[axis] / _ALPHA[axis]
    assert found[axis] == pytest.approx(GUST * renewed / (1.0 - eye.gust_decay[axis] + renewed), rel=0.01)
    others = [k for k in range(6) if k != axis and (k > 2 or axis < 3)]  # a turn found late leaves a pull on u v w
    assert np.abs(found[others]).max() < 0.02 * GUST


@pytest.mark.parametrize("axis", range(6))
def test_a_gust_fades_in_the_forecast(axis):
    left = np.exp(-DT / TAU[axis])
    blown = GUST * DT * (1 - left ** np.arange(75)) / (1 - left)
    run = pushed(axis, 75, AlphaBetaFilter)[:, axis] - pushed(axis, 75, AlphaBetaFilter, 0.0)[:, axis]
    assert np.allclose(run, blown, rtol=0.01)


@pytest.mark.parametrize("axis", range(6))
def test_a_gust_that_is_over_is_forgotten(axis):
    eye, blown = AlphaBetaFilter(GLIDE, DT), pushed(axis, 76, Steady)
    calm = eye.free_run(np.r_[blown[-1], np.zeros(6)][None], np.zeros(1, np.int64), 150, IDLE[:150])[0]
    told = eye.filter(np.concatenate([blown[:-1], calm]), IDLE)[:, 9 + axis]
    assert abs(told[-1]) < 0.02 * told[74] and told[74] > 0.0


def test_without_noise_it_is_the_flight_and_no_gust_blows():
    eye, y, delta, _ = flight(noise=0.0)
    tracked = eye.filter(y, delta)
    assert np.abs(tracked[:, :9] - y).max() < 1e-6 and np.abs(tracked[:, 9:]).max() < 1e-4
    assert np.abs(eye.one_step(y, delta) - y).max() < 1e-6
    begins = np.array([0, 100, len(y) - 3])
    runs = eye.free_run(tracked[begins], begins, 50, delta)
    for run, k in zip(runs, begins, strict=True):
        assert np.abs(run[: len(y) - k] - y[k : k + 50]).max() < 1e-3
        assert np.isnan(run[len(y) - k :]).all()  # no inputs, no run


def test_what_is_foretold_is_where_a_run_from_the_row_before_goes():
    eye, y, delta, _ = flight()
    tracked, foretold = eye.filter(y, delta), eye.one_step(y, delta)
    begins = np.arange(len(y) - 1)
    assert np.array_equal(foretold[0], y[0])
    assert np.allclose(foretold[1:], eye.free_run(tracked, begins, 2, delta)[:, 1], rtol=0, atol=1e-12)
    later = y.copy()
    later[301:] += 1.0
    assert np.array_equal(eye.filter(later, delta)[:301], tracked[:301])
    assert np.array_equal(eye.one_step(later, delta)[:302], foretold[:302])


def test_it_is_nearer_to_the_flight_than_what_was_measured():
    eye, y, delta, window = flight(60.0)
    truth = fly(aircraft(0), 60.0, noise=0.0).over_ground
    miss = (eye.filter(y, delta)[50:, :9] - truth[50:]).std(axis=0)
    assert (miss < 1.05 * NOISE).all() and (miss[[0, 1, 2]] < 0.97 * NOISE[[0, 1, 2]]).all()
    assert len(window) == len(truth)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e9])
def test_a_row_of_nonsense_is_left_behind_at_the_next(value):
    eye, y, delta, _ = flight()
    y[200] = value
    tracked = eye.filter(y, delta)
    assert np.array_equal(tracked[201], np.r_[y[201], np.zeros(6)])  # begun anew
    assert np.array_equal(tracked[201:], eye.filter(y[201:], delta[201:]))
    assert np.isfinite(eye.one_step(y, delta)[202:]).all()
    lost = eye.free_run(tracked[[200]], np.array([200]), 5, delta)
    assert np.isnan(lost).all()


def test_nothing_to_track_gives_nothing():
    eye = AlphaBetaFilter(known(aircraft(0)), DT)
    assert eye.filter(np.zeros((1, 9)), np.zeros((1, 4))).tolist() == [[0.0] * 15]
    assert eye.free_run(np.zeros((0, 15)), np.zeros(0, np.int64), 10, np.zeros((5, 4))).shape == (0, 10, 9)
