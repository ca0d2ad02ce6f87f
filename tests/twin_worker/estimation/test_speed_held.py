"""Which of its mission's speeds an aircraft holds that does not say what it aims at."""

import numpy as np
import pytest

from fleet.contract import Array, Rows, Sample
from tests.support.flights import T0
from twin_worker.estimation.airspeed_setpoint import inferred_setpoint, reported_demand, reported_setpoint
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


def reporting(demand) -> tuple[TelemetryHistory, float]:
    """Telemetry of an aircraft at 20 m/s that reports an airspeed demand 5 times a second, and its end."""
    history, t = heard(np.full(100, 20.0)), T0 + 0.2 * np.arange(len(demand))
    x = np.zeros((len(t), 5))
    x[:, 4] = np.asarray(demand) - 20.0
    history.add(Sample(uav=1, t=float(t[-1]), command=Rows(Array.of(t, "<f8"), Array.of(x))))
    return history, float(t[-1])


def test_a_demand_on_its_way_is_no_set_point():
    steady, t = reporting(np.full(45, 23.0))
    assert reported_setpoint(steady, t) == pytest.approx(23.0) == reported_demand(steady, t)
    ramp, t = reporting(np.concatenate([np.full(33, 18.0), np.linspace(18.0, 22.0, 12)]))
    assert np.isnan(reported_setpoint(ramp, t))
    assert reported_demand(ramp, t) == pytest.approx(21.6, abs=0.1)


def test_reports_from_before_a_mode_change_do_not_count():
    history, t = reporting(np.full(45, 18.0))
    assert np.isnan(reported_setpoint(history, t, since=t + 0.1))
    assert np.isnan(reported_demand(heard(np.full(100, 20.0)), T0 + 9.9))
