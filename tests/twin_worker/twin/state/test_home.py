"""Cold boot: no home at first, positions before the alignment, home set at arming."""

import msgspec
import numpy as np
import pytest

from fleet.contract import Event, Item, Mission, Status
from fleet.frames import Origin
from tests.support import flights as f
from twin_worker.twin.state.home import complete_home
from twin_worker.twin.state.state import Twin, ingest

PLACE = (470_000_000.0, 80_000_000.0)
ZEROS = Item(seq=0, command=16)
MISSION = (ZEROS, Item(seq=1, command=16, frame=3, lat_e7=470_100_000, lon_e7=80_000_000, alt_m=70.0))
HOME = msgspec.structs.replace(ZEROS, lat_e7=470_000_000, lon_e7=80_000_000, alt_m=400.0)


def standing(t, alt_mm, *, gnss_mm=None, above_home=None):
    """Return the rows of one message before take-off."""
    kinds = {"position": ([f.T0 + t], [[*PLACE, alt_mm]])}
    kinds |= {} if gnss_mm is None else {"gnss": ([f.T0 + t], [[gnss_mm]])}
    kinds |= {} if above_home is None else {"height": ([f.T0 + t], [[above_home]])}
    return f.sample(1, **kinds)


def twin_of(autopilot="ardupilot", *messages):
    twin = Twin.of(1)
    for message in (Status(uav=1, t=f.T0, autopilot=autopilot, vehicle="fixed_wing"), *messages):
        ingest(twin, message)
    return twin


def mission(*items, seq=1, t=f.T0):
    return Mission(uav=1, t=t, items=items, seq=seq, complete=True)


def test_the_origin_waits_for_the_altitude_of_the_fix():
    twin = twin_of("ardupilot", standing(0.0, -60.0, gnss_mm=400_100.0), standing(0.5, 0.0))
    assert twin.telemetry.origin is None
    ingest(twin, standing(1.0, 400_150.0, gnss_mm=400_100.0))
    assert twin.telemetry.origin == Origin(470_000_000, 80_000_000, 400_150)
    assert twin_of("px4", standing(0.0, 400_000.0)).telemetry.origin is not None  # no receiver reported
    late = twin_of("ardupilot", *(standing(t, 0.0, gnss_mm=400_100.0) for t in np.arange(0, 12.0, 0.5)))
    assert late.telemetry.origin == Origin(470_000_000, 80_000_000, 0)  # a receiver that differs for good


def test_latitude_and_longitude_zero_are_no_origin():
    nowhere = f.sample(1, position=([f.T0], [[0.0, 0.0, 400_000.0]]))
    assert twin_of("ardupilot", nowhere).telemetry.origin is None


def test_without_home_position_home_is_the_altitude_less_the_height_above_home():
    twin = twin_of("ardupilot", standing(0.0, 470_000.0, above_home=70.0), mission(*MISSION))
    home = twin.onboard.mission.items[0]
    assert (home.lat_e7, home.lon_e7, home.alt_m) == (470_000_000, 80_000_000, 400.0)
    assert twin.onboard.mission.items[1] == MISSION[1]
    ingest(twin, standing(10.0, 470_020.0, above_home=70.0))
    complete_home(twin)
    assert twin.onboard.mission.items[0] is home  # 2 cm are rounding
    ingest(twin, standing(20.0, 470_000.0, above_home=50.0))
    complete_home(twin)
    assert twin.onboard.mission.items[0].alt_m == 420.0


def test_a_home_that_is_known_is_kept_and_a_height_that_is_missing_invents_none():
    twin = twin_of("ardupilot", standing(0.0, 470_000.0, above_home=50.0), mission(HOME, MISSION[1]))
    assert twin.onboard.mission.items == (HOME, MISSION[1])
    assert twin_of("ardupilot", standing(0.0, 470_000.0), mission(*MISSION)).onboard.mission.items == MISSION


def test_relative_altitudes_of_px4_get_the_same_home():
    item = msgspec.structs.replace(MISSION[1], seq=0)
    twin = twin_of("px4", standing(0.0, 470_000.0, above_home=70.0), mission(item, seq=0))
    (flown,) = twin.onboard.mission.items
    assert (flown.frame, flown.alt_m) == (0, 470.0)
    ingest(twin, standing(1.0, 471_000.0, above_home=71.0))
    complete_home(twin)
    assert twin.onboard.mission.items[0] is flown


def events(twin):
    return [] if twin.prediction.latest_event is None else [twin.prediction.latest_event.event]


def test_item_0_is_never_a_changed_mission():
    """Arming moves home by centimetres, and a download before the first fix contains zeros."""
    twin = twin_of("ardupilot", standing(0.0, 400_000.0), mission(*MISSION))
    changed_t = twin.onboard.plan_changed_t
    for k, home in enumerate([HOME, msgspec.structs.replace(HOME, alt_m=400.02, lat_e7=470_000_002)]):
        ingest(twin, mission(home, MISSION[1], t=f.T0 + 10.0 + k))
        assert twin.onboard.mission.items[0] == home
    assert twin.onboard.plan_changed_t == changed_t
    ingest(twin, mission(HOME, msgspec.structs.replace(MISSION[1], alt_m=90.0), t=f.T0 + 20.0))
    assert twin.onboard.plan_changed_t == pytest.approx(f.T0 + 20.0) and events(twin) == [Event.MISSION]


def test_the_first_item_of_px4_is_a_part_of_the_mission():
    first = msgspec.structs.replace(MISSION[1], seq=0, frame=0, alt_m=470.0)
    twin = twin_of("px4", standing(0.0, 400_000.0), mission(first, seq=0))
    ingest(twin, mission(msgspec.structs.replace(first, alt_m=480.0), seq=0, t=f.T0 + 20.0))
    assert twin.onboard.plan_changed_t == pytest.approx(f.T0 + 20.0)


def test_jumps_are_counted_with_the_reported_items():
    loop = [Item(seq=k, command=16, frame=3, lat_e7=470_000_000 + k * 90_000, lon_e7=80_000_000) for k in range(4)]
    items = (*loop, Item(seq=4, command=177, param1=1, param2=2), msgspec.structs.replace(loop[3], seq=5))
    twin = twin_of("ardupilot", standing(0.0, 400_000.0))
    for k, seq in enumerate((1, 2, 3, 1, 2, 3, 1, 2)):
        ingest(twin, mission(*items, seq=seq, t=f.T0 + 10.0 * k))
    assert twin.onboard.jumps_taken == {4: 2}
    assert [counts for *_, counts in twin.onboard.jumps] == [{}] * 3 + [{4: 1}] * 3 + [{4: 2}] * 2
    ingest(twin, mission(*items[:4], seq=1, t=f.T0 + 100.0))
    assert twin.onboard.jumps_taken == {}


def test_jumps_before_the_first_report_are_unknown_until_the_jump_is_passed_or_the_mission_restarts():
    loop = [Item(seq=k, command=16, frame=3, lat_e7=470_000_000 + k * 90_000, lon_e7=80_000_000) for k in range(4)]
    items = (
        *loop,
        Item(seq=4, command=177, param1=2, param2=3),
        *(msgspec.structs.replace(loop[3], seq=k) for k in (5, 6)),
    )

    def reported(*sequence):
        twin = twin_of("ardupilot", standing(0.0, 400_000.0))
        for k, seq in enumerate(sequence):
            ingest(twin, mission(*items, seq=seq, t=f.T0 + 10.0 * k))
        return twin.onboard.skipped_jump()

    assert reported(1, 2, 3) is None and reported(1, 2, 3, 2) is None  # counted from the start
    joined = reported(2, 3)
    assert (joined.seq, joined.probability) == (4, 1 / 4) and [taken for *_, taken in joined.jumps] == [{4: 3}] * 3
    again = reported(3, 2, 3)  # three times at most, once since then
    assert again.probability == 1 / 3 and [taken for *_, taken in again.jumps] == [{4: 2}, {4: 2}, {4: 3}, {4: 3}]
    assert reported(3, 2, 3, 2, 3, 2) is None  # all three seen
    assert reported(2, 3, 5) is None and reported(2, 3, 5, 1, 2) is None
    assert reported(2, 3, 1, 2, 3) is None  # restarted
    assert reported(2, 3, 5, 3) is None  # passed before
