"""Simulated aircraft change their mode by command and by failsafe, as their autopilots do."""

from itertools import product

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.autopilots.failsafe import link_loss_steps
from fleet.frames import to_geodetic, to_ned
from fleet.simulator.flight.mavlink_messages import ARDUPLANE_MODES, PX4_AUTO, PX4_MODES
from fleet.simulator.flight.modes import FlightMode
from fleet.simulator.flight.uav import SimulatedUav

LOST_S, STEP_S = 100.0, 0.1
TIMES = {"RC_FS_TIMEOUT": 1.0, "FS_LONG_TIMEOUT": 5.0}


def ask(message: mav.MAVLink_message) -> bytes:
    return bytes(message.pack(mav.MAVLink(None, srcSystem=255, srcComponent=190)))


def received(frames: list[bytes], name: str) -> list:
    ear = mav.MAVLink(None)
    messages = [message for frame in frames for message in (ear.parse_buffer(frame) or [])]
    return [message for message in messages if message.get_type() == name]


def changes(autopilot: str, mode: str, params: dict[str, float]) -> list[tuple[float, str]]:
    """Fly the failsafes of a lost link as timers; return their mode changes and when they come."""
    flown = FlightMode(autopilot, params)
    flown.command(mode)
    flown.contact(LOST_S)
    return [(k * STEP_S, flown.name) for k in range(1, 400) if flown.update(LOST_S + k * STEP_S)]


def agree(flown: list[tuple[float, str]], predicted: list[tuple[float, str]]) -> bool:
    times = np.array([t for t, _ in flown]) - np.array([t for t, _ in predicted]) if len(flown) == len(predicted) else 9
    return [mode for _, mode in flown] == [mode for _, mode in predicted] and bool(np.all(np.abs(times) < 0.25))


@pytest.mark.parametrize("mode", ["AUTO", "GUIDED", "LOITER", "RTL"])
def test_the_failsafes_of_arduplane_come_as_predicted(mode: str) -> None:
    for short, long, radio, ground in product((0, 1, 2, 3, 4), (0, 1, 2, 4), (0, 1), (0, 1, 3)):
        actions = {"FS_SHORT_ACTN": short, "FS_LONG_ACTN": long, "THR_FAILSAFE": radio, "FS_GCS_ENABL": ground}
        params = {name: float(value) for name, value in actions.items()} | TIMES
        predicted = [(step.after_s, step.mode) for step in link_loss_steps("arduplane", mode, params)]
        assert agree(changes("ardupilot", mode, params), predicted), (actions, predicted)


@pytest.mark.parametrize("hold_s", [0.0, 5.0])
def test_the_failsafes_of_px4_come_as_predicted(hold_s: float) -> None:
    for action, by_radio in product((0, 1, 2, 3), (False, True)):
        name = "NAV_RCL_ACT" if by_radio else "NAV_DLL_ACT"
        params = {name: float(action), "COM_FAIL_ACT_T": hold_s, "COM_RC_IN_MODE": 1.0}
        predicted = [(step.after_s, step.mode) for step in link_loss_steps("px4", "MISSION", params)]
        assert agree(changes("px4", "MISSION", params), predicted), (params, predicted)


def test_contact_ends_a_failsafe_and_keeps_the_mode() -> None:
    mode = FlightMode("ardupilot", {"FS_SHORT_ACTN": 1.0, "FS_LONG_ACTN": 1.0} | TIMES)
    mode.contact(0.0)
    assert mode.update(1.3) and mode.name == "CIRCLE" and mode.by_failsafe
    mode.contact(1.4)
    assert not mode.update(2.0) and mode.name == "CIRCLE"


def test_a_commanded_point_is_flown_to_in_guided_and_reported() -> None:
    uav = SimulatedUav(0, 3, wind=2.0, turbulence=0)
    uav.step(1.0)
    point = np.array([400.0, -300.0, 0.0])
    lat, lon, _ = (int(x) for x in to_geodetic(uav.origin, point))
    head = (1, 1, mav.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, mav.MAV_CMD_DO_REPOSITION, 0, 0)
    (ack,) = received(
        uav.receive(ask(mav.MAVLink_command_int_message(*head, -1, 1, 0, 0, lat, lon, 120))), "COMMAND_ACK"
    )
    assert ack.result == mav.MAV_RESULT_ACCEPTED and uav.mode.name == "GUIDED"
    frames = uav.step(3.0)
    assert received(frames, "HEARTBEAT")[-1].custom_mode == ARDUPLANE_MODES["GUIDED"]
    target = received(frames, "POSITION_TARGET_GLOBAL_INT")[-1]
    there = to_ned(uav.origin, *(np.array([x]) for x in (target.lat_int, target.lon_int, target.alt * 1e3)))[0]
    assert there == pytest.approx([400.0, -300.0, -120.0], abs=0.1)
    uav.silent = True
    uav.step(120.0)
    radius = abs(uav.params["WP_LOITER_RAD"])
    assert np.hypot(*(uav.estimate.p - there)[:2]) == pytest.approx(radius, abs=0.5 * radius)


def test_a_return_to_the_mission_continues_its_item() -> None:
    uav = SimulatedUav(0, 3, autopilot="px4")
    uav.step(1.0)
    seq = received(uav.step(2.5), "MISSION_CURRENT")[-1].seq
    for mode in ("RTL", "MISSION"):
        head = (1, 1, mav.MAV_CMD_DO_SET_MODE, 0, mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
        uav.receive(ask(mav.MAVLink_command_long_message(*head, PX4_AUTO, PX4_MODES[mode], 0, 0, 0, 0)))
        frames = uav.step(uav.tick * 0.01 + 2.0)
        assert received(frames, "HEARTBEAT")[-1].custom_mode == PX4_MODES[mode] << 24 | PX4_AUTO << 16
        assert received(frames, "MISSION_CURRENT")[-1].seq == seq
        assert bool(received(frames, "POSITION_TARGET_GLOBAL_INT")) == (mode == "RTL")


def test_a_lost_link_silences_the_aircraft_and_brings_it_home() -> None:
    uav = SimulatedUav(0, 3, extra_params={"FS_SHORT_ACTN": 0.0, "FS_LONG_ACTN": 1.0, "THR_FAILSAFE": 1.0} | TIMES)
    uav.step(1.0)
    uav.link_lost = True
    assert uav.step(7.0) == [] and uav.mode.name == "AUTO"  # 1.2 + 5 s after the last contact
    uav.step(7.6)
    assert uav.mode.name == "RTL" and uav.mode.by_failsafe
    unheard = mav.MAVLink_command_long_message(1, 1, mav.MAV_CMD_DO_SET_MODE, 0, 1, 10, 0, 0, 0, 0, 0)
    assert uav.receive(ask(unheard)) == [] and uav.mode.name == "RTL"
