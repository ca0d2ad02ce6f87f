"""The multirotor laws of ArduCopter and PX4 against simulated aircraft on other physics and another autopilot."""

import numpy as np
import pytest

from fleet.autopilots import copter_legs
from fleet.contract import Mission
from fleet.frames import G
from fleet.simulator.multirotor.uav import SimulatedMultirotor
from tests.support.flights import HERE, item
from twin_worker.numerics.prediction_errors import min_path_length
from twin_worker.prediction.multirotor import copter_rollout
from twin_worker.prediction.multirotor.config import multirotor_config, speed_in_force
from twin_worker.prediction.multirotor.fit import fit_drag_and_wind
from twin_worker.prediction.multirotor.rollout import MultirotorModel, fly_route
from twin_worker.prediction.multirotor.route import limit_speeds, segments_from_mission
from twin_worker.telemetry.track import STEP, Track

AHEAD = np.arange(0.0, 16.0)


@pytest.mark.parametrize(("autopilot", "aircraft", "limit"), [("ardupilot", "quad", 1.5), ("px4", "quad", 3.0)])
def test_the_route_is_predicted_within_metres(autopilot: str, aircraft: str, limit: float) -> None:
    uav = SimulatedMultirotor(0, 31, wind=3.0, autopilot=autopilot, aircraft=aircraft)
    uav.silent, rows = True, []
    for k in range(1, 751):
        uav.step(k * STEP)
        e = uav.estimate
        rows.append((k * STEP, *e.p, *e.v, *e.euler, float(uav._mission_seq)))
    t, p, v, euler, seq = np.split(np.array(rows), [1, 4, 7, 10], axis=1)
    config = multirotor_config(
        Mission(uav=0, t=0.0, items=uav.items), uav.params, autopilot, 0.0, origin=uav.origin, flown=None
    )
    assert config.plans_legs == (autopilot == "ardupilot")
    errors = []
    for k in range(250, 590, 10):
        flown = Track(t[: k + 1, 0], p[: k + 1], v[: k + 1], euler[: k + 1], np.ones(k + 1, bool), "")
        path, _ = fly_route(flown, seq[: k + 1, 0], config, MultirotorModel(), AHEAD)
        assert path is not None and np.allclose(path[0], p[k], atol=0.01)
        errors.append(np.linalg.norm(path - p[k + np.rint(AHEAD / STEP).astype(int)], axis=1))
    assert np.median(np.array(errors)[:, [5, 10, 15]]) < limit


def test_a_delay_is_a_wait_where_the_aircraft_is_and_a_circle_one_segment() -> None:
    turns = item(3, 18, north=100.0, param1=2.0, param3=-20.0)
    mission = (item(0), item(1, north=50.0), item(2, 93, param1=7.0), turns)
    for arcs in (False, True):
        rows, _ = segments_from_mission(mission, 1, HERE, np.array([0.0, 0.0, -100.0]), {}, arcs=arcs)
        waits = rows[rows[:, 10] == 2]
        assert len(waits) == 1 and waits[0, 9] == 7.0 and np.allclose(waits[0, :3], waits[0, 3:6])
    assert np.count_nonzero(rows[:, 10] == 3) == 2 and rows[-1, 12] == pytest.approx(-4 * np.pi)


def test_a_wait_ends_by_the_flight_before_it_not_by_the_late_report_of_the_item() -> None:
    mission = (item(0), item(1), item(2, north=60.0), item(3, 93, param1=9.0), item(4, north=60.0, east=80.0))
    config = multirotor_config(Mission(uav=0, t=0.0, items=mission), {}, "ardupilot", 0.0, origin=HERE, flown=None)
    segments, _ = segments_from_mission(mission, 2, HERE, np.zeros(3), {}, arcs=True)
    segments = limit_speeds(segments, config.limit)
    par = copter_rollout.parameters(config.limit, {}, (0.25, 0.01, 0.0, 0.0))
    states, flown = np.zeros((500, copter_legs.N_STATE)), np.zeros((500, 4, 3))
    copter_legs.simulated_states(segments, len(segments), par, STEP, states, flown)
    seq = segments[states[:, copter_legs.SEGMENT].astype(int), 10]
    reported = np.concatenate([np.full(9, 2.0), seq[:-9]])
    leaves = int(np.flatnonzero(seq == 4)[0])
    ahead = np.arange(0.0, 8.0, 0.5)
    for k in range(leaves - 40, leaves - 5, 5):
        track = Track(
            STEP * np.arange(k + 1),
            flown[: k + 1, 0],
            flown[: k + 1, 1],
            np.full((k + 1, 3), np.nan),
            np.ones(k + 1, bool),
            "",
        )
        path, _ = fly_route(track, reported[: k + 1], config, MultirotorModel(), ahead)
        assert path is not None
        actual = flown[k + np.rint(ahead / STEP).astype(int), 0]
        assert np.linalg.norm(path - actual, axis=1).max() < 0.5


def test_a_commanded_speed_outlasts_a_jump_back() -> None:
    change = item(3, 178, param1=1.0, param2=7.5)
    items = (item(0), item(1), item(2), change, item(4), item(5, 177), item(6, 178, param1=1.0, param2=3.0), item(7))
    assert speed_in_force(items, np.array([1.0, 1, 2])) == 0.0
    assert speed_in_force(items, np.array([1.0, 2, 4, 4, 2])) == 7.5
    assert speed_in_force(items, np.array([1.0, 2, 4, 2, 4, 7])) == 3.0
    vertical = (item(0), item(1), item(2, 178, param1=2.0, param2=7.5), item(3))
    assert speed_in_force(vertical, np.array([1.0, 3])) == 0.0 == speed_in_force(items, np.empty(0))


def test_errors_in_hover_are_related_to_five_metres() -> None:
    assert min_path_length(0.1) == 5.0 and min_path_length(6.0) == 12.0


def test_the_speed_in_force_limits_legs_and_circles_but_no_return() -> None:
    turns = item(2, 18, north=100.0, param1=1.0, param3=20.0)
    mission = (item(0), item(1, north=50.0), turns, item(3, 178, param1=1.0, param2=7.0), item(4), item(5, 20))
    for speed in (0.0, 4.0):
        rows, _ = segments_from_mission(mission, 1, HERE, np.zeros(3), {}, arcs=True, speed=speed)
        arc = rows[:, copter_legs.TURN] != 0.0
        assert rows[rows[:, 10] == 1, 6].tolist() == [speed] == rows[arc, copter_legs.SPEED_BEFORE].tolist()
        assert rows[arc, 6] == pytest.approx(20.0 * np.pi / 9.0)  # of CIRCLE_RATE; limited when the law prepares it
        assert rows[rows[:, 10] == 4, 6].tolist() == [7.0] and rows[rows[:, 10] == 5, 6][0] == 0.0


def test_drag_and_wind_are_found_from_the_tilt() -> None:
    """A flight on a square in wind, whose tilt balances acceleration and drag (k1 + k2 |u|) u."""
    k1, k2, wind = 0.3, 0.02, np.array([4.0, -2.0])
    t = STEP * np.arange(600)
    heading = np.pi / 2 * np.floor(t / 20.0)
    target = 9.0 * np.column_stack([np.cos(heading), np.sin(heading)])
    v = np.zeros((len(t), 3))
    for k in range(1, len(t)):
        v[k, :2] = v[k - 1, :2] + (target[k] - v[k - 1, :2]) * STEP / 1.5
    acceleration = np.gradient(v[:, :2], STEP, axis=0)
    u = v[:, :2] - wind
    thrust = acceleration + (k1 + k2 * np.linalg.norm(u, axis=1, keepdims=True)) * u
    noise = np.random.default_rng(4).normal(0.0, 0.005, (len(t), 2))
    theta = np.arctan(-thrust[:, 0] / G) + noise[:, 0]
    phi = np.arctan(thrust[:, 1] * np.cos(theta) / G) + noise[:, 1]
    p = np.vstack([np.zeros(3), np.cumsum(v[:-1] * STEP, axis=0)])
    p[:, 2] = -50.0
    track = Track(t, p, v, np.column_stack([phi, theta, 0.0 * t]), np.ones(len(t), bool), "")
    mission = Mission(uav=0, t=0.0, items=(item(0), item(1, north=50.0)))
    config = multirotor_config(mission, {}, "ardupilot", 0.0, origin=HERE, flown=None)
    model = fit_drag_and_wind(track, config, MultirotorModel())
    airspeed = 9.0
    assert model.drag[0] + model.drag[1] * airspeed == pytest.approx(k1 + k2 * airspeed, rel=0.1)
    assert model.wind == pytest.approx(wind, abs=0.5)
    short = Track(t[:20], p[:20], v[:20], track.euler[:20], track.ok[:20], "")
    assert fit_drag_and_wind(short, config, MultirotorModel()) == MultirotorModel()


def test_the_target_of_a_circle_is_shaped_and_the_aircraft_behind_it() -> None:
    mission = (item(0), item(1, north=40.0, alt_m=100.0), item(2, 18, north=40.0, param1=2.0, param3=25.0))
    config = multirotor_config(Mission(uav=0, t=0.0, items=mission), {}, "ardupilot", 0.0, origin=HERE, flown=None)
    rows, _ = segments_from_mission(mission, 2, HERE, np.array([15.0, 0.0, -100.0]), {}, arcs=True, speed=4.0)
    segments = copter_rollout.prepare(limit_speeds(rows, config.limit), rows, mission, {}, config.limit)
    par = copter_rollout.parameters(config.limit, {}, (0.3, 0.0, 0.0, 0.0))
    circle = segments[segments[:, copter_legs.TURN] != 0.0]
    assert len(circle) == 1
    states, xva = np.zeros((300, copter_legs.N_STATE)), np.zeros((300, 4, 3))
    copter_legs.simulated_states(circle, 0, par, STEP, states, xva)
    shaped = states[-1, copter_legs.SHAPED : copter_legs.SHAPED + 2]
    target = circle[0, copter_legs.C_N : copter_legs.C_E + 1] + 25.0 * np.array([
        np.cos(states[-1, copter_legs.ANGLE]), np.sin(states[-1, copter_legs.ANGLE])
    ])  # fmt: skip
    # steady lag of the square root control: v = sq - a v / (k sq), e = sq^2 / 2a + a / 2k^2
    root = (4.0 + np.sqrt(16.0 + 4.0 * 4.0 * 2.5 / 2.0)) / 2.0
    assert np.linalg.norm(target - shaped) == pytest.approx(root**2 / 5.0 + 2.5 / 8.0, rel=0.1)
    assert np.linalg.norm(xva[-1, 0, :2] - shaped) < 1.0
