"""Sensors as hypotheses: noise of a scaled reading scales with it; a jump is met to the row though noise wanders."""

from functools import cache

import numpy as np
import pytest

from fleet.effects import Onset, catalogue
from tests.support.effect_flights import CRAFT, Plan, flown
from twin_worker.diagnosis.data.card import FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.data.flight import FlightData
from twin_worker.diagnosis.inference.isolation.isolate import scan
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals
from twin_worker.diagnosis.model.baseline import CHANNELS
from twin_worker.diagnosis.model.residual import ModelledFlight

JUMP_S = 40.4
KNOWN = catalogue()


@cache
def flight(bias_m: float = 0.0) -> FlightData:
    """Fly one minute and a bit, the barometer jumping if asked to."""
    hidden = (FaultHypothesis(KNOWN["baro_bias"], "", (bias_m,), OnsetProfile(Onset.STEP, JUMP_S)),) if bias_m else ()
    return flown([Plan("sensors", 77, hidden)])[0]


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
