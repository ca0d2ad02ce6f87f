"""Which of its mission's speeds an aircraft holds that does not say what it aims at."""

import numpy as np
import pytest

from fleet.contract import Array, Rows, Sample
from tests.support.flights import T0
from twin_worker.estimation.airspeed_setpoint import inferred_setpoint
from twin_worker.telemetry.history import TelemetryHistory

SPEEDS = np.array([20.0, 22.5, 25.0])


def heard(Va) -> TelemetryHistory:
    """Give half a minute of airspeeds at 10 Hz, reported by nobody but VFR_HUD."""
    t = T0 + 0.1 * np.arange(len(Va))
    history = TelemetryHistory()
    x = np.column_stack([Va, np.full(len(Va), 0.5), np.zeros(len(Va))])
    history.add(Sample(uav=1, t=float(t[-1]), air=Rows(Array.of(t, "<f8"), Array.of(x))))
    return history


def held(Va, speeds=SPEEDS) -> float:
    return inferred_setpoint(heard(Va), T0 + 0.1 * (len(Va) - 1), speeds)


@pytest.mark.parametrize("speed", SPEEDS)
def test_the_speed_held_in_gusts_is_told(speed):
    gusts = np.random.default_rng(3).standard_normal(300)
    assert held(speed + 0.4 + gusts) == speed


def test_between_two_speeds_on_the_way_to_another_or_far_from_all_none_is_told():
    flat = np.ones(300)
    assert np.isnan(held(21.2 * flat))
    assert np.isnan(held(np.linspace(19.0, 26.0, 300)))
    assert np.isnan(held(30.0 * flat))
    assert np.isnan(held(0.0 * flat)) and np.isnan(held(flat[:3] * 20))
    assert np.isnan(held(20.0 * flat, np.empty(0)))
    assert held(20.3 * flat, SPEEDS[:1]) == 20.0
