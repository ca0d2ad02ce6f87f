"""Outside the envelope of its nominal flights the baseline is uncertain; effects with one sign keep it."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fleet.effects import catalogue
from tests.support.effect_flights import CRAFT, Plan, flown
from twin_worker.diagnosis.data.card import UNKNOWN, FaultHypothesis
from twin_worker.diagnosis.inference.isolation.isolate import PARAMETER_COST
from twin_worker.diagnosis.inference.isolation.unmodelled import channel_equations
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals
from twin_worker.diagnosis.model.baseline import CHANNEL_OF, Baseline, Envelope
from twin_worker.diagnosis.model.envelope import extrapolation_sigma, is_other_day, nominal_envelope
from twin_worker.diagnosis.model.residual import ModelledFlight


def flight(height: float, speed: float, day: float) -> Any:
    """The parts of a flight that the envelope reads."""
    n = 500
    readings = {"h": np.full(n, height), "v_n": np.full(n, speed), "v_e": np.zeros(n)}
    return SimpleNamespace(readings=readings, ok=np.ones(n, bool), t_start=day * 86400.0)


def modelled(flown: Any, lift: float) -> Any:
    """The parts of a modelled flight that the envelope reads."""
    c_z = np.linspace(-lift, -0.1, len(flown.ok))
    terms = SimpleNamespace(intermediate={"c_z": c_z})
    return SimpleNamespace(flight=flown, ok=flown.ok, equation_terms=lambda: terms)


@pytest.fixture
def base() -> Baseline:
    nominal = [modelled(flight(600.0, 21.0, 100.0), 0.2), modelled(flight(500.0, 23.0, 100.1), 0.9)]
    return replace(Baseline(UNKNOWN, {}, 22.0), envelope=nominal_envelope(nominal))


def test_inside_the_envelope_nothing_is_added(base: Baseline) -> None:
    assert extrapolation_sigma(base, flight(550.0, 22.0, 100.2)) == {} and not is_other_day(base, flight(1, 1, 100.2))
    assert extrapolation_sigma(replace(base, envelope=None), flight(0.0, 40.0, 3.0)) == {}


def test_a_short_extrapolation_adds_little(base: Baseline) -> None:
    """Half as far as the envelope is wide: half the distance counts."""
    width = base.envelope.ln_density[1] - base.envelope.ln_density[0]  # type: ignore[union-attr]
    near = extrapolation_sigma(base, flight(450.0, 22.0, 100.2))
    assert near["rho"] == pytest.approx(0.25 * width, rel=0.1)


def test_outside_the_envelope_thrust_density_and_airspeed_become_uncertain(base: Baseline) -> None:
    low = extrapolation_sigma(base, flight(40.0, 22.0, 100.2))
    assert low["thrust"] == pytest.approx(0.044, abs=0.004) == low["rho"]  # 460 m below, 9.6 % per km
    assert low["airspeed_scale:log_scale"] == pytest.approx(0.5 * low["rho"])
    fast = extrapolation_sigma(base, flight(550.0, 27.0, 100.2))
    assert list(fast) == ["thrust"] and fast["thrust"] == pytest.approx(np.log(27.0 / 23.0))
    assert is_other_day(base, flight(550.0, 22.0, 101.0))


@pytest.mark.parametrize("name", ["thrust_loss", "drag_increase", "icing", "battery_sag"])
def test_effects_with_one_sign_keep_it(name: str) -> None:
    effect = catalogue()[name]
    negative = FaultHypothesis(effect, "", ()).with_parameters(np.full(effect.n_parameters, -0.01))
    assert all(x == 0.0 or p.nuisance for p, x in zip(effect.parameters, negative.par, strict=True))


def test_the_envelope_holds_the_lift_that_was_flown(base: Baseline) -> None:
    assert base.envelope is not None and base.envelope.c_z == (-0.9, -0.1)


def test_coefficients_do_not_change_where_lift_was_not_calibrated() -> None:
    nominal = ModelledFlight(flown([Plan("nominal", 2)])[0], CRAFT)
    whitened = WhitenedResiduals(nominal)
    highest = float(nominal.equation_terms().intermediate["c_z"].max())
    everywhere = {one.channel: one.gain_of_all().net for one in channel_equations(whitened)}
    envelope = Envelope((0.0, 1.0), (0.0, 9.0), (), (highest + 0.1, highest + 0.2))
    whitened.base = replace(CRAFT, envelope=envelope)
    for one in channel_equations(whitened):
        if one.channel in CHANNEL_OF.values():
            assert one.gain_of_all().net == -PARAMETER_COST * len(one.names) < everywhere[one.channel]
