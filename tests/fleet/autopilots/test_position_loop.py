"""Position loop of multirotors: rates towards a target, drag in wind, and the shaped target of a circle."""

from math import sqrt

import numpy as np
import pytest

from fleet.autopilots import position_loop as loop

DT = 0.05


def parameters(**changes: float) -> np.ndarray:
    """Return the parameters of ArduCopter's loop at its defaults, with changes."""
    par = np.zeros(loop.N_PAR)
    values = {"POS_P": 1.0, "VEL_P": 2.0, "POS_P_Z": 1.0, "VEL_P_Z": 5.0, "TAU": 0.15, "ACC_MAX": 5.0, "ACC_XY": 2.5}
    values |= {"VEL_I": 1.0, "ARDUCOPTER": 1.0, "SHAPING_JERK": 5.0, "ACC_Z": 2.5} | changes
    for name, value in values.items():
        par[getattr(loop, name)] = value
    return par


def test_the_rate_towards_a_target_is_linear_near_it_and_brakes_in_time_far_from_it() -> None:
    assert loop.square_root_control(0.5, 1.0, 2.5) == 0.5
    far = loop.square_root_control(100.0, 1.0, 2.5)
    assert far == pytest.approx(sqrt(2 * 2.5 * (100.0 - 1.25)))
    assert loop.square_root_control(2.5, 1.0, 2.5) == pytest.approx(2.5)  # continuous where both meet
    assert loop.stopping_time(1.0, 1.0, 2.5) == 1.0 and loop.stopping_time(10.0, 1.0, 2.5) == pytest.approx(2.125)


def test_drag_acts_along_the_velocity_through_the_air() -> None:
    par = parameters(DRAG=0.2, DRAG_2=0.05, W_N=3.0, W_E=-4.0)
    assert loop.drag(3.0, -4.0, par) == (0.0, 0.0)
    assert loop.drag(0.0, 0.0, par) == pytest.approx((-3.0 * 0.45, 4.0 * 0.45))


@pytest.mark.parametrize("wind", [0.0, 8.0])
def test_the_aircraft_follows_a_reference_in_wind_as_far_as_its_tilt_allows(wind: float) -> None:
    for limit, keeps_up in ((5.0, True), (1.2, wind == 0.0)):
        par = parameters(DRAG=0.1, DRAG_2=0.01, W_N=-wind, ACC_MAX=limit)
        xva, r = np.zeros((4, 3)), np.zeros((3, 3))
        xva[1, 0] = r[1, 0] = 6.0
        for k in range(1, 801):
            r[0, 0] = 6.0 * (k - 0.5) * DT
            loop.track_reference(xva, r, par, DT)
        assert (abs(xva[1, 0] - 6.0) < 0.1) == keeps_up
        if not keeps_up:  # drag at this airspeed equals the largest acceleration by tilt
            u = xva[1, 0] + wind
            assert (0.1 + 0.01 * u) * u == pytest.approx(limit, rel=0.02)


def test_a_shaped_target_arrives_at_rest_within_speed_acceleration_and_jerk() -> None:
    par, s, rows = parameters(), np.zeros(6), []
    for _ in range(600):
        loop.shape_position(s, (30.0, 40.0), 8.0, par, DT)
        rows.append(s.copy())
    states = np.array(rows)
    speed, acc = np.linalg.norm(states[:, 2:4], axis=1), np.linalg.norm(states[:, 4:], axis=1)
    jerk = np.linalg.norm(np.diff(states[:, 4:], axis=0), axis=1) / DT
    assert speed.max() <= 8.0 * 1.01 and acc.max() <= 2.5 * 1.01 and jerk.max() <= 5.0 * 1.01
    assert np.allclose(s[:2], (30.0, 40.0), atol=0.05) and speed[-1] < 0.01
    assert np.linalg.norm(states[:, :2] - (30.0, 40.0), axis=1)[300:].max() < 2.0  # no overshoot of note
