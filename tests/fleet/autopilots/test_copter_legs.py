"""Legs of ArduCopter: descent of a landing, commanded changes of speed, corners, profiles."""

import numpy as np
import pytest

from fleet.autopilots import copter_legs as legs
from fleet.autopilots import position_loop as loop
from fleet.autopilots.copter import A_N, ACC, B_N, HOLD, SPEED
from tests.fleet.autopilots.test_position_loop import parameters

DT = 0.1


def par_of(**changes: float) -> np.ndarray:
    values = {"JERK": 1.0, "JERK_TIME": 0.3, "WP_RADIUS": 2.0, "ACC_CORNER": 5.0, "VEL_D": 0.25} | changes
    return parameters(**values)


def leg(start: tuple[float, ...], end: tuple[float, ...], **columns: float) -> np.ndarray:
    row = np.zeros(legs.N_COLUMNS)
    row[A_N : A_N + 3], row[B_N : B_N + 3] = start, end
    row[SPEED], row[ACC] = 8.0, 2.5
    for name, value in columns.items():
        row[getattr(legs, name)] = value
    return row


def flown(segments: np.ndarray, par: np.ndarray, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return states and simulated motion from rest at the first segment."""
    states, motion = np.zeros((rows, legs.N_STATE)), np.zeros((rows, 4, 3))
    n = legs.simulated_states(segments, len(segments), par, DT, states, motion)
    return states[:n], motion[:n]


@pytest.mark.parametrize(("descent", "low", "land"), [(1.5, 10.0, 0.5), (3.0, 6.0, 0.3)])
def test_a_landing_is_fast_above_its_slow_part_and_slow_within(descent: float, low: float, land: float) -> None:
    row = leg((0.0, 0.0, -40.0), (0.0, 0.0, 0.0), DESCENT=descent, LOW=low)
    row[SPEED], row[HOLD] = land, np.inf
    _, motion = flown(row[None], par_of(ACC_Z=1.0), 900)
    height, rate = -motion[:, 0, 2], motion[:, 1, 2]
    assert descent <= rate.max() < descent + 0.3  # it catches up what it lagged behind
    assert rate[(height > 15.0) & (height < 25.0)] == pytest.approx(descent, abs=0.05)
    assert rate[(height > 1.0) & (height < 0.5 * low)] == pytest.approx(land, abs=0.15)
    assert (np.diff(rate) / DT < 1.5).all() and height[-1] == pytest.approx(0.0, abs=0.1)
    near = (height > low) & (height < low + 4.0)
    assert (rate[near] < np.sqrt(2.0 * (height[near] - low)) + land + 0.6).all()  # it brakes by the height that is left


def test_a_speed_changed_on_a_leg_is_reached_after_the_acceleration_that_has_begun() -> None:
    par = par_of(JERK=1.0, JERK_TIME=0.3)
    slower = leg((0.0, 0.0, 0.0), (200.0, 0.0, 0.0), SPEED_BEFORE=9.0)
    slower[SPEED] = 4.0
    assert legs._speed_after_change(leg((0.0,) * 3, (9.0, 0.0, 0.0)), 3.0, 1.0, par) == 0.0  # nothing was commanded
    reached = legs._speed_after_change(slower, 1.0, 1.0, par)
    assert 4.0 < reached < 9.0  # the acceleration goes on to its limit and ends with its jerk
    assert legs._speed_after_change(slower, 8.0, 2.5, par) == 9.0  # no more than before
    assert legs._speed_after_change(slower, 9.0, -1.0, par) == 9.0
    faster = slower.copy()
    faster[SPEED] = 12.0
    assert legs._speed_after_change(faster, 1.0, 1.0, par) == 9.0
    assert legs._speed_after_change(slower, 1.5, 1.0, par) > reached  # the faster it is, the faster it becomes


def test_a_leg_begun_before_a_slower_speed_ends_at_that_speed() -> None:
    first, second = leg((0.0, 0.0, -9.0), (60.0, 0.0, -9.0)), leg((60.0, 0.0, -9.0), (300.0, 0.0, -9.0))
    second[SPEED], second[legs.SPEED_BEFORE], second[HOLD] = 3.0, 8.0, np.inf
    states, motion = flown(np.array([first, second]), par_of(), 1500)
    on_second = states[:, legs.SEGMENT] == 1
    north, speed = motion[on_second, 0, 0], motion[on_second, 1, 0]
    assert speed[(north > 150.0) & (north < 270.0)] == pytest.approx(3.0, abs=0.05)
    assert speed[north < 100.0].max() > 3.2 and motion[-1, 0, 0] == pytest.approx(300.0, abs=0.5)


def test_a_corner_is_rounded_within_its_radius_and_a_wait_stops() -> None:
    corner = [leg((0.0, 0.0, -9.0), (80.0, 0.0, -9.0)), leg((80.0, 0.0, -9.0), (80.0, 80.0, -9.0))]
    corner[1][HOLD] = np.inf
    _, through = flown(np.array(corner), par_of(), 900)
    corner[0][HOLD] = 2.0
    _, stopping = flown(np.array(corner), par_of(), 900)
    at = np.array([80.0, 0.0, -9.0])
    nearest, stopped = (np.linalg.norm(motion[:, 0] - at, axis=1) for motion in (through, stopping))
    assert 0.2 < nearest.min() < 2.5 and stopped.min() < 0.1
    assert np.linalg.norm(through[nearest.argmin(), 1]) > 1.0 > np.linalg.norm(stopping[stopped.argmin(), 1])


def test_a_profile_keeps_its_limits_and_ends_at_its_length() -> None:
    for length, speed in ((3.0, 8.0), (20.0, 8.0), (200.0, 5.0)):
        row, plan = leg((0.0,) * 3, (length, 0.0, 0.0)), np.zeros(16)
        row[SPEED] = speed
        legs._plan(row, 0.0, row[A_N : A_N + 3], par_of(), plan)
        profile = np.array([legs._at(plan, t) for t in np.arange(0.0, plan[4], 0.05)])
        assert profile[:, 1].max() <= speed + 1e-6 and np.abs(profile[:, 2]).max() <= 2.5 + 1e-6
        assert profile[-1, 0] == pytest.approx(length, rel=0.02) and legs._at(plan, plan[4] + 1.0) == (length, 0.0, 0.0)
    assert loop.stopping_time(4.0, 1.0, 2.5) > 1.0
