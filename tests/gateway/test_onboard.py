import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.contract import Item, Mission, Params
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from gateway.onboard import RequestSender
from tests.support.talker import ITEMS, T0, Aircraft, Ears, Talker, of


def fly(aircraft, seconds, tick=0.1, every_tick=lambda t: None):
    """Let intake and questions talk with an aircraft for a while of pretended time."""
    intake, onboard, news = MavlinkReceiver(), RequestSender(), []
    for step in range(round(seconds / tick)):
        t = T0 + step * tick
        every_tick(t - T0)
        if step % 10 == 0:
            intake.receive(t, aircraft.talker.heartbeat(), "air")
        for frame in aircraft.stream():
            intake.receive(t, frame, "air")
        news += intake.flush(t)
        for where, data in onboard.tick(t, intake.aircraft.values()):
            assert where == "air"
            for frame in aircraft.hear(data, t):
                intake.receive(t, frame, "air")
    return news, intake


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_mission_and_parameters_are_fetched_whatever_the_radio_loses(loss):
    aircraft = Aircraft(loss)
    news, _ = fly(aircraft, 60.0)
    mission, params = of(Mission, news)[-1], of(Params, news)[-1]
    assert mission.complete
    assert mission.items == ITEMS
    assert params.complete
    assert params.values == {f"P{i:03d}": float(i) for i in range(300)}
    if not loss:
        names = aircraft.names()
        assert names.count("PARAM_REQUEST_LIST") == names.count("MISSION_ACK") == 1
        assert [one.mission_type for _, one in aircraft.asked if one.get_type() == "MISSION_REQUEST_LIST"] == [0, 1]
        assert names.count("MISSION_REQUEST_INT") <= len(ITEMS) + 5


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_fence_items_follow_the_mission_and_are_renewed(loss):
    aircraft = Aircraft(loss)
    first, second = (fence_items(n) for n in (4, 6))
    aircraft.voice.missions.fence = first

    def replace(t):
        aircraft.voice.missions.fence = first if t < 60.0 else second

    news, _ = fly(aircraft, 180.0, every_tick=replace)
    fences = [one.fence for one in of(Mission, news) if one.complete]
    assert first in fences and fences[-1] == second and of(Mission, news)[-1].items == ITEMS
    assert set(fences) == {(), first, second}  # never a part
    if not loss:
        asked = [one for _, one in aircraft.asked if one.get_type() == "MISSION_REQUEST_INT" and one.mission_type == 1]
        assert len(asked) <= 2 * 4 + 2 * 6 + 10  # again every minute


def fence_items(n: int) -> tuple[Item, ...]:
    """Return a polygon of n vertices."""
    angles = np.linspace(0.0, 2 * np.pi, n, endpoint=False)
    return tuple(
        Item(
            seq=k,
            command=5001,
            frame=0,
            param1=float(n),
            lat_e7=470_000_000 + round(9e4 * np.cos(a)),
            lon_e7=80_000_000,
        )
        for k, a in enumerate(angles)
    )


def test_an_autopilot_without_fence_items_is_asked_once():
    aircraft = Aircraft(0.0)
    refuse = aircraft.voice.missions.receive

    def receive(message, now):
        if message.mission_type == 1:
            return [mav.MAVLink_mission_ack_message(255, 190, mav.MAV_MISSION_UNSUPPORTED, 1)]
        return refuse(message, now)

    aircraft.voice.missions.receive = receive
    fly(aircraft, 200.0)
    asked = [one for _, one in aircraft.asked if getattr(one, "mission_type", 0) == 1]
    assert len(asked) == 1


def test_a_mission_that_became_shorter_meanwhile_is_asked_for_again():
    aircraft = Aircraft(0.0)

    def shorten(t):
        if any(name == "MISSION_REQUEST_INT" for name in aircraft.names()):
            aircraft.voice.missions.items = ITEMS[:5]

    news, _ = fly(aircraft, 60.0, every_tick=shorten)
    mission = of(Mission, news)[-1]
    assert mission.complete
    assert mission.items == ITEMS[:5]
    assert aircraft.names().count("MISSION_REQUEST_INT") < 150


def test_after_a_restart_the_mission_is_asked_for_again():
    aircraft, intake, onboard = Aircraft(0.0), MavlinkReceiver(), RequestSender()
    for step in range(600):
        t = T0 + 0.1 * step
        if step == 300:
            aircraft.voice.missions.items = ITEMS[:5]
        boot = 500 + 0.1 * step if step < 300 else 0.1 * (step - 300)
        intake.receive(t, aircraft.talker.heartbeat() + aircraft.talker.attitude(boot), "air")
        for _, data in onboard.tick(t, intake.aircraft.values()):
            for frame in aircraft.hear(data, t):
                intake.receive(t, frame, "air")
        intake.flush(t)
    (craft,) = intake.aircraft.values()
    assert craft.mission.items == ITEMS[:5]


def test_who_does_not_answer_is_asked_ever_less():
    silent = ("MISSION_REQUEST_LIST", "PARAM_REQUEST_LIST", "COMMAND_LONG")
    aircraft = Aircraft(0.0, silent)
    fly(aircraft, 300.0)
    names = aircraft.names()
    assert 5 <= names.count("MISSION_REQUEST_LIST") <= 12
    assert 4 <= names.count("PARAM_REQUEST_LIST") <= 9
    assert 295 <= names.count("HEARTBEAT") <= 301
    rates = [question for _, question in aircraft.asked if question.get_type() == "COMMAND_LONG"]
    assert len(rates) == 3 * 8  # three tries, then it is left in peace
    assert {(int(q.param1), q.param2) for q in rates} >= {(30, 40_000.0), (33, 100_000.0)}


def test_rates_that_are_high_enough_are_left_alone():
    intake, onboard, talker = MavlinkReceiver(), RequestSender(), Talker()
    asked = []
    for step in range(1500):
        t = T0 + step * 0.02
        if step % 50 == 0:
            intake.receive(t, talker.heartbeat(), "air")
        intake.receive(t, talker.attitude(step * 0.02), "air")
        if step % 5 == 0:
            intake.flush(t)
            asked += [m for _, d in onboard.tick(t, intake.aircraft.values()) for m in Ears().feed(d)]
    ids = {int(m.param1) for m in asked if m.get_type() == "COMMAND_LONG"}
    assert ids
    assert mav.MAVLINK_MSG_ID_ATTITUDE not in ids


def test_a_lost_aircraft_is_not_spoken_to():
    intake, onboard = MavlinkReceiver(), RequestSender()
    intake.receive(T0, Talker().heartbeat(), "air")
    intake.flush(T0)
    assert onboard.tick(T0, intake.aircraft.values())
    intake.flush(T0 + 10)
    assert onboard.tick(T0 + 10, intake.aircraft.values()) == []


@pytest.mark.parametrize("sign", ["text", "count"])
def test_a_mission_over_another_radio_is_asked_for_within_a_second(sign):
    aircraft, intake, onboard = Aircraft(0.0), MavlinkReceiver(), RequestSender()
    known_at = None
    for step in range(400):
        t = T0 + 0.1 * step
        data = aircraft.talker.heartbeat() + aircraft.talker.attitude(500 + 0.1 * step)
        total = len(ITEMS) - 1
        if step >= 300:
            total = 4
            aircraft.voice.missions.items = ITEMS[:5]
        if sign == "count" and step % 5 == 0:
            data += aircraft.talker.pack(mav.MAVLink_mission_current_message(1, total))
        if sign == "text" and step == 301:
            data += aircraft.talker.pack(mav.MAVLink_statustext_message(6, b"Flight plan received"))
        intake.receive(t, data, "air")
        for _, request in onboard.tick(t, intake.aircraft.values()):
            for frame in aircraft.hear(request, t):
                intake.receive(t, frame, "air")
        intake.flush(t)
        (craft,) = intake.aircraft.values()
        if step >= 300 and known_at is None and craft.mission.items == ITEMS[:5]:
            known_at = step
    assert known_at is not None and known_at <= 315
