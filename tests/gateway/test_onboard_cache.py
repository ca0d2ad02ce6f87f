"""What aircraft told before is believed only once it is checked; other missions are noticed; links are not overrun."""

import struct
from types import SimpleNamespace

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.contract import Item, Mission, Params
from fleet.simulator.flight.mavlink import MavlinkEndpoint
from fleet.simulator.flight.mavlink_messages import DIALECTS
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from gateway.link_spec import read_spec
from gateway.onboard import DIAGNOSIS_BYTES_S, MIN_SHARE, WANTED_BYTES_S, RequestSender
from gateway.onboard.parameter_cache_check import Cache
from gateway.onboard.questions import WANTED_HZ, RequestScheduler, budget_of
from tests.support.talker import ITEMS, T0, Aircraft, of

VALUES = {"NAVL1_PERIOD": 17.0, "STAT_RUNTIME": 1.0, **{f"P{k:03d}": k / 7 for k in range(300)}}
LONG = tuple(ITEMS) + tuple(Item(seq=k, command=16, lat_e7=470_100_000 + k) for k in range(len(ITEMS), 60))


class Px4(Aircraft):
    """One that tells the hash over its parameters."""

    def __init__(self, values, number):
        super().__init__(0.0)
        self.voice = MavlinkEndpoint(7, ITEMS, values, DIALECTS["px4"])
        (self._hash,) = struct.unpack("<f", struct.pack("<I", number))
        self.beat = (mav.MAV_TYPE_FIXED_WING, mav.MAV_AUTOPILOT_PX4)

    def hear(self, data, t):
        answers = super().hear(data, t)
        _, asked = self.asked[-1]
        if asked.get_type() == "PARAM_REQUEST_LIST" or getattr(asked, "param_id", "") == "_HASH_CHECK":
            answers.append(self.talker.param("_HASH_CHECK", self._hash, kind=mav.MAV_PARAM_TYPE_UINT32))
        return answers


def ardupilot(values=VALUES, items=LONG, loss=0.0):
    aircraft = Aircraft(loss)
    aircraft.voice = MavlinkEndpoint(7, items, values)
    aircraft.beat = ()
    return aircraft


def fly(aircraft, cache, seconds=90.0, every_tick=lambda t: None):
    """Fly for a while of pretended time; give parameters and mission in the end, and the names of what was asked."""
    intake, onboard, news = MavlinkReceiver(), RequestSender(cache=cache), []
    for step in range(round(seconds * 10)):
        t = T0 + 0.1 * step
        every_tick(0.1 * step)
        if step % 10 == 0:
            intake.receive(t, aircraft.talker.heartbeat(*aircraft.beat), "air")
        for frame in aircraft.stream():
            intake.receive(t, frame, "air")
        news += intake.flush(t)
        for _, data in onboard.tick(t, intake.aircraft.values()):
            for frame in aircraft.hear(data, t):
                intake.receive(t, frame, "air")
    return of(Params, news)[-1], of(Mission, news)[-1], aircraft.names()


def test_what_was_told_before_and_still_holds_is_not_asked_for_again(tmp_path):
    cache = Cache(tmp_path)
    first, mission, names = fly(ardupilot(), cache)
    assert first.complete and mission.items == LONG and names.count("PARAM_REQUEST_LIST") == 1
    later = {**VALUES, "STAT_RUNTIME": 99.0}  # which counts the seconds
    again, mission, names = fly(ardupilot(later), cache)
    assert again.complete and {**again.values, "STAT_RUNTIME": 1.0} == first.values
    assert names.count("PARAM_REQUEST_LIST") == 0 and 20 < names.count("PARAM_REQUEST_READ") < 30
    assert mission.complete and mission.items == LONG


@pytest.mark.parametrize(
    "change", [{"NAVL1_PERIOD": 25.0}, {"EXTRA": 1.0}, {f"P{k:03d}": -1.0 for k in range(0, 300, 3)}]
)
def test_a_change_since_then_is_noticed_and_everything_is_asked_for_anew(tmp_path, change):
    cache = Cache(tmp_path)
    fly(ardupilot(), cache)
    params, _, names = fly(ardupilot({**VALUES, **change}), cache)
    assert names.count("PARAM_REQUEST_LIST") == 1
    assert params.complete and params.values == pytest.approx({**VALUES, **change})


def test_px4_s_hash_tells_whether_anything_changed(tmp_path):
    cache, values = Cache(tmp_path), {"FW_AIRSPD_TRIM": 15.0, "NAV_ACC_RAD": 10.0}
    first, _, _ = fly(Px4(values, 0x7FC01234), cache)  # as a float it is no number
    assert first.values == values
    again, _, names = fly(Px4(values, 0x7FC01234), cache)
    assert again.values == values and again.complete and names.count("PARAM_REQUEST_LIST") == 0
    changed, _, names = fly(Px4({**values, "NAV_ACC_RAD": 20.0}, 5), cache)
    assert changed.values["NAV_ACC_RAD"] == 20.0 and names.count("PARAM_REQUEST_LIST") == 1


@pytest.mark.parametrize("damage", [b"", b"{", b'{"values": 3}', b"\xff"])
def test_a_damaged_card_is_none(tmp_path, damage):
    cache = Cache(tmp_path)
    fly(ardupilot(), cache)
    (path,) = tmp_path.iterdir()
    path.write_bytes(damage)
    params, _, names = fly(ardupilot(), cache, 65.0)
    assert params.complete and names.count("PARAM_REQUEST_LIST") == 1


def test_a_folder_that_cannot_be_written_keeps_nothing_and_costs_nothing(tmp_path, caplog):
    (tmp_path / "file").write_bytes(b"")
    params, mission, _ = fly(ardupilot(), Cache(tmp_path / "file" / "folder"), 65.0)
    assert params.complete and mission.complete and "cannot be cached" in caplog.text


def test_without_a_board_s_number_nothing_is_kept_and_a_lossy_radio_is_no_obstacle(tmp_path):
    aircraft = ardupilot()
    aircraft._silent = ("COMMAND_LONG",)
    params, _, _ = fly(aircraft, Cache(tmp_path), 70.0)
    assert params.complete and not list(tmp_path.iterdir())
    for _ in range(2):
        params, mission, _ = fly(ardupilot(loss=0.3), Cache(tmp_path))
        assert params.complete and mission.items == LONG and params.values == pytest.approx(VALUES)


def test_an_item_changed_unseen_is_found_by_looking_now_and_then(tmp_path):
    aircraft = ardupilot(items=ITEMS)
    other = (*ITEMS[:4], Item(seq=4, command=16, lat_e7=1), *ITEMS[5:])

    def upload_elsewhere(t):
        if t > 30:
            aircraft.voice.missions.items = other

    _, mission, _ = fly(aircraft, None, 30 + 15 * len(ITEMS) + 20, upload_elsewhere)
    lists = [one for _, one in aircraft.asked if one.get_type() == "MISSION_REQUEST_LIST" and not one.mission_type]
    assert mission.items == other and len(lists) == 2


def test_a_mission_recalled_is_proven_item_by_item_soon_after(tmp_path):
    cache = Cache(tmp_path)
    fly(ardupilot(), cache)
    other = (*LONG[:45], Item(seq=45, command=16, lat_e7=1), *LONG[46:])
    slow = ardupilot(items=other)
    slow._silent = ("MISSION_REQUEST_LIST",)
    _, mission, _ = fly(
        slow, cache, 120.0, lambda t: setattr(slow, "_silent", ("MISSION_REQUEST_LIST",) if t < 20 else ())
    )
    assert mission.complete and mission.items == other


# ---- rates


def rates_asked(count, budget):
    """Let aircraft that send nothing but heartbeats be asked for rates; give rates by message, and who asked."""
    intake, onboard, asked = MavlinkReceiver(), RequestSender(budget), {}
    crowd = [Aircraft(0.0, (), system) for system in range(1, count + 1)]
    for step in range(80):
        t = T0 + 0.1 * step
        for aircraft in crowd:
            if step % 10 == 0:
                intake.receive(t, aircraft.talker.heartbeat(), aircraft)
        intake.flush(t)
        for aircraft, data in onboard.tick(t, intake.aircraft.values()):
            aircraft.hear(data, t)
    for aircraft in crowd:
        for _, question in aircraft.asked:
            if question.get_type() == "COMMAND_LONG":
                asked.setdefault(int(question.param1), set()).add(round(1e6 / question.param2, 3))
    return asked, onboard


def test_what_does_not_fit_is_asked_for_in_proportion_and_that_is_said():
    asked, told = rates_asked(1, WANTED_BYTES_S + DIAGNOSIS_BYTES_S + 100.0)
    assert asked[27] == {25.0} and asked[32] == {10.0}
    assert asked[30] == {WANTED_HZ["ATTITUDE"]} and told.sentence == ""
    asked, told = rates_asked(4, WANTED_BYTES_S)
    assert told.share == pytest.approx(0.25, abs=0.02)  # heartbeats count too
    assert told.diagnosis_share == 0.0 and not {27, 32} & set(asked)
    assert {name: list(hz) for name, hz in asked.items() if name in (30, 42)} == {
        30: [pytest.approx(25 * told.share, abs=0.01)],
        42: [pytest.approx(told.share, abs=0.01)],
    }
    assert told.sentence.startswith("4 aircraft would send ") and told.sentence.endswith("link has more capacity")
    assert rates_asked(4, 10.0)[1].share == MIN_SHARE


def test_what_only_diagnosis_needs_is_dropped_first():
    for extra, share in ((1.0, 1.0), (0.6, 0.6), (0.3, 0.0), (0.0, 0.0)):
        asked, told = rates_asked(2, 2 * (WANTED_BYTES_S + extra * DIAGNOSIS_BYTES_S) + 100.0)
        assert told.share == 1.0 and told.sentence == "" and asked[30] == {25.0}
        assert told.diagnosis_share == pytest.approx(share, abs=0.04)
        wanted = [pytest.approx(25.0 * told.diagnosis_share, abs=0.01)] if share else []
        assert list(asked.get(27, ())) == wanted


def scheduled(autopilot: str, rates: dict[str, float]) -> RequestScheduler:
    aircraft = SimpleNamespace(system=1, component=1, autopilot=autopilot, rates=rates)
    return RequestScheduler(aircraft, T0)  # type: ignore[arg-type]


def intervals(scheduler: RequestScheduler, t: float, *shares: float) -> dict[int, float]:
    """The message intervals asked for at a time [us]."""
    return {int(message.param1): message.param2 for message in scheduler._rates(t, *shares) if message.command == 511}


def test_the_imu_message_is_the_autopilots_own_and_stops_when_the_link_gets_slow():
    sent = dict(WANTED_HZ)
    assert intervals(scheduled("ardupilot", sent), T0 + 9.0, 1.0, 1.0) == {27: 40_000.0, 32: 100_000.0}
    assert intervals(scheduled("px4", sent), T0 + 9.0, 1.0, 0.5) == {26: 80_000.0, 32: 200_000.0}
    assert intervals(scheduled("px4", sent | {"HIGHRES_IMU": 50.0}), T0 + 9.0, 1.0, 1.0) == {32: 100_000.0}
    assert intervals(scheduled("generic", sent), T0 + 9.0, 1.0, 1.0) == {}
    scheduler = scheduled("ardupilot", sent)
    assert len(intervals(scheduler, T0 + 9.0, 1.0, 1.0)) == 2
    sent |= {"RAW_IMU": 25.0, "LOCAL_POSITION_NED": 10.0}
    assert intervals(scheduler, T0 + 30.0, 1.0, 1.0) == {}
    assert intervals(scheduler, T0 + 60.0, 1.0, 0.0) == {27: -1.0, 32: -1.0}
    assert intervals(scheduled("ardupilot", sent), T0 + 9.0, 1.0, 0.0) == {}  # another station asked for them


def test_the_budget_suits_the_link_or_is_as_asked_for():
    assert budget_of(read_spec("udpin:127.0.0.1:14550")) == 1e6
    assert budget_of(read_spec("serial:/dev/ttyUSB0:57600")) == pytest.approx(4032)
    assert budget_of(read_spec("serial:/dev/ttyUSB0:57600"), "2k") == 2000
    with pytest.raises(ValueError, match=r"^--budget: found"):
        budget_of(read_spec("udpin:127.0.0.1:14550"), "much")
