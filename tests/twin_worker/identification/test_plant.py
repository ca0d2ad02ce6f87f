"""A plant in closed loop: settled on what was flown, acting through its lags, flown on the route in wind."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.physics.dynamics import rates_of_change
from fleet.physics.wrench import NAMES, OFFSETS, WIND
from fleet.window import INPUTS
from tests.support.coupled_flights import AT, TRIM, V, aircraft, fly, known
from tests.support.flights import item, truth
from tests.twin_worker.prediction.test_predict import AHEAD, PARAMS, level, situation
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel
from twin_worker.identification.fixed_wing.plant import actuator_state, bias_corrected, is_finite, method
from twin_worker.prediction.closed_loop import fly_ahead

CALM = aircraft(0, wind=(0.0, 0.0))
SLOWER = PARAMS | {"AIRSPEED_CRUISE": V, "TRIM_ARSPD_CM": 100 * V}


def off(plant: DerivativesModel, by: float) -> DerivativesModel:
    """The model with wrong offsets, as a trim that has changed since."""
    par = plant.par.copy()
    par[list(OFFSETS)] += by * np.array([1.0, 2.0, 1.0, 0.5, 1.0, 0.5])
    return replace(plant, par=par)


def test_kinds_are_named():
    assert (method(known(CALM)), method(truth())) == ("dynamics", "paper")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_none_is_seen(value):
    lon, lat = truth()
    assert is_finite(known(CALM)) and is_finite((lon, lat))
    D = lat.D.copy()
    D[1, 1] = value
    assert not is_finite((lon, replace(lat, D=D))) and not is_finite(replace(known(CALM), par=np.full(37, value)))


def test_a_settled_plant_accelerates_on_average_as_was_flown():
    window = fly(CALM, 40.0, noise=0.3)
    *_, par, at, _ = bias_corrected(off(known(CALM), 1.0), window)
    assert np.array_equal(at, AT) and not par[WIND:].any()
    assert np.abs((par - CALM)[list(OFFSETS)]).max() < 0.25
    rest = [k for k in range(WIND) if k not in OFFSETS]
    assert np.array_equal(par[rest], CALM[rest])  # nothing but the offsets moves


def test_the_true_plant_is_settled_already_in_any_wind():
    windy = aircraft(0, wind=(5.0, 4.0))
    *_, par, _, _ = bias_corrected(known(windy), fly(windy, 40.0, noise=0.0))
    assert np.abs((par - CALM)[list(OFFSETS)]).max() < 0.1


def test_what_acts_at_the_end_is_behind_its_command():
    window = fly(CALM, 10.0)
    window.u[:], window.u[-2:] = TRIM, [1.0, 1.0, 1.0, 1.0]
    now = actuator_state(window)
    assert now.shape == (len(INPUTS),)
    assert (now > TRIM).all() and (now < 1.0).all() and now[3] - TRIM[3] < now[0]


def straight(plant: DerivativesModel, **more):
    """Fly ahead from half a minute of level flight at the coupled models' speed."""
    window = level()
    window.x[:, 0], window.v[:, 0], window.x[:, 7] = V, V, 0.05
    window.p[:, 0] = V * (window.t - window.t[0])
    return window, fly_ahead(situation(window=window, params=SLOWER, **more), plant, AHEAD)


@pytest.mark.parametrize("by", [0.0, 0.5])
def test_a_straight_leg_is_flown_straight(by):
    window, got = straight(off(known(CALM), by))
    assert got.path is not None and got.sentence == ""
    assert np.allclose(got.path[0], window.p[-1])
    assert np.allclose(got.path[:, 0], window.p[-1, 0] + V * AHEAD, rtol=0.05, atol=15.0)
    assert np.abs(got.path[:, 1]).max() < 5.0 and np.abs(got.path[:, 2] + 100.0).max() < 12.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_it_turns_where_the_route_turns(side):
    corner = V * 30.0 + 120.0
    _, got = straight(known(CALM), items=(item(0), item(1, north=corner), item(2, north=corner, east=side * 3000.0)))
    assert got.path is not None and side * got.path[-1, 1] > 100.0 and abs(got.path[-1, 0] - corner) < 150.0


@pytest.mark.parametrize(("name", "value"), [("M_q", 300.0), ("M_w", 60.0), ("X_0", np.nan), ("L_p", np.inf)])
def test_a_model_that_cannot_fly_gives_no_path_and_says_so(name, value):
    wild = replace(known(CALM), par=np.where(np.array(NAMES) == name, value, CALM))
    _, got = straight(wild)
    assert got.path is None and got.diverged and "leaves its envelope" in got.sentence


def test_rates_at_trim_are_small_once_settled():
    window = fly(CALM, 40.0, lively=0.0, noise=0.0)
    *_, par, at, _ = bias_corrected(off(known(CALM), 0.5), window)
    rate = np.empty(9)
    rates_of_change(window.x[-1], TRIM, par, at, rate)
    assert np.abs(rate[:6]).max() < 0.05
