"""Home of an ArduPilot mission: item 0 as downloaded, HOME_POSITION, and what changes when home moves."""

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.contract import Mission, Status
from fleet.telemetry.mavlink.aircraft_link import AircraftLink
from fleet.telemetry.mavlink.arrays.fleet_arrays import AircraftArrays
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from fleet.telemetry.onboard_logs.px4_missions import read_missions
from fleet.telemetry.onboard_logs.topic import Topic
from gateway.onboard import RequestSender
from tests.support.talker import T0, Ears, Talker, of

PX4 = mav.MAV_AUTOPILOT_PX4


def home(talker, lat=465_000_000, lon=70_000_000, alt_mm=400_100) -> bytes:
    return talker.pack(mav.MAVLink_home_position_message(lat, lon, alt_mm, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0))


def mission(talker, lat=0, lon=0, alt=0.0) -> bytes:
    first = mav.MAVLink_mission_item_int_message(255, 190, 0, 0, 16, 0, 1, 0, 0, 0, 0, lat, lon, alt)
    return talker.mission(talker.pack(first), talker.item(1), talker.item(2, x=470_010_000))


def heard(*parts, autopilot=mav.MAV_AUTOPILOT_ARDUPILOTMEGA):
    """The missions published while an aircraft says one thing a second."""
    intake, talker, news = MavlinkReceiver(), Talker(), []
    for k, part in enumerate([lambda t: b"", *parts, lambda t: b""]):
        intake.receive(T0 + k, talker.heartbeat(autopilot=autopilot) + part(talker), "air")
        news += intake.flush(T0 + k + 0.5)
    return of(Mission, news), intake


@pytest.mark.parametrize("parts", [(mission, home), (home, mission)])
def test_home_position_replaces_the_zeros_of_an_autopilot_without_a_home(parts):
    missions, _ = heard(*parts)
    first = missions[-1].items[0]
    assert (first.lat_e7, first.lon_e7, first.alt_m, first.frame) == (465_000_000, 70_000_000, 400.1, 0)
    assert missions[-1].items[1].seq == 1 and missions[-1].complete


def test_the_newest_of_item_0_and_home_position_counts():
    moved, _ = heard(mission, home, lambda t: home(t, alt_mm=401_000))
    assert moved[-1].items[0].alt_m == 401.0
    downloaded, _ = heard(home, lambda t: mission(t, 465_000_100, 70_000_000, 399.5))
    assert (downloaded[-1].items[0].lat_e7, downloaded[-1].items[0].alt_m) == (465_000_100, 399.5)


def test_a_home_without_position_and_that_of_px4_replace_nothing():
    missions, _ = heard(mission, lambda t: home(t, 0, 0, 0))
    assert missions[-1].items[0].lat_e7 == 0
    px4, _ = heard(mission, home, autopilot=PX4)
    assert px4[-1].items[0].lat_e7 == 0  # the first to fly
    assert px4[-1].items[1].alt_m == pytest.approx(50.0 + 400.1)  # its altitudes are relative to home


@pytest.mark.parametrize(
    ("autopilot", "first"),
    [(mav.MAV_AUTOPILOT_ARDUPILOTMEGA, mission), (PX4, lambda talker: mission(talker, 465_000_000, 70_000_000, 50.0))],
)
def test_home_is_requested_where_the_mission_came_before_it_or_never_contains_it(autopilot, first):
    _, intake = heard(first, autopilot=autopilot)
    onboard = RequestSender()

    def requested(t):
        return [
            m
            for _, data in onboard.tick(t, intake.aircraft.values())
            for m in Ears().feed(data)
            if m.get_type() == "COMMAND_LONG" and m.command == mav.MAV_CMD_REQUEST_MESSAGE
        ]

    (request,) = requested(T0 + 3)
    assert request.param1 == mav.MAVLINK_MSG_ID_HOME_POSITION
    assert not requested(T0 + 3.1)  # it waits for the answer
    intake.receive(T0 + 3.5, home(Talker()), "air")
    intake.flush(T0 + 4)
    assert not requested(T0 + 6)


def test_every_status_carries_the_newest_home_and_none_before_the_autopilot_has_one():
    intake, talker, news = MavlinkReceiver(), Talker(), []
    for k, part in enumerate([b"", home(talker, 0, 0, 0), home(talker), home(talker, lat=465_000_500, alt_mm=399_000)]):
        intake.receive(T0 + k, talker.heartbeat(autopilot=PX4) + part, "air")
        news += intake.flush(T0 + k + 0.5)
    assert [status.home for status in of(Status, news)[-3:]] == [
        None,
        (465_000_000, 70_000_000, 400_100),
        (465_000_500, 70_000_000, 399_000),
    ]


def test_a_ulog_reports_home_with_its_altitude_and_its_place_where_that_is_valid():
    t = np.arange(3.0)
    columns = {"lat": [46.5, 46.5, 46.6], "lon": [7.0, 7.0, 7.1], "alt": [400.0, 401.0, 402.0]}
    flags = {"valid_hpos": [0, 1, 1], "valid_alt": [1, 1, 0]}
    data = {name: np.array(values, float) for name, values in (columns | flags).items()}
    events = read_missions({"home_position": Topic(t, data, {})}, None).events
    assert [(event.t, event.kind) for event in events] == [(0.0, "home"), (1.0, "home")]
    aircraft = AircraftLink(AircraftArrays(), 1, 1, 1)
    homes = []
    for event in events:
        aircraft.process_log_event(event, T0)
        homes.append(aircraft.home)
    assert homes == [None, (465_000_000, 70_000_000, 401_000)]
