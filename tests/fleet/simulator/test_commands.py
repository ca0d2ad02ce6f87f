"""Commands to simulated aircraft: missions, speeds and items, acknowledged as ArduPilot and PX4 do."""

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.contract import Item
from fleet.simulator.flight.mavlink import ItemRequest, MavlinkEndpoint, SpeedRequest
from fleet.simulator.flight.mavlink_messages import DIALECTS
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.multirotor.messages import DIALECTS as MULTIROTOR_DIALECTS
from fleet.simulator.multirotor.messages import MultirotorEndpoint
from fleet.simulator.multirotor.uav import SimulatedMultirotor

OLD = tuple(Item(seq=i, command=16, lat_e7=474_000_000 + 9_000 * i, lon_e7=85_000_000, alt_m=80.0) for i in range(6))
NEW = tuple(msgspec.structs.replace(item, alt_m=120.0) for item in OLD[:4])
PLANE = {"AIRSPEED_MIN": 12.0, "AIRSPEED_MAX": 25.0}


class Ground:
    """A ground station beside one endpoint; times are those of the simulation."""

    def __init__(self, endpoint):
        self.endpoint = endpoint
        self._mav, self._ear = mav.MAVLink(None, srcSystem=254, srcComponent=190), mav.MAVLink(None)

    def send(self, message) -> list:
        return self.heard(self.endpoint.receive(bytes(message.pack(self._mav)), 0.0))

    def heard(self, frames) -> list:
        return [message for frame in frames for message in self._ear.parse_buffer(frame) or []]

    def count(self, n: int) -> list:
        return self.send(mav.MAVLink_mission_count_message(1, 1, n))

    def item(self, item: Item, current: int = 0) -> list:
        head = (1, 1, item.seq, item.frame, item.command, current, 1)
        params = (item.param1, item.param2, item.param3, item.param4)
        return self.send(mav.MAVLink_mission_item_int_message(*head, *params, item.lat_e7, item.lon_e7, item.alt_m))

    def command(self, number: int, *params: float) -> int:
        (ack,) = self.send(mav.MAVLink_command_long_message(1, 1, number, 0, *params, *(0.0,) * (7 - len(params))))
        return ack.result


def endpoint(autopilot: str, params=None) -> MavlinkEndpoint:
    return MavlinkEndpoint(1, OLD, params or PLANE, DIALECTS[autopilot])


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_an_upload_replaces_the_mission(autopilot: str) -> None:
    ground = Ground(endpoint(autopilot))
    (request,) = ground.count(len(NEW))
    for item in NEW:
        assert request.seq == item.seq and request.target_system == 254
        request, *_ = ground.item(item, current=int(item.seq == 2))
    assert request.get_type() == "MISSION_ACK" and request.type == mav.MAV_MISSION_ACCEPTED
    stored = ground.endpoint.missions.items
    assert stored[1:] == NEW[1:] and stored[0] == (NEW[0] if autopilot == "px4" else OLD[0]), "item 0 is home"
    (uploaded,) = ground.endpoint.requests
    assert uploaded.items == stored and uploaded.seq == 2


def test_an_upload_that_ends_early_leaves_px4_its_mission_and_ardupilot_a_mixture() -> None:
    for autopilot, repeat_s, end_s in (("px4", 0.3, 5.2), ("ardupilot", 1.1, 8.2)):
        ground = Ground(endpoint(autopilot))
        ground.count(len(NEW))
        ground.item(NEW[0])
        ground.item(NEW[1])
        (repeated,) = ground.heard(ground.endpoint.poll(repeat_s))
        assert repeated.seq == 2, "the request for the missing item is repeated"
        ended = [message.get_type() for message in ground.heard(ground.endpoint.poll(end_s))]
        assert ended == ([] if autopilot == "px4" else ["MISSION_ACK"])
        assert not ground.endpoint.requests
        stored = ground.endpoint.missions.items
        assert stored == OLD if autopilot == "px4" else stored == (OLD[0], NEW[1], *OLD[2:4])
        (answer,) = ground.item(NEW[2])
        assert answer.type == mav.MAV_MISSION_ERROR, "no upload is in progress"


def test_a_download_waits_for_the_end_of_an_upload_and_too_many_items_are_refused() -> None:
    ground = Ground(endpoint("ardupilot"))
    assert ground.count(5_000)[0].type == mav.MAV_MISSION_NO_SPACE
    ground.count(len(NEW))
    assert ground.send(mav.MAVLink_mission_request_list_message(1, 1))[0].type == mav.MAV_MISSION_DENIED
    assert ground.item(NEW[2])[0].type == mav.MAV_MISSION_INVALID_SEQUENCE
    ground = Ground(endpoint("px4"))
    ground.count(len(NEW))
    assert ground.send(mav.MAVLink_mission_request_list_message(1, 1)) == []
    assert ground.item(NEW[2]) == []


@pytest.mark.parametrize(
    ("made", "speed", "accepted"),
    [
        (lambda: endpoint("ardupilot"), 20.0, True),
        (lambda: endpoint("ardupilot"), 30.0, False),
        (lambda: endpoint("ardupilot"), float("nan"), False),
        (lambda: endpoint("ardupilot"), -2.0, True),
        (lambda: endpoint("px4"), 30.0, True),
        (lambda: endpoint("px4"), -1.0, True),
        (lambda: MultirotorEndpoint(1, OLD, PLANE, MULTIROTOR_DIALECTS["ardupilot"]), 8.0, True),
        (lambda: MultirotorEndpoint(1, OLD, PLANE, MULTIROTOR_DIALECTS["ardupilot"]), -2.0, False),
    ],
)
def test_speeds_are_accepted_as_by_the_autopilot(made, speed: float, accepted: bool) -> None:
    ground = Ground(made())
    result = ground.command(mav.MAV_CMD_DO_CHANGE_SPEED, 0.0, speed, -1.0)
    assert (result == mav.MAV_RESULT_ACCEPTED) == accepted
    assert list(ground.endpoint.requests) == [SpeedRequest(max(speed, 0.0))] * accepted


def test_the_current_item_is_commanded() -> None:
    ground = Ground(endpoint("ardupilot"))
    assert ground.command(mav.MAV_CMD_DO_SET_MISSION_CURRENT, 3.0) == mav.MAV_RESULT_ACCEPTED
    assert ground.command(mav.MAV_CMD_DO_SET_MISSION_CURRENT, 6.0) != mav.MAV_RESULT_ACCEPTED
    assert list(ground.endpoint.requests) == [ItemRequest(3)]
    ground = Ground(endpoint("px4"))
    assert ground.command(mav.MAV_CMD_DO_SET_MISSION_CURRENT, 3.0) == mav.MAV_RESULT_UNSUPPORTED
    assert ground.send(mav.MAVLink_mission_set_current_message(1, 1, 3)) == []
    assert list(ground.endpoint.requests) == [ItemRequest(3)]


# --- flown -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_a_fixed_wing_flies_what_was_commanded(autopilot: str) -> None:
    uav = SimulatedUav(0, seed=3, wind=0.0, turbulence=0, autopilot=autopilot)
    ground = Ground(uav)
    ground.endpoint.receive = lambda data, t, receive=uav.receive: receive(data)
    uav.step(5.0)
    before, speed = uav.estimate.Va, uav.setup.kind.cruise + 3.0
    assert ground.command(mav.MAV_CMD_DO_CHANGE_SPEED, 0.0, speed, -1.0) == mav.MAV_RESULT_ACCEPTED
    uav.step(25.0)
    assert abs(uav.estimate.Va - speed) < 1.2 < abs(before - speed)
    raised = [msgspec.structs.replace(item, alt_m=item.alt_m + 40.0) if item.alt_m else item for item in uav.items]
    seq = uav._mission_seq
    ground.count(len(raised))
    for item in raised:
        ground.item(item, current=int(item.seq == seq))
    assert [item.alt_m for item in uav.items][1:] == pytest.approx([item.alt_m for item in raised][1:])
    assert uav._mission_seq == seq
    height = -uav.estimate.p[2]
    uav.step(45.0)
    assert -uav.estimate.p[2] > height + 15.0
    other = next(item.seq for item in uav.items if item.command == 16 and item.seq not in (0, seq, uav._mission_seq))
    if autopilot == "px4":
        ground.send(mav.MAVLink_mission_set_current_message(1, 1, other))
    else:
        ground.command(mav.MAV_CMD_DO_SET_MISSION_CURRENT, float(other))
    assert uav._mission_seq == other and uav.leg[8] == other
    uav.step(46.0)
    assert np.isfinite(uav.estimate.p).all()


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_a_multirotor_flies_what_was_commanded(autopilot: str) -> None:
    uav = SimulatedMultirotor(0, seed=3, wind=0.0, turbulence=0, autopilot=autopilot)
    ground = Ground(uav)
    ground.endpoint.receive = lambda data, t, receive=uav.receive: receive(data)
    uav.step(32.0)
    assert uav.armed
    assert ground.command(mav.MAV_CMD_DO_CHANGE_SPEED, 1.0, 3.0, -1.0) == mav.MAV_RESULT_ACCEPTED
    uav.step(40.0)
    assert np.hypot(*uav.estimate.v[:2]) < 3.6
    last = max(item.seq for item in uav.items if item.command == 16)
    raised = [
        msgspec.structs.replace(item, alt_m=item.alt_m + 20.0) if item.command == 16 else item for item in uav.items
    ]
    ground.count(len(raised))
    for item in raised:
        ground.item(item, current=int(item.seq == last))
    if autopilot == "px4":
        assert uav._mission_seq == last
    else:
        assert uav._mission_seq != last
        ground.command(mav.MAV_CMD_DO_SET_MISSION_CURRENT, float(last))
    assert uav._task.seq == last and uav._task.target[2] == pytest.approx(-raised[last].alt_m, abs=30.0)
