"""Rotor model identified from a flight of RotorPy physics: thrust, motor lag, which motor, free run, refusal."""

import numpy as np
import pytest

from fleet.simulator.multirotor.tuning import motor_inputs
from fleet.simulator.multirotor.uav import DT, SimulatedMultirotor
from twin_worker.identification.multirotor.rotor_model import (
    MIXER_X,
    RotorData,
    free_run,
    identify_rotors,
    rotation,
    rotor_speeds,
)

SECONDS, MIN_HEIGHT = 120.0, 5.0
Flight = tuple[SimulatedMultirotor, RotorData]


@pytest.fixture(scope="module")
def flight() -> Flight:
    """Outputs and estimates of one flight above the ground, at the rate of an onboard log."""
    uav, rows = SimulatedMultirotor(0, 20_000, wind=2.0), []
    while uav.tick * DT < SECONDS:
        uav.step((uav.tick + 1) * DT)
        e = uav.estimate
        if uav.armed and -e.p[2] > MIN_HEIGHT:
            rows.append(np.concatenate([motor_inputs(uav.pulses, uav.params), e.force, e.rates, e.v, e.euler]))
    columns = np.array(rows)
    return uav, RotorData(DT, columns[:, :4], *(columns[:, k : k + 3] for k in (4, 7, 10, 13)))


def test_thrust_is_within_five_percent_of_the_physics(flight: Flight) -> None:
    uav, data = flight
    kind = uav.vehicle.kind
    k = kind.k_eta * kind.top_speed**2 * np.mean(uav.vehicle._motors**2) / kind.mass
    model = identify_rotors(data)
    assert model.k == pytest.approx(k, rel=0.05)
    assert model.tau == pytest.approx(kind.tau_m, abs=2 * DT)
    assert np.array_equal(np.sign(model.torque), MIXER_X)


def test_the_free_run_fails_with_a_wrong_thrust(flight: Flight) -> None:
    _, data = flight
    n = len(data.outputs) * 6 // 10
    train, held_out = (RotorData(data.dt, *(part[s] for part in data[1:])) for s in (slice(n), slice(n, None)))
    model = identify_rotors(train)
    fit = free_run(model, held_out)
    weak = free_run(model._replace(k=0.9 * model.k), held_out)
    assert fit.attitude.min() > 50
    assert weak.velocity[2] < fit.velocity[2] - 50


def test_a_rotor_follows_its_command_with_the_lag() -> None:
    outputs = np.vstack([np.zeros((1, 4)), np.ones((99, 4))])
    w = rotor_speeds(outputs, 0.01, 0.05, 0.5)
    assert w[6, 0] == pytest.approx(1 - np.exp(-1), abs=1e-9)  # five samples after the step, one behind it
    assert rotation(np.array([[0.0, 0.0, np.pi / 2]]))[0] @ [1, 0, 0] == pytest.approx([0, 1, 0], abs=1e-12)


def test_a_short_flight_is_refused(flight: Flight) -> None:
    short = RotorData(flight[1].dt, *(part[:500] for part in flight[1][1:]))
    with pytest.raises(ValueError, match="found 5 s of flight, expected 30 s"):
        identify_rotors(short)
