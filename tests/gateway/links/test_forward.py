"""Other ground stations beside us: who hears whom, and what never gets through."""

import time

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.contract import Alert, Mission, Params
from fleet.telemetry.mavlink.parsing.decode import IDS
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from gateway.forwarding import DUPLICATE_SENDER, MAX_DATAGRAM, NO_TARGET, targets
from gateway.links.link import Batch
from gateway.pipeline import Pipeline
from tests.support.fake_link import FakeLink
from tests.support.memory_bus import MemoryBus
from tests.support.oracle import framed, ours
from tests.support.talker import ITEMS, Aircraft, Ears, Talker

STATION = Talker(253, 190)
ASK = mav.MAVLink_param_request_list_message
BEAT = STATION.heartbeat(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID)


class Field:
    """A pump with links of aircraft and of stations, and a clock of its own."""

    def __init__(self, air, ground, **settings):
        self.air, self.ground, self.bus = air, ground, MemoryBus()
        self.pump = Pipeline([*air, *ground], self.bus, stations=len(ground), **settings)
        self.now = time.time()

    def say(self, link, where, *frames):
        """One far end of one link says something; forwarded at once."""
        number = self.pump.links.index(link)
        self.pump.take(Batch(number, ReceivedBytes.from_pieces([(self.now, where, b"".join(frames))])))
        self.pump._forward_pending()


@pytest.fixture
def field():
    one, two = FakeLink(), FakeLink("tcpin:127.0.0.1:1")
    found = Field([one, two], [FakeLink("udpin:127.0.0.1:2"), FakeLink("udpout:h:1", known_peers=("far",))])
    found.say(found.ground[0], "qgc", BEAT)
    for k, (link, system) in enumerate(((one, 7), (one, 8), (two, 9))):
        found.say(link, f"air{system}", Talker(system).heartbeat(), Talker(system).attitude(1.0 + k))
    return found


def test_stations_hear_every_aircraft_and_nobody_itself(field):
    assert field.ground[0].told() == {"qgc": ["HEARTBEAT", "ATTITUDE"] * 3}
    assert field.ground[1].told() == {"far": ["HEARTBEAT", "ATTITUDE"] * 3}
    assert [link.told() for link in field.air] == [{}, {}]  # nor do aircraft hear each other
    field.say(field.ground[0], "qgc", BEAT)
    assert [link.told() for link in field.air] == [
        {"air7": ["HEARTBEAT"], "air8": ["HEARTBEAT"]},
        {"air9": ["HEARTBEAT"]},
    ]
    assert [link.told() for link in field.ground] == [{}, {}]


def test_what_is_for_one_goes_to_where_that_one_is(field):
    field.say(field.ground[0], "qgc", STATION.pack(ASK(8, 1)), STATION.pack(ASK(9, 0)))
    assert [link.told() for link in field.air] == [{"air8": ["PARAM_REQUEST_LIST"]}, {"air9": ["PARAM_REQUEST_LIST"]}]
    field.say(field.ground[0], "qgc", STATION.pack(ASK(44, 1)), STATION.pack(ASK(8, 77)))
    assert [link.told() for link in field.air] == [{}, {}]
    assert field.pump.forwarder.refused == {NO_TARGET: 2}
    field.say(field.ground[1], "far", Talker(252, 1).heartbeat(6, 8))
    [link.told() for link in (*field.air, *field.ground)]
    field.say(field.air[0], "air7", Talker(7).pack(mav.MAVLink_mission_ack_message(253, 190, 0)))
    assert [link.told() for link in field.ground] == [{"qgc": ["MISSION_ACK"]}, {}]
    field.say(field.air[0], "air7", Talker(7).pack(mav.MAVLink_mission_ack_message(255, 190, 0)))  # answers us
    assert [link.told() for link in field.ground] == [{}, {}]


def test_a_camera_beside_the_autopilot_is_reached_where_it_speaks(field):
    field.say(field.air[0], "camera", Talker(7, 100).heartbeat(mav.MAV_TYPE_CAMERA, mav.MAV_AUTOPILOT_INVALID))
    field.say(field.ground[0], "qgc", STATION.pack(mav.MAVLink_command_long_message(7, 100, 512, 0, *[0] * 7)))
    assert field.air[0].told() == {"camera": ["COMMAND_LONG"]}


def test_a_second_sender_is_neither_forwarded_nor_given_what_is_for_the_first(field):
    alerts = []
    field.bus.subscribe(Alert, lambda alert, _: alerts.append(alert))
    [link.told() for link in field.ground]
    field.say(field.air[1], "spoofer", Talker(7).attitude(2.0), Talker(7).heartbeat())
    assert [link.told() for link in field.ground] == [{}, {}]
    assert field.pump.forwarder.refused == {DUPLICATE_SENDER: 2}
    field.say(field.ground[0], "qgc", STATION.pack(ASK(7, 1)))
    assert [link.told() for link in field.air] == [{"air7": ["PARAM_REQUEST_LIST"]}, {}]
    field.pump._tick(0.0)
    ((uav, said),) = [(alert.uav, alert.sentence) for alert in alerts]
    assert uav == 7 and "second sender (spoofer)" in said and "first (air7)" in said


def test_a_station_that_speaks_in_an_aircraft_s_name_raises_the_alarm(field):
    field.say(field.ground[0], "qgc", Talker(7).heartbeat())
    field.pump._tick(0.0)
    assert [alert.uav for alert, _ in field.bus.get(Alert)] == [7]


def test_a_station_makes_no_uav_and_is_not_kept(field):
    for _ in range(3):
        field.say(field.ground[0], "qgc", BEAT, Talker(99).heartbeat(), Talker(99).attitude(1.0))
    field.pump._tick(0.0)
    assert [sorted(intake.aircraft) for intake in field.pump.intakes] == [[7, 8], [9], [], []]
    assert [intake._pending_frames for intake in field.pump.intakes] == [[], [], [], []]


def test_listening_only_stations_hear_and_are_not_heard():
    field = Field([FakeLink()], [FakeLink("udpin:127.0.0.1:2")], listen_only=True)
    field.say(field.ground[0], "qgc", BEAT)
    field.say(field.air[0], "air", Talker().heartbeat())
    field.say(field.ground[0], "qgc", BEAT, STATION.pack(ASK(7, 1)))
    assert field.ground[0].told() == {"qgc": ["HEARTBEAT"]}
    assert field.air[0].told() == {}


def test_a_station_gets_what_it_wants_and_a_link_brings_what_it_may():
    air = FakeLink("udpin:127.0.0.1:1#no-messages=STATUSTEXT")
    wants = FakeLink("udpout:h:1#messages=ATTITUDE,STATUSTEXT&systems=7", known_peers=("far",))
    field = Field([air], [wants])
    text = mav.MAVLink_statustext_message(6, b"hello")
    for system in (7, 8):
        talker = Talker(system)
        field.say(air, f"air{system}", talker.heartbeat(), talker.attitude(1.0), talker.pack(text))
    assert wants.told() == {"far": ["ATTITUDE"]}
    assert field.pump.intakes[0].rejected == {"excluded by the filter of the link": 2}
    field.say(wants, "far", STATION.pack(ASK(7, 1)))  # what the station says is not sieved
    assert air.told() == {"air7": ["PARAM_REQUEST_LIST"]}


def test_bytes_go_on_as_they_came_several_to_a_datagram(field):
    talker = Talker()
    frames = [talker.attitude(2.0 + k * 0.01) for k in range(200)]
    [link.told() for link in field.ground]
    field.say(field.air[0], "air7", *frames)
    sent = [data for _, data in field.ground[1].sent]
    assert b"".join(sent) == b"".join(frames)
    assert 1 < len(sent) < 10 and max(map(len, sent)) <= MAX_DATAGRAM


def test_an_upload_by_a_station_is_seen_by_us(field):
    plane = Aircraft(0.0, system=7)
    field.pump._tick(0.0)
    upload = [mav.MAVLink_mission_count_message(7, 1, 2)]
    upload += [
        mav.MAVLink_mission_item_int_message(7, 1, k, 3, 16, 0, 1, 0, 0, 0, 0, 470_000_000, 80_000_000 + k, 60)
        for k in (0, 1)
    ]
    for message in upload:
        field.say(field.ground[0], "qgc", STATION.pack(message))
    field.say(field.air[0], "air7", plane.talker.pack(mav.MAVLink_mission_ack_message(253, 190, 0)))
    field.pump._tick(1.0)
    ((mission, _),) = field.bus.get(Mission, 7)
    assert [item.lon_e7 for item in mission.items] == [80_000_000, 80_000_001]


def test_a_station_loads_parameters_and_mission_through_us_while_we_do(field, monkeypatch):
    plane, heard = Aircraft(0.0, system=7), []
    monkeypatch.setattr("gateway.pipeline.wall", lambda: field.now)
    wanted = [
        mav.MAVLink_mission_request_list_message(7, 1),
        *(mav.MAVLink_mission_request_int_message(7, 1, k) for k in range(12)),
    ]
    asked = iter([ASK(7, 1), *wanted])
    for step in range(600):
        field.now += 0.02
        if step % 10 == 0 and (question := next(asked, None)) is not None:
            field.say(field.ground[0], "qgc", STATION.pack(question))
        said = [plane.talker.heartbeat()] if step % 50 == 0 else []
        for where, data in field.air[0].sent:
            said += plane.hear(data, field.now) if where == "air7" else []
        field.air[0].sent.clear()
        field.say(field.air[0], "air7", *said, *plane.stream())
        if step % 5 == 0:
            field.pump._tick(0.0)
        heard += [message for where, data in field.ground[0].sent if where == "qgc" for message in Ears().feed(data)]
        field.ground[0].sent.clear()
    params = {message.param_id for message in heard if message.get_type() == "PARAM_VALUE"}
    items = {message.seq for message in heard if message.get_type() == "MISSION_ITEM_INT"}
    assert len(params) == 300 and items == set(range(12))
    assert field.bus.get(Mission, 7)[0][0].items == ITEMS
    assert field.bus.get(Params, 7)[0][0].complete


def test_targets_are_read_off_every_message():
    rng = np.random.default_rng(2)
    for name, number in IDS.items():
        kind = mav.mavlink_map[number]
        payload = rng.bytes(kind.unpacker.size)[: max(1, int(rng.integers(kind.unpacker.size + 1)))]
        message = _decoded(kind, payload)
        if message is None:
            continue
        frames = ours([framed(number, payload, kind.crc_extra)])
        assert [int(t[0]) for t in targets(frames)] == [
            getattr(message, field, 0) for field in ("target_system", "target_component")
        ], name


def _decoded(kind, payload):
    try:
        return mav.MAVLink(None).decode(bytearray(framed(kind.id, payload, kind.crc_extra)))
    except (mav.MAVError, ValueError):  # text that is no text
        return None
