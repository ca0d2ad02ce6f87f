"""Sensors as hypotheses: noise of a scaled reading scales with it; a jump is met to the row though noise wanders;
a scale error is more than a bias."""

from functools import cache

import numpy as np
import pytest

from fleet.effects import Effect, Onset, catalogue
from tests.support.effect_flights import CRAFT, Plan, flown
from twin_worker.diagnosis.data.card import FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.data.flight import FlightData
from twin_worker.diagnosis.inference.isolation.isolate import scan
from twin_worker.diagnosis.inference.isolation.refine import refine
from twin_worker.diagnosis.inference.isolation.unmodelled import SENSOR_SCALE, find_changed_coefficients
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals
from twin_worker.diagnosis.model.baseline import CHANNELS
from twin_worker.diagnosis.model.residual import ModelledFlight

JUMP_S = 40.4
SHARE = 0.3  # scale error [-]
KNOWN = catalogue()


@cache
def flight(bias_m: float = 0.0) -> FlightData:
    """Fly one minute and a bit, the barometer jumping if asked to."""
    return flight_with(KNOWN["baro_bias"], "", bias_m) if bias_m else flown([Plan("sensors", 77, ())])[0]


def flight_with(effect: Effect, target: str, size: float) -> FlightData:
    """Fly the same with a fault of a sensor from `JUMP_S` on."""
    hidden = FaultHypothesis(effect, target, (size,), OnsetProfile(Onset.STEP, JUMP_S))
    return flown([Plan("sensors", 77, (hidden,))])[0]


@pytest.mark.parametrize("scale", [-0.3, 0.3])
def test_noise_of_an_airspeed_undone_is_that_of_the_sensor(scale: float) -> None:
    case, k = ModelledFlight(flight(), CRAFT), CHANNELS.index("airspeed")
    usual, undone = (
        np.diff(case.residuals(guesses)[case.ok, k], n=2).std()
        for guesses in ((), (FaultHypothesis(KNOWN["airspeed_scale"], "", (scale,)),))
    )
    assert undone == pytest.approx(usual, rel=0.1)


def test_a_jump_is_met_to_the_row() -> None:
    best = next(
        one
        for one in scan(WhitenedResiduals(ModelledFlight(flight(8.0), CRAFT)))
        if one.hypothesis.effect.name == "baro_bias"
    )
    assert best.hypothesis.onset.kind is Onset.STEP and abs(best.hypothesis.onset.t0 - JUMP_S) < 0.5


@pytest.mark.parametrize(
    ("reading", "channel", "bias", "axis"), [("a_z", "gps_z", "accel_bias", "z"), ("p", "gyro_roll", "gyro_bias", "p")]
)
def test_a_scale_error_gains_more_than_a_bias_of_the_same_sensor(
    reading: str, channel: str, bias: str, axis: str
) -> None:
    whitened = WhitenedResiduals(ModelledFlight(flight_with(SENSOR_SCALE, reading, SHARE), CRAFT))
    best = max(find_changed_coefficients(whitened), key=lambda one: one.net_gain)
    assert best.channel == channel and best.hypothesis is not None and abs(best.t0 - JUMP_S) < 0.5
    assert best.hypothesis.par[0] == pytest.approx(SHARE / (1.0 + SHARE), rel=0.2)
    biases = [one for one in scan(whitened) if one.hypothesis.effect.name == bias and one.hypothesis.target == axis]
    assert best.net_gain > max(refine(whitened, one.hypothesis).net_gain for one in biases)
