"""Simulated multirotors: RotorPy's physics, missions from take-off to landing, and the MAVLink of both autopilots."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav
from rotorpy.vehicles.multirotor import Multirotor

from fleet.cli import main
from fleet.commands.live.fly import MULTIROTORS, aircraft_types
from fleet.simulator.multirotor.airframes import TYPES, draw_airframe, hover_thrust
from fleet.simulator.multirotor.copter_guidance import Profile
from fleet.simulator.multirotor.missions import MultirotorMission, draw_mission
from fleet.simulator.multirotor.rigid_body import RotorBody
from fleet.simulator.multirotor.tasks import TaskSequence
from fleet.simulator.multirotor.uav import SimulatedMultirotor
from fleet.simulator.vehicle.missions import HOME, mission_item
from fleet.simulator.vehicle.sensors import pressure_height

TAKEOFF, WAYPOINT, TURNS, DELAY, RETURN, JUMP = 22, 16, 18, 93, 20, 177


def mission(*items: tuple, px4: bool = False) -> MultirotorMission:
    """(command, north, east, height, params) each; item 0 is home except with PX4."""
    listed = [] if px4 else [mission_item(0, WAYPOINT, HOME, (0.0, 0.0, 0.0), frame=0)]
    for command, n, e, h, params in items:
        point = None if command in (RETURN, JUMP, DELAY) else (float(n), float(e), -float(h))
        listed.append(mission_item(len(listed), command, HOME, point, params=params))
    return MultirotorMission(tuple(listed), HOME)


def messages(frames: list[bytes]) -> list:
    parser = mav.MAVLink(None)
    return [message for frame in frames for message in (parser.parse_buffer(frame) or [])]


def test_every_type_can_be_asked_for_and_hovers_at_half_its_thrust() -> None:
    assert set(MULTIROTORS) == set(TYPES)
    assert all(0.35 < hover_thrust(kind) < 0.55 for kind in TYPES.values())
    first, _ = draw_airframe(TYPES["quad"], np.random.default_rng(1))
    second, _ = draw_airframe(TYPES["quad"], np.random.default_rng(2))
    assert first.mass != second.mass and abs(first.mass / second.mass - 1) < 0.25


def test_a_mixed_fleet_alternates_and_refuses_a_fault_of_a_multirotor(capsys: pytest.CaptureFixture[str]) -> None:
    assert aircraft_types("mixed", range(4)) == ["small", "quad", "small", "quad"]
    assert aircraft_types("quad_large", range(2)) == ["quad_large"] * 2
    assert main(["fly", "--uavs", "0", "--aircraft", "quad", "--fault", "drag_increase,dCD=0.03"]) == 2
    assert "expected wings" in capsys.readouterr().err


def test_the_midpoint_rule_agrees_with_rotorpys_own_solver() -> None:
    vehicle = RotorBody(TYPES["quad"], np.ones(4), np.random.default_rng(3), 0.0)
    model = vehicle._model
    vehicle._s[2], vehicle._s[3:6] = 50.0, (3.0, -2.0, 1.0)
    vehicle._s[16:] = 640.0
    vehicle.set_motors(np.array([0.62, 0.62, 0.615, 0.615]))
    state, control = Multirotor._unpack_state(vehicle._s), {"cmd_motor_speeds": vehicle._command.copy()}
    for _ in range(50):
        vehicle.step()
        state = model.step(state, control, 0.01)
    assert np.abs(vehicle._s[:3] - state["x"]).max() < 1e-3
    assert np.abs(vehicle._s[6:10] - state["q"]).max() < 1e-3


@pytest.mark.parametrize("rise", [0.0, 0.3])
@pytest.mark.parametrize(("length", "speed"), [(100.0, 8.0), (20.0, 8.0), (2.0, 8.0), (60.0, 1.0), (0.1, 8.0)])
def test_a_profile_goes_from_rest_to_rest_within_its_limits(length: float, speed: float, rise: float) -> None:
    profile = Profile(length, speed, (2.5, 1.0), rise)
    t = np.linspace(0, profile.duration, 2_000)
    s, v, a = np.array([profile.at(x) for x in t]).T
    assert s[0] == 0 and s[-1] == pytest.approx(length) and abs(v[-1]) < 1e-6
    assert v.max() <= speed + 1e-9 and np.abs(a).max() <= 2.5 + 1e-9
    assert np.allclose(np.gradient(s, t)[1:-1], v[1:-1], atol=0.02)


def test_a_mission_is_traversed_with_jumps_speeds_and_the_next_task_in_sight() -> None:
    plan = mission(
        (TAKEOFF, 0, 0, 10, ()), (WAYPOINT, 30, 0, 10, ()), (DELAY, 0, 0, 0, (4.0,)), (JUMP, 0, 0, 0, (2.0, 1.0)),
        (RETURN, 0, 0, 0, ()),
    )  # fmt: skip
    sequence = TaskSequence(plan.items, HOME, 1)
    ahead, flown = sequence.following(), []
    while (task := sequence.advance()) is not None:
        assert ahead is not None and task.seq == ahead.seq
        flown.append(task.seq)
        ahead = sequence.following()
    assert flown == [1, 2, 3, 2, 3, 5]


def test_draws_differ_by_seed_and_hold_what_the_autopilot_knows() -> None:
    ardupilot, px4 = (draw_mission(5, autopilot, 8.0, HOME) for autopilot in ("ardupilot", "px4"))
    assert [i.seq for i in px4.items] == list(range(len(px4.items)))
    assert {TAKEOFF, WAYPOINT, TURNS, RETURN, JUMP} <= {i.command for i in ardupilot.items}
    assert TURNS not in {i.command for i in px4.items} and px4.items[0].command == TAKEOFF
    assert draw_mission(6, "px4", 8.0, HOME).items != px4.items


FAST = {
    "ardupilot": {"LAND_SPEED": 120.0, "RTL_ALT": 800.0, "RTL_LOIT_TIME": 500.0, "WPNAV_SPEED": 800.0},
    "px4": {"MPC_LAND_SPEED": 1.2, "RTL_RETURN_ALT": 8.0, "NAV_ACC_RAD": 2.0},
}


@pytest.mark.parametrize(("autopilot", "aircraft"), [("ardupilot", "quad"), ("px4", "quad_large")])
def test_it_takes_off_flies_its_mission_and_lands_at_home(autopilot: str, aircraft: str) -> None:
    px4 = autopilot == "px4"
    plan = mission(
        (TAKEOFF, 0, 0, 8, ()), (WAYPOINT, 25, 0, 8, ()), (WAYPOINT, 25, 20, 8, ()), (RETURN, 0, 0, 0, ()), px4=px4
    )
    options = {"wind": 3.0, "autopilot": autopilot, "aircraft": aircraft, "extra_params": FAST[autopilot]}
    uav = SimulatedMultirotor(1, 77, mission=plan, **options)
    frames, rows, armed = uav.initial_frames(), [], []
    for k in range(1, 80):
        frames += uav.step(float(k))
        x = uav.vehicle.truth()
        rows.append((*x.p, *np.degrees(x.euler[:2]), uav._mission_seq))
        armed.append(uav.armed)
        if any(armed) and not armed[-1]:
            break
    rows = np.array(rows)
    assert any(armed) and not armed[-1] and uav.vehicle.on_ground
    assert [int(b) for a, b in pairwise(rows[:, 5]) if a != b] == [k + (not px4) for k in (1, 2, 3)]
    assert np.hypot(*rows[-1, :2]) < 3.0 and -rows[:, 2].min() == pytest.approx(8.0, abs=2.5)
    assert min(np.hypot(rows[:, 0] - 25, rows[:, 1] - 20)) < 6.0
    assert np.abs(rows[:, 3:5]).max() < 40.0
    found = messages(frames)
    count = Counter(message.get_type() for message in found)
    assert count["MISSION_ITEM_INT"] == len(plan.items) and count["PARAM_VALUE"] >= len(uav.params)
    heartbeats = [m for m in found if m.get_type() == "HEARTBEAT"]
    assert {m.type for m in heartbeats} == {mav.MAV_TYPE_QUADROTOR}
    assert {bool(m.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED) for m in heartbeats} == {True, False}
    servos = [m for m in found if m.get_type() == "SERVO_OUTPUT_RAW" and m.servo1_raw > 1200]
    assert all(1_100 <= getattr(m, f"servo{k}_raw") <= 2_000 for m in servos for k in (1, 2, 3, 4)) and servos
    assert {"ATTITUDE", "GLOBAL_POSITION_INT", "LOCAL_POSITION_NED", "VFR_HUD", "MISSION_CURRENT"} <= set(count)
    own = {"ATTITUDE_TARGET", "POSITION_TARGET_LOCAL_NED"} if px4 else {"NAV_CONTROLLER_OUTPUT"}
    assert own <= set(count)


def test_it_obeys_modes_and_positions_from_the_ground() -> None:
    plan = mission((TAKEOFF, 0, 0, 6, ()), (WAYPOINT, 400, 0, 6, ()))
    uav = SimulatedMultirotor(0, 7, mission=plan, wind=1.0)
    uav.silent = True
    uav.step(25.0)
    ground = mav.MAVLink(None, srcSystem=255)
    brake = mav.MAVLink_set_mode_message(1, mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, 5)
    uav.receive(bytes(brake.pack(ground)))
    uav.step(31.0)
    assert uav.mode == "LOITER" and np.linalg.norm(uav.vehicle.truth().v) < 0.5
    place = (0.0, 0.0, 0.0, 0.0, HOME.lat_e7, HOME.lon_e7, 10.0)
    reposition = mav.MAVLink_command_int_message(1, 1, 6, mav.MAV_CMD_DO_REPOSITION, 0, 0, *place)
    before = np.linalg.norm(uav.vehicle.truth().p[:2])
    uav.receive(bytes(reposition.pack(ground)))
    uav.step(40.0)
    assert uav.mode == "GUIDED" and np.linalg.norm(uav.vehicle.truth().p[:2]) < before - 10
    uav.link_lost = True
    assert uav.receive(bytes(brake.pack(ground))) == [] and uav.step(41.0) == []


def test_one_seed_flies_one_flight() -> None:
    first, second = (SimulatedMultirotor(2, 9, aircraft="quad_large") for _ in range(2))
    assert first.step(6.0) == second.step(6.0)
    with pytest.raises(ValueError, match=r"uav-250: found id 250"):
        SimulatedMultirotor(250, 1)


def test_the_static_pressure_falls_with_height() -> None:
    uav = SimulatedMultirotor(0, 31_000, wind=1.0, flight_seed=31_002)
    first = uav.vehicle.truth()
    uav.step(40.0)
    then = uav.vehicle.truth()
    climbed = float(first.p[2] - then.p[2])
    assert climbed > 3.0
    assert pressure_height(then.P) - pressure_height(first.P) == pytest.approx(climbed, rel=1e-6)
