"""The present velocity is the reported one, unless it contradicts the positions."""

import numpy as np
import pytest

from twin_worker.telemetry.velocity import present_velocity

DT, RATE, SPEED = 0.04, 0.2, 18.0


def circle(noise: float = 0.0, rotated: float = 0.0, seconds: float = 25.0) -> tuple[np.ndarray, ...]:
    """Return positions, true velocities and reported velocities, which point `rotated` to the right [rad]."""
    t = DT * np.arange(round(seconds / DT))
    course = RATE * t
    p = SPEED / RATE * np.column_stack([np.sin(course), -np.cos(course), 0.0 * t])
    p += noise * np.random.default_rng(1).standard_normal(p.shape)
    true, reported = (SPEED * np.column_stack([np.cos(a), np.sin(a), 0.0 * t]) for a in (course, course + rotated))
    return p, true, reported


def test_a_velocity_that_agrees_with_the_positions_is_used_as_it_is():
    p, _, reported = circle(noise=0.05)
    assert np.array_equal(present_velocity(p, reported, DT, 1), reported[-1])


def test_a_velocity_that_contradicts_the_positions_is_replaced():
    p, true, reported = circle(noise=0.02, rotated=0.1)  # 1.8 m/s to the side
    assert np.linalg.norm(present_velocity(p, reported, DT, 1) - true[-1]) < 0.4


@pytest.mark.parametrize("seconds", [0.2, 3.0])
def test_a_short_flight_has_its_reported_velocity(seconds):
    p, _, reported = circle(rotated=0.1, seconds=seconds)
    assert np.array_equal(present_velocity(p, reported, DT, 1), reported[-1])
