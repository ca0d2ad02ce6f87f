"""What is held before any flight: the airframe's own numbers, or a class's scaled to the aircraft; level in trim."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.airframes import GENERIC, derivatives, load
from fleet.frames import ned_to_body
from fleet.physics.dynamics import rates_of_change
from fleet.physics.wrench import NAMES, OFFSETS, WIND
from twin_worker.identification.fixed_wing.derivatives_model import prior

CLASS, TYPE = load(GENERIC), load("aerosonde")
TRIM = np.array([0.0, 0.05, 0.0, 0.6])
CALM = np.zeros(2)


def named(V: float, span: float | None = None, airframe=CLASS) -> dict[str, float]:
    par, _ = prior(replace(airframe, span=span), np.array([V, 0.8]), TRIM, CALM)
    return dict(zip(NAMES, par, strict=True))


def test_a_class_at_its_own_speed_and_span_is_itself():
    got, own = named(35.0, 2.8956), derivatives(CLASS, 35.0)
    assert {name: got[name] for name in own} == pytest.approx(own)


@pytest.mark.parametrize(("speed", "by"), [(70.0, 0.5), (17.5, 2.0)])
def test_scaling_laws_by_speed(speed, by):
    """Lift carries weight at any speed: an aircraft twice as slow feels a velocity twice as much."""
    own, got = named(35.0, 2.8956), named(speed, 2.8956)
    assert all(got[n] == pytest.approx(own[n] * by) for n in ("X_u", "X_w", "Z_w", "Y_v", "M_w", "L_v", "N_v"))
    assert all(got[n] == pytest.approx(own[n] * by) for n in ("M_q", "L_p", "L_r", "N_p", "N_r"))
    assert all(got[n] == pytest.approx(own[n]) for n in ("X_dt", "Z_de", "M_de", "L_da", "L_dr", "N_dr", "Y_dr"))
    assert got["X_ww"] == pytest.approx(own["X_ww"] * by**2)


@pytest.mark.parametrize("times", [0.5, 2.0])
def test_scaling_laws_by_span(times):
    """A smaller aircraft turns faster: moments per deflection and per velocity grow as its span shrinks."""
    own, got = named(35.0, 2.8956), named(35.0, 2.8956 * times)
    assert all(got[n] == pytest.approx(own[n] / times) for n in ("M_de", "L_da", "N_dr", "M_w", "L_v", "N_v"))
    assert all(got[n] == pytest.approx(own[n]) for n in ("Z_w", "Y_v", "X_u", "Z_de", "M_q", "L_p", "N_r"))


def test_a_span_unknown_is_as_the_speed_suggests_and_an_absurd_one_is_believed_to_a_limit():
    assert named(17.5) == pytest.approx(named(17.5, 2.8956 / 2))
    assert named(17.5, 1e9) == pytest.approx(named(17.5, 20.0)) and named(17.5, -3.0) == pytest.approx(named(17.5, 0.3))


def test_a_type_keeps_its_own_numbers_whatever_the_span():
    got, own = named(25.0, 1.0, TYPE), derivatives(TYPE, 25.0)
    assert {name: got[name] for name in own} == pytest.approx(own)


@pytest.mark.parametrize("airframe", [CLASS, TYPE], ids=lambda one: one.name)
@pytest.mark.parametrize("V", [12.0, 20.0, 60.0])
@pytest.mark.parametrize("wind", [(0.0, 0.0), (5.0, -3.0)])
def test_the_trim_point_is_level_flight(airframe, V, wind):
    at = np.array([V, 0.05 * V])
    par, _ = prior(airframe, at, TRIM, np.array(wind))
    x, rate = np.array([*at[:1], 0.0, at[1], 0, 0, 0, 0, at[1] / at[0], 1.0]), np.empty(9)
    x[:3] += ned_to_body(x[6:7], x[7:8], x[8:9], np.array([[*wind, 0.0]]))[0]
    rates_of_change(x, TRIM, par, at, rate)
    assert np.abs(rate).max() < 0.01
    assert par[WIND:].tolist() == list(wind)


@pytest.mark.parametrize("airframe", [CLASS, TYPE], ids=lambda one: one.name)
@pytest.mark.parametrize("V", [1.0, 8.0, 20.0, 300.0])
def test_every_parameter_is_doubted_and_no_doubt_is_endless(airframe, V):
    par, sigma = prior(airframe, np.array([V, 0.0]), TRIM, CALM)
    assert np.isfinite(par).all() and np.isfinite(sigma).all() and (sigma > 0).all()
    assert np.linalg.cond(np.diag(sigma**-2.0)) < 1e16


def test_doubt_is_a_share_of_what_is_known_and_offsets_are_not():
    at = np.array([20.0, 1.0])
    _, sure = prior(replace(CLASS, value=CLASS.value | {"doubt": 0.1}), at, TRIM, CALM)
    par, wide = prior(CLASS, at, TRIM, CALM)
    assert np.allclose(wide[:WIND], 10 * sure[:WIND]) and np.array_equal(wide[WIND:], sure[WIND:])
    derived = [k for k in range(WIND) if k not in OFFSETS]
    assert (wide[derived] >= np.abs(par[derived])).all()
    _, other = prior(CLASS, at, TRIM + np.array([0.0, 0.3, 0.0, 0.3]), CALM)
    assert np.array_equal(wide, other)  # a trim that lies elsewhere is no better known
