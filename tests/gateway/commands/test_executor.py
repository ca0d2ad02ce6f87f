"""Approved execution: nothing without approval, nothing that has changed, everything recorded, all of it undone."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from fleet.contract import Array, Change, ExecutionState, Option
from fleet.frames import to_geodetic
from gateway.commands.region import deviation, read_path
from tests.support.commanded import CommandedAircraft, CommandSite, mission, raised

AUTOPILOTS = pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
S = ExecutionState


@pytest.fixture
def site(tmp_path: Path) -> CommandSite:
    return CommandSite(tmp_path, CommandedAircraft())


def approve(site: CommandSite, option: Option, seconds: float = 8.0, **fields) -> list:
    site.bus.publish(site.approval(site.propose(option), **fields))
    return site.run(seconds)


# --- executed --------------------------------------------------------------------------------------------------------


@AUTOPILOTS
def test_an_approved_option_is_executed_supervised_and_undone(autopilot: str, tmp_path: Path) -> None:
    aircraft = CommandedAircraft(autopilot, loss=0.1, seed=4)
    site = CommandSite(tmp_path, aircraft)
    before, mode = aircraft.items, aircraft.mode
    option = site.option(items=raised(mission()), speed=17.0, mode="hold")
    published = approve(site, option, 60.0)
    states = [execution.state for execution in published]
    assert states[0] == S.APPROVED and states[1] == S.SENDING and S.ACCEPTED in states and S.REFUSED not in states
    last = published[-1]
    assert [step.accepted for step in last.steps] == [True] * 4 and last.can_undo and last.who == "kim"
    assert [item.alt_m for item in aircraft.items[1:]] == [item.alt_m for item in raised(mission())][1:]
    assert (aircraft.speed, aircraft.mode, aircraft.seq) == (17.0, "LOITER", 2)
    assert last.follows and last.sentence == "follows within its region"
    assert site.bus.get(type(last), 1)[0][0].state == S.ACCEPTED

    site.bus.publish(site.approval(site.propose(option), proposal="p1", digest=last.digest, undo=True))
    restored = site.run(60.0)
    assert restored[-1].state == S.UNDONE and not restored[-1].can_undo
    assert aircraft.items == before and (aircraft.speed, aircraft.mode, aircraft.seq) == (20.0, mode, 2)
    events = site.events()
    assert events.count("approved") == events.count("undo_approved") == 1 and events.count("result") == 2


@AUTOPILOTS
def test_each_kind_of_change_alone(autopilot: str, tmp_path: Path) -> None:
    for k, (changes, reached) in enumerate(
        (
            ({"speed": 15.0}, lambda a: a.speed == 15.0),
            ({"seq": 4}, lambda a: a.seq == 4),
            ({"mode": "return"}, lambda a: a.mode == "RTL"),
            ({"items": raised(mission()), "seq": 5}, lambda a: a.seq == 5 and a.items[3].alt_m == 110.0),
        )
    ):
        (folder := tmp_path / str(k)).mkdir(mode=0o700)
        site = CommandSite(folder, CommandedAircraft(autopilot))
        assert approve(site, site.option(**changes), 6.0)[-1].state == S.ACCEPTED
        assert reached(site.aircraft), changes
        site.bus.publish(site.approval(site.propose(site.option(**changes)), undo=True))
        assert site.run(8.0)[-1].state == S.UNDONE
        a = site.aircraft
        seq = 5 if "items" in changes else 2  # with a mission, the item of the same number goes on
        assert (a.speed, a.seq, a.mode, a.items) == (20.0, seq, "MISSION" if a.is_px4 else "AUTO", mission()), changes


@AUTOPILOTS
@pytest.mark.parametrize("seq", [None, 2])
def test_an_aircraft_that_reaches_the_next_item_during_the_upload_goes_on(autopilot: str, seq, tmp_path: Path) -> None:
    site = CommandSite(tmp_path, CommandedAircraft(autopilot))
    items = raised(mission())
    site.bus.publish(site.approval(site.propose(site.option(items=items, seq=seq))))
    while "MISSION_ITEM_INT" not in [message.get_type() for message in site.aircraft.received]:
        site.run(0.1)
    assert site.executor.transferring and site.aircraft.items != items
    site.aircraft.seq = 3
    assert site.run(8.0)[-1].state == S.ACCEPTED and site.aircraft.seq == 3


def test_nothing_is_sent_without_approval(site: CommandSite) -> None:
    """A proposal alone, and a refused approval, cost not one byte on the link."""
    proposal = site.propose(site.option(speed=17.0), valid_s=60.0)
    site.run(6.0)
    site.bus.publish(site.approval(proposal, who=" "))
    (refused,) = site.run(6.0)
    assert refused.state == S.REFUSED and site.aircraft.uplink_bytes == 0 and not site.aircraft.received
    assert site.events() == ["refused"]


def test_a_dry_run_prints_the_messages_and_sends_none(tmp_path: Path) -> None:
    site = CommandSite(tmp_path, CommandedAircraft(), dry=True)
    published = approve(site, site.option(items=raised(mission()), speed=17.0, mode="return"))
    assert published[-1].dry_run and published[-1].state == S.DONE and not published[-1].can_undo
    assert site.aircraft.uplink_bytes == 0
    text = "\n".join(site.lines)
    assert text.count("MISSION_ITEM_INT") == 10 and "command : 178" in text and "command : 176" in text
    assert site.events().count("dry_run") == len([line for line in site.lines if line.startswith("dry run: uav-1:   ")])
    assert "sent" not in site.events()


def test_the_audit_has_every_message_before_it_is_sent(site: CommandSite) -> None:
    before = len(site.aircraft.received)
    approve(site, site.option(items=raised(mission()), speed=17.0))
    entries = site.entries()
    sent = [entry["message"]["mavpackettype"] for entry in entries if entry["event"] == "sent"]
    assert sent == [message.get_type() for message in site.aircraft.received[before:]]
    received = [entry["message"]["mavpackettype"] for entry in entries if entry["event"] == "received"]
    assert {"COMMAND_ACK", "MISSION_ACK", "MISSION_REQUEST", "MISSION_COUNT"} == set(received)
    assert [entry["accepted"] for entry in entries if entry["event"] == "step"] == [True] * 3
    assert {entry["who"] for entry in entries if entry["event"] == "approved"} == {"kim"}
    assert all(entry["time"].endswith("Z") for entry in entries) and entries[-1]["state"] == "accepted"


def test_an_audit_that_cannot_be_written_stops_everything(site: CommandSite, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(now: float, entries: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(site.audit, "write", full)
    published = approve(site, site.option(speed=17.0))
    assert published[-1].state == S.FAILED and "No space left" in published[-1].sentence
    assert site.aircraft.uplink_bytes == 0


def test_a_failed_step_ends_the_execution_and_what_was_changed_can_be_undone(site: CommandSite) -> None:
    published = approve(site, site.option(seq=4, speed=40.0, mode="hold"))
    assert published[-1].state == S.FAILED and "denied" in published[-1].sentence and published[-1].can_undo
    assert [step.accepted for step in published[-1].steps] == [True, False, None]
    assert (site.aircraft.seq, site.aircraft.mode) == (4, "AUTO")
    site.bus.publish(site.approval(site.propose(site.option(seq=4, speed=40.0, mode="hold")), undo=True))
    assert site.run(8.0)[-1].state == S.UNDONE and site.aircraft.seq == 2


# --- refused ---------------------------------------------------------------------------------------------------------


def reason(published: list) -> str:
    refused = [execution for execution in published if execution.state == S.REFUSED]
    assert len(refused) == len(published) == 1, [execution.state for execution in published]
    return refused[0].sentence


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"proposal": "p2"}, "no worker has published"),
        ({"digest": "0" * 64}, "no option with the changes"),
        ({"t": 0.0}, "s old"),
        ({"who": ""}, "names nobody"),
        ({"who": "x" * 1000}, "names nobody"),
        ({"undo": True}, "has executed no such proposal"),
    ],
)
def test_a_forged_approval_is_refused(site: CommandSite, fields: dict, expected: str) -> None:
    assert expected in reason(approve(site, site.option(speed=17.0), **fields))
    assert site.aircraft.uplink_bytes == 0


def test_an_approval_is_executed_once_also_after_a_restart(site: CommandSite, tmp_path: Path) -> None:
    proposal = site.propose(site.option(speed=17.0))
    approval = site.approval(proposal)
    site.bus.publish(approval)
    assert site.run(5.0)[-1].state == S.ACCEPTED
    sent = site.aircraft.uplink_bytes
    site.bus.publish(approval)
    assert "approved before" in reason([e for e in site.run(3.0) if e.state == S.REFUSED])
    again = CommandSite(tmp_path, CommandedAircraft())
    proposal = again.propose(again.option(speed=17.0))
    again.bus.publish(again.approval(proposal))
    assert "approved before" in reason(again.run(3.0))
    assert site.aircraft.uplink_bytes == sent and again.aircraft.uplink_bytes == 0


def test_an_expired_a_withdrawn_and_a_changed_proposal_are_refused(site: CommandSite) -> None:
    option = site.option(speed=17.0)
    proposal = site.propose(option, valid_s=5.0)
    site.run(6.0)
    site.bus.publish(site.approval(proposal))
    assert "expired" in reason(site.run(1.0))
    site.propose(name="p2")
    site.bus.publish(site.approval(proposal, proposal="p2"))
    assert "withdrawn" in reason(site.run(1.0))
    shown = site.propose(site.option(speed=17.0), name="p3")
    site.run(0.1)
    site.propose(site.option(speed=15.0), name="p3")
    site.bus.publish(site.approval(shown))
    assert "newest version" in reason(site.run(1.0))
    assert site.aircraft.uplink_bytes == 0


def test_the_newest_version_of_a_proposal_counts_wherever_its_option_stands(site: CommandSite) -> None:
    shown = site.propose(site.option(speed=17.0))
    site.aircraft.offset[1] = 60.0  # outside of the region of the version that was shown, inside of the newest
    site.run(1.0)
    site.propose(site.option(speed=15.0), site.option(speed=17.0))
    site.bus.publish(site.approval(shown))
    last = site.run(5.0)[-1]
    assert last.state == S.ACCEPTED and last.option == 1 and site.aircraft.speed == 17.0


def test_until_its_approval_an_aircraft_is_compared_with_its_present_plan(site: CommandSite) -> None:
    def aside(option: Option) -> Option:
        (path,) = option.paths
        moved = Array.of(path.path.numpy() + np.float32([500.0, 0.0, 0.0]))
        return msgspec.structs.replace(option, paths=(msgspec.structs.replace(path, path=moved),))

    site.bus.publish(site.approval(site.propose(aside(site.option(speed=17.0)))))
    assert "outside of the region predicted for now" in reason(site.run(1.0))
    option = site.option(speed=17.0)
    site.bus.publish(site.approval(site.propose(aside(option), name="p2", present=option.paths)))
    assert site.run(5.0)[-1].state == S.ACCEPTED and site.aircraft.speed == 17.0


@pytest.mark.parametrize("offset", [(40.0, 0.0, 0.0), (0.0, 30.0, 0.0), (0.0, 0.0, -20.0)])
def test_an_aircraft_outside_of_the_region_is_refused(site: CommandSite, offset: tuple) -> None:
    proposal = site.propose(site.option(speed=17.0))
    site.aircraft.offset = np.array(offset)
    site.run(1.0)
    site.bus.publish(site.approval(proposal))
    assert "outside of the region predicted for now" in reason(site.run(1.0))
    assert site.aircraft.uplink_bytes == 0


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        (lambda site: setattr(site.aircraft, "mode", "LOITER"), "at the proposal it was AUTO"),
        (lambda site: setattr(site.aircraft, "mode", "FBWA"), "a person may be flying"),
        (lambda site: setattr(site.aircraft, "armed", False), "not armed"),
        (lambda site: setattr(site.aircraft.endpoint.missions, "items", raised(mission())), "not the one of"),
        (lambda site: setattr(site.receiver.aircraft[1].mission, "needs_download", True), "not confirmed"),
    ],
)
def test_a_changed_situation_is_refused(site: CommandSite, changed, expected: str) -> None:
    proposal = site.propose(site.option(speed=17.0))
    site.run(0.2)
    changed(site)
    if site.aircraft.items != mission():
        site.download()
        site.receiver.aircraft[1].mission.needs_download = True
        site.download()
    site.run(1.5)
    site.bus.publish(site.approval(proposal))
    assert expected in reason(site.run(1.0))
    assert site.aircraft.uplink_bytes == 0


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"speed": float("nan")}, "found speed"),
        ({"speed": -3.0}, "found speed"),
        ({"seq": 10}, "found item 10"),
        ({"mode": "land"}, "no mode to land"),
        ({"mode": "acro"}, "no mode to acro"),
        ({"items": ()}, "0 items"),
        ({"items": tuple(msgspec.structs.replace(item, param1=1e300) for item in mission())}, "finite"),
        ({}, "without content"),
    ],
)
def test_a_proposal_that_cannot_be_right_is_refused(site: CommandSite, changes: dict, expected: str) -> None:
    assert expected in reason(approve(site, site.option(**changes)))
    assert site.aircraft.uplink_bytes == 0


def test_other_aircraft_paths_and_permissions(site: CommandSite, tmp_path: Path) -> None:
    option = site.option(speed=17.0)
    broken = msgspec.structs.replace(option.paths[0], path=option.paths[0].ahead)
    for wrong, expected in (
        (msgspec.structs.replace(option, changes=(Change(uav=5, speed=17.0),)), "uav-5 is not received"),
        (msgspec.structs.replace(option, changes=(Change(uav=50, speed=17.0),)), "--allow commands:50"),
        (msgspec.structs.replace(option, changes=()), "changes no aircraft"),
        (msgspec.structs.replace(option, changes=option.changes * 2), "one twice"),
        (msgspec.structs.replace(option, paths=()), "no predicted path"),
        (msgspec.structs.replace(option, paths=(broken,)), "invalid path"),
    ):
        assert expected in reason(approve(site, wrong))
    proposal = site.propose(option)
    site.receiver.remove_silent(site.now)
    site.bus.publish(site.approval(proposal, uav=9))
    assert site.run(1.0) == [], "another gateway's"
    assert site.aircraft.uplink_bytes == 0


def test_an_aircraft_that_is_being_commanded_takes_no_second_proposal(site: CommandSite) -> None:
    proposal = site.propose(site.option(items=raised(mission())), name="p1")
    site.bus.publish(site.approval(proposal))
    site.run(1.0)
    other = site.propose(site.option(speed=17.0), name="p2")
    site.bus.publish(site.approval(other))
    assert any("being commanded" in execution.sentence for execution in site.run(1.0))
    assert site.executor.transferring == {1}


def test_a_mission_that_somebody_else_changed_is_neither_overwritten_nor_undone(site: CommandSite) -> None:
    option = site.option(items=raised(mission()))
    proposal = site.propose(option)
    site.run(0.2)
    site.aircraft.endpoint.missions.items = raised(mission(), by=5.0)  # not yet downloaded by the gateway
    site.bus.publish(site.approval(proposal))
    assert "not the one of the proposal; nothing was changed" in site.run(20.0)[-1].sentence
    assert site.aircraft.items == raised(mission(), by=5.0)

    site.aircraft.endpoint.missions.items = mission()
    site.download()
    proposal = site.propose(site.option(items=raised(mission())), name="p2")
    site.bus.publish(site.approval(proposal))
    assert site.run(20.0)[-1].state == S.ACCEPTED
    site.aircraft.endpoint.missions.items = raised(mission(), by=5.0)
    site.bus.publish(site.approval(proposal, undo=True))
    assert "not the one that was uploaded; nothing was changed" in site.run(20.0)[-1].sentence
    assert site.aircraft.items == raised(mission(), by=5.0)


# --- supervision -----------------------------------------------------------------------------------------------------


def test_a_flight_that_leaves_the_region_is_reported(site: CommandSite) -> None:
    approve(site, site.option(speed=17.0), 12.0)  # no worker predicts anew: its own path is taken
    site.aircraft.offset[1] = -45.0
    published = site.run(4.0)
    assert published[-1].follows is False and published[-1].can_undo
    assert published[-1].sentence.startswith("does not follow: uav-1 is off the path: 45 m left of it (its region")
    site.aircraft.offset[1] = 0.0
    assert site.run(2.0)[-1].sentence == "follows within its region"
    site.aircraft.mode = "FBWA"
    assert "is in mode FBWA" in site.run(6.0)[-1].sentence
    site.t += 105.0
    published = site.run(15.0)
    assert published[-1].state == S.DONE and "has ended" in published[-1].sentence


@pytest.mark.parametrize(("behind_m", "is_inside"), [(0.0, True), (1.5, True), (3.0, True), (6.0, False)])
def test_the_region_of_a_position_has_its_error(site: CommandSite, behind_m: float, *, is_inside: bool) -> None:
    """A second after the start the region of the path reaches 1 m: less than what a receiver's position is off."""
    (path,) = site.option(speed=17.0).paths
    narrow = np.ones_like(path.path.numpy())
    path = msgspec.structs.replace(path, prediction_region_half_axes=Array.of(narrow))
    predicted = read_path(path)
    ned, course = predicted.at(np.array([1.0]))[0], float(predicted.headings(np.array([1.0]))[0])
    ned -= behind_m * np.array([np.cos(course), np.sin(course), 0.0])
    found = deviation(path, 1.0, to_geodetic(predicted.origin, ned)[0])
    assert found is not None and found.errors[0] == pytest.approx(-behind_m, abs=0.05)
    assert found.is_inside is is_inside


def test_a_flight_is_compared_with_the_path_predicted_after_the_execution(site: CommandSite) -> None:
    """The path of the proposal is 300 m aside from the moment on at which the change begins."""
    option = site.option(speed=17.0)
    (path,) = option.paths
    aside = path.path.numpy() + np.float32([0.0, 300.0, 0.0])
    late = msgspec.structs.replace(option, paths=(msgspec.structs.replace(path, path=Array.of(aside)),))
    site.bus.publish(site.approval(site.propose(late, present=option.paths)))
    assert site.run(3.0)[-1].state == S.ACCEPTED
    other = msgspec.structs.replace(option, changes=(Change(uav=1, speed=15.0),))
    for wrong in (other, msgspec.structs.replace(option, paths=(msgspec.structs.replace(path, path=path.ahead),))):
        site.propose(wrong, valid_s=0.0)
    site.run(2.0)
    assert site.executions[-1].follows is None
    site.propose(site.option(speed=17.0), valid_s=0.0)
    assert site.run(3.0)[-1].sentence == "follows within its region"


def test_a_version_that_was_shown_may_be_approved_while_it_is_renewed(site: CommandSite) -> None:
    def inserted(ahead: int) -> Option:
        items = mission()
        moved = msgspec.structs.replace(items[3], lat_e7=items[3].lat_e7 + 100 * ahead)
        return site.option(items=(*items[:3], moved, *items[4:]))

    shown = site.propose(inserted(1), valid_s=15.0)
    site.run(5.0)
    site.propose(inserted(2), valid_s=15.0)
    site.run(5.0)
    site.bus.publish(site.approval(shown))
    assert site.run(8.0)[-1].state == S.ACCEPTED
    assert site.aircraft.items[3].lat_e7 == mission()[3].lat_e7 + 100, "what was shown"

    shown = site.propose(site.option(speed=17.0), name="p2", valid_s=15.0)
    site.run(16.0)
    site.propose(site.option(speed=17.0), name="p2", valid_s=15.0)
    site.run(1.0)
    site.propose(name="p2")
    site.bus.publish(site.approval(shown))
    assert "withdrawn" in reason([one for one in site.run(1.0) if one.state == S.REFUSED])
