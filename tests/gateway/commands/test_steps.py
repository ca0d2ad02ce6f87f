"""Commands step by step: each repeated until it is acknowledged and verified, over a radio that loses frames."""

from functools import partial

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.contract import Item
from gateway.commands.mission_transfer import MissionRead, MissionWrite, RawItem, check_items, planned_items
from gateway.commands.steps import (
    TRIES,
    AcknowledgedCommand,
    CurrentItemCommand,
    MissionCommand,
    ModeCommand,
)
from tests.support.commanded import CommandedAircraft, StepDriver, mission, raised

TARGET = (1, 1)
AUTOPILOTS = pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])


def raw(items) -> tuple[RawItem, ...]:
    return tuple(RawItem.from_item(item, item.param4) for item in items)


def upload(aircraft: CommandedAircraft, items, current: int = 2) -> MissionCommand:
    plan = partial(planned_items, items, reported=mission(len(aircraft.items)), is_px4=aircraft.is_px4)
    has_home = not aircraft.is_px4
    return MissionCommand(TARGET, plan, raw(items), current=lambda _: current, active_seq=2, has_home=has_home)


def item(seq: int, is_px4: bool) -> CurrentItemCommand:
    return CurrentItemCommand(TARGET, lambda reported: None if reported == seq else seq, is_px4=is_px4)


def names(aircraft: CommandedAircraft) -> list[str]:
    return [message.get_type() for message in aircraft.received]


# --- missions --------------------------------------------------------------------------------------------------------


@AUTOPILOTS
def test_a_mission_is_read_written_read_back_and_kept_for_undo(autopilot: str) -> None:
    aircraft = CommandedAircraft(autopilot)
    before, items = aircraft.items, raised(mission())
    step = upload(aircraft, items)
    result = StepDriver(aircraft).run(step)
    assert result == (True, "mission of 10 items, read back and compared")
    assert [item.alt_m for item in aircraft.items[1:]] == [item.alt_m for item in items[1:]]
    assert step.former == raw(before) and aircraft.seq == 2
    assert names(aircraft).count("MISSION_COUNT") == 1 and names(aircraft).count("MISSION_REQUEST_LIST") == 2
    first = names(aircraft).index("MISSION_COUNT")
    assert {"MISSION_REQUEST_INT", "MISSION_ACK"} <= set(names(aircraft)[:first]), "read before anything is written"


@AUTOPILOTS
def test_uploads_over_a_lossy_radio_are_right_and_never_half_done(autopilot: str) -> None:
    """Fifty of each autopilot, 10 % lost in each direction."""
    for seed in range(50):
        aircraft = CommandedAircraft(autopilot, loss=0.1, seed=seed)
        items = raised(mission(8 + seed % 4), by=10.0 + seed)
        result = StepDriver(aircraft).run(upload(aircraft, items))
        assert result.accepted, result.sentence
        assert [item.alt_m for item in aircraft.items[1:]] == [item.alt_m for item in items[1:]], seed


@AUTOPILOTS
@pytest.mark.parametrize("cut_s", [0.0, 1.5, 2.4, 2.9])
def test_a_link_that_is_cut_is_a_failure_that_says_what_is_known(autopilot: str, cut_s: float) -> None:
    aircraft = CommandedAircraft(autopilot)
    result = StepDriver(aircraft).run(upload(aircraft, raised(mission())), cut_s=cut_s)
    assert not result.accepted
    unchanged = "nothing was changed" in result.sentence
    assert unchanged == ("MISSION_COUNT" not in names(aircraft))
    assert unchanged or "the mission on board is unknown" in result.sentence
    if autopilot == "px4" or unchanged:
        assert aircraft.items in (mission(), raised(mission())), "the old mission or the new one"


def test_a_mixture_on_board_is_detected_and_the_former_mission_restored() -> None:
    class Stubborn(CommandedAircraft):
        """It stores one altitude wrongly, of the new mission only."""

        def tick(self, t, uplink):
            frames = super().tick(t, uplink)
            items = self.endpoint.missions.items
            if len(items) > 5 and items[5].alt_m == 110.0:
                wrong = msgspec.structs.replace(items[5], alt_m=99.0)
                self.endpoint.missions.items = (*items[:5], wrong, *items[6:])
            return frames

    for autopilot in ("ardupilot", "px4"):
        aircraft = Stubborn(autopilot)
        result = StepDriver(aircraft).run(upload(aircraft, raised(mission())))
        assert not result.accepted and result.sentence.endswith("the former mission was restored"), result.sentence
        assert aircraft.items == mission()


@AUTOPILOTS
def test_an_autopilot_without_space_keeps_its_mission(autopilot: str) -> None:
    aircraft = CommandedAircraft(autopilot)
    result = StepDriver(aircraft).run(upload(aircraft, raised(mission(900))))
    assert result == (
        False,
        "mission of 900 items: the autopilot answered no space; the former mission is on board",
    )
    assert aircraft.items == mission()


def test_a_mission_that_must_not_be_sent_is_not_written() -> None:
    aircraft = CommandedAircraft()

    def refuse(former: tuple[RawItem, ...]) -> tuple[RawItem, ...]:
        raise ValueError("it changed")

    step = MissionCommand(TARGET, refuse, (), current=lambda _: 1, active_seq=1, has_home=True)
    assert StepDriver(aircraft).run(step).sentence.endswith("it changed; nothing was changed")
    assert step.stored == step.former and "MISSION_COUNT" not in names(aircraft)


def test_items_on_board_go_back_as_they_were_read_and_others_keep_the_heading() -> None:
    reported = mission(4, frame=0, height=530.0)  # as published: above sea level, heading 0 where it is nan
    former = tuple(
        RawItem(6, 16, (0.0, 0.0, 0.0, float("nan") if k else 1.5), item.lat_e7, item.lon_e7, 80.0)
        for k, item in enumerate(reported)
    )
    moved = msgspec.structs.replace(reported[2], alt_m=600.0)
    new = Item(seq=3, command=16, frame=0, lat_e7=470_000_000, lon_e7=80_000_000, alt_m=600.0)
    turned = msgspec.structs.replace(new, param4=0.7)
    items = tuple(msgspec.structs.replace(item, seq=k) for k, item in enumerate((reported[0], moved, new, turned)))
    sent = planned_items(items, former, reported, is_px4=True)
    assert sent[0] is former[0]
    assert sent[1].z == 600.0 and sent[1].frame == 0 and np.isnan(sent[1].params[3])
    assert np.isnan(sent[2].params[3]) and sent[3].params[3] == 0.7
    assert planned_items(items, former, reported, is_px4=False)[2].params[3] == 0.0
    assert sent[1].is_stored_as(sent[1]._replace(frame=5)) and not sent[1].is_stored_as(former[2])


def test_answers_to_another_station_and_late_items_are_ignored() -> None:
    read = MissionRead(TARGET, 0.0)
    read.messages(0.0)
    read.receive(mav.MAVLink_mission_count_message(255, 190, 3), 0.1)
    read.receive(mav.MAVLink_mission_item_int_message(254, 190, 0, 3, 16, 0, 1, 0, 0, 0, 0, 1, 2, 3.0), 0.1)
    read.receive(mav.MAVLink_mission_count_message(254, 190, 2, 1), 0.1)
    assert not read.items and [m.get_type() for m in read.messages(1.0)] == ["MISSION_REQUEST_LIST"]
    write = MissionWrite(TARGET, raw(mission(2)), 1, 0.0)
    write.messages(0.0)
    write.receive(mav.MAVLink_mission_ack_message(254, 190, mav.MAV_MISSION_ACCEPTED), 0.1)
    assert write.result is None, "no item was requested: an acknowledgement of an earlier transfer"
    write.receive(mav.MAVLink_mission_request_int_message(254, 190, 7), 0.1)
    write.receive(mav.MAVLink_mission_ack_message(254, 190, mav.MAV_MISSION_INVALID_SEQUENCE), 0.1)
    assert write.result is None and write.messages(0.1) == []


@pytest.mark.parametrize(
    "changed",
    [{"seq": 5}, {"alt_m": float("nan")}, {"lat_e7": 910_000_000}, {"command": 70_000}, {"frame": -1}],
)
def test_a_mission_that_cannot_be_right_is_refused(changed: dict) -> None:
    items = mission(3)
    assert not check_items(items)
    assert "found" in check_items((*items[:2], msgspec.structs.replace(items[2], **changed)))
    assert "0 items" in check_items(())


# --- commands --------------------------------------------------------------------------------------------------------


def speed(value: float) -> AcknowledgedCommand:
    return AcknowledgedCommand(TARGET, f"speed {value} m/s", mav.MAV_CMD_DO_CHANGE_SPEED, (0.0, value, -1.0))


@AUTOPILOTS
def test_commands_are_repeated_until_they_are_acknowledged_and_verified(autopilot: str) -> None:
    for seed in range(6):
        aircraft = CommandedAircraft(autopilot, loss=0.3, seed=seed)
        driver = StepDriver(aircraft)
        assert driver.run(speed(17.0)).accepted and aircraft.speed == 17.0
        name, custom = ("LOITER", 12) if autopilot == "ardupilot" else ("LOITER", 3 << 24 | 4 << 16)
        assert driver.run(ModeCommand(TARGET, name, custom, aircraft.is_px4)).accepted and aircraft.mode == name
        assert driver.run(item(5, aircraft.is_px4)).accepted and aircraft.seq == 5


@AUTOPILOTS
def test_an_item_that_is_current_is_not_sent_again(autopilot: str) -> None:
    aircraft = CommandedAircraft(autopilot)
    assert StepDriver(aircraft).run(item(2, aircraft.is_px4)) == (True, "current item 2, not changed")
    assert aircraft.uplink_bytes == 0


def test_an_aircraft_that_has_gone_on_is_not_sent_back() -> None:
    step = item(5, False)
    step.messages(0.0)
    step.receive(mav.MAVLink_mission_current_message(2), 0.1)
    assert len(step.messages(0.1)) == 1
    step.receive(mav.MAVLink_mission_current_message(2), 0.5)
    assert step.result is None
    step.receive(mav.MAVLink_mission_current_message(6), 1.0)  # 5 is reached, its acknowledgement was lost
    assert step.result == (True, "current item 5, now 6") and step.messages(2.0) == []


def test_a_refused_command_and_a_silent_aircraft_are_failures() -> None:
    aircraft = CommandedAircraft()
    assert StepDriver(aircraft).run(speed(40.0)) == (False, "speed 40.0 m/s: the autopilot answered denied")
    silent = CommandedAircraft(loss=1.0)
    for step in (speed(17.0), ModeCommand(TARGET, "RTL", 11, False), item(5, False)):
        result = StepDriver(silent).run(step)
        assert not result.accepted and str(TRIES) in result.sentence
    assert not silent.received


def test_an_acknowledgement_of_another_command_or_station_is_ignored() -> None:
    step = speed(17.0)
    step.receive(mav.MAVLink_command_ack_message(178, 0, 0, 0, 254, 190), 0.0)
    assert step.result is None, "nothing was sent yet"
    (first,) = step.messages(0.0)
    step.receive(mav.MAVLink_command_ack_message(176, 0, 0, 0, 254, 190), 0.1)
    step.receive(mav.MAVLink_command_ack_message(178, 0, 0, 0, 255, 190), 0.1)
    step.receive(mav.MAVLink_command_ack_message(178, mav.MAV_RESULT_IN_PROGRESS, 0, 0, 254, 190), 0.1)
    assert step.result is None
    (second,) = step.messages(1.2)
    assert (first.confirmation, second.confirmation) == (0, 1)
