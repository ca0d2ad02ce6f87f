"""Routes of the modes that an autopilot flies by itself, and the failsafe that its parameters describe."""

from math import degrees, pi

import msgspec
import numpy as np
import pytest

from fleet import mission as m
from fleet.autopilots import modes
from fleet.autopilots.arduplane.legs import is_return
from fleet.autopilots.failsafe import link_loss_steps
from fleet.contract import Item
from fleet.frames import Origin, to_geodetic

HERE = Origin(470_000_000, 80_000_000, 500_000)
HOME = np.array([-300.0, 400.0, 0.0])
ENTRY = np.array([1000.0, 50.0, -120.0])


def situation(**more) -> modes.ModeSituation:
    options = {"origin": HERE, "entry": ENTRY, "course": pi / 2, "position": ENTRY, "home": HOME} | more
    return modes.ModeSituation(**options)


def legs_of(law: str, mode: str, params=None, **more) -> np.ndarray:
    route = modes.mode_route(law, mode, situation(**more), params or {})
    assert route is not None and (len(route.legs) == 0 or (route.legs[:, m.SEQ] <= 0).all() or mode == "RTL")
    return route.legs


def test_rtl_circles_over_home_at_its_altitude_and_radius():
    (leg,) = legs_of("arduplane", "RTL", {"RTL_ALTITUDE": 80.0, "RTL_RADIUS": -70.0})
    assert leg[m.KIND] == m.LOITER_UNLIMITED and leg[m.RADIUS] == -70.0
    assert leg[m.P_N : m.P_D + 1] == pytest.approx([-300, 400, -80])


def test_rtl_in_older_units_and_at_the_present_height():
    assert legs_of("arduplane", "RTL", {"ALT_HOLD_RTL": 6000.0})[0, m.P_D] == -60.0
    assert legs_of("arduplane", "RTL", {"RTL_ALTITUDE": -1.0})[0, m.P_D] == ENTRY[2]


def test_a_reported_target_replaces_home_as_at_a_rally_point():
    rally = np.array([200.0, -900.0, -150.0])
    assert legs_of("arduplane", "RTL", target=rally)[0, m.P_N : m.P_D + 1] == pytest.approx(rally)
    assert legs_of("arduplane", "RTL", home=None, target=rally)[0, m.P_N] == 200.0


def test_without_home_the_return_is_not_predicted_and_says_why():
    for law in ("arduplane", "px4"):
        route = modes.mode_route(law, "RTL", situation(home=None), {})
        assert not len(route.legs) and "home position unknown" in route.summary


@pytest.mark.parametrize("law", ["arduplane", "px4"])
def test_loiter_circles_where_it_was_entered_or_about_the_reported_centre(law):
    (leg,) = legs_of(law, "LOITER")
    assert leg[m.KIND] == m.LOITER_UNLIMITED and leg[m.P_N : m.P_D + 1] == pytest.approx(ENTRY)
    assert leg[m.RADIUS] == 0.0  # of the autopilot
    centre = np.array([990.0, 60.0, -125.0])
    assert legs_of(law, "LOITER", target=centre)[0, m.P_N : m.P_D + 1] == pytest.approx(centre)


def test_guided_flies_to_its_target():
    point = np.array([0.0, 0.0, -90.0])
    assert legs_of("arduplane", "GUIDED", target=point)[0, m.P_N : m.P_D + 1] == pytest.approx(point)


def test_circle_holds_a_third_of_the_bank_limit():
    (leg,) = legs_of("arduplane", "CIRCLE", {"ROLL_LIMIT_DEG": 60.0})
    assert leg[m.KIND] == m.CONSTANT_BANK and degrees(leg[m.TURNS]) == pytest.approx(20.0)
    assert degrees(legs_of("arduplane", "CIRCLE", {"LIM_ROLL_CD": 4500.0})[0, m.TURNS]) == pytest.approx(15.0)


def test_cruise_follows_the_line_of_its_entry():
    route = modes.mode_route("arduplane", "CRUISE", situation(), {})
    assert route.start == pytest.approx(ENTRY)
    assert route.legs[0, m.KIND] == m.WAYPOINT and route.legs[0, m.P_E] > 50_000
    assert route.legs[0, m.P_N] == pytest.approx(1000.0)


def test_takeoff_mode_circles_at_its_distance_and_height():
    (leg,) = legs_of("arduplane", "TAKEOFF", {"TKOFF_DIST": 150.0, "TKOFF_ALT": 40.0})
    assert leg[m.P_N : m.P_D + 1] == pytest.approx([1000.0, 200.0, -160.0])


def landing_mission() -> tuple[Item, ...]:
    def item(seq: int, command: int, north: float) -> Item:
        lat, lon, _ = to_geodetic(HERE, np.array([north, 0.0, 0.0]))
        return Item(
            seq=seq,
            command=command,
            lat_e7=int(lat),
            lon_e7=int(lon),
            alt_m=500.0 if seq == 0 else 60.0,
            frame=0 if seq == 0 else 3,
        )

    return item(0, 16, 0.0), item(1, 16, 900.0), item(2, 189, 0.0), item(3, 16, 700.0), item(4, 21, 100.0)


def test_rtl_lands_by_the_landing_sequence_where_the_parameters_say_so():
    home = legs_of("arduplane", "RTL", {"RTL_AUTOLAND": 1.0}, items=landing_mission())
    assert home[:, m.KIND].tolist() == [m.LOITER_UNLIMITED, m.WAYPOINT, m.LAND]
    assert is_return(home[0]) and home[0, m.TURNS] == 1.0  # proceeds to the landing as soon as it circles
    direct = legs_of("arduplane", "RTL", {"RTL_AUTOLAND": 2.0}, items=landing_mission())
    assert direct[:, m.KIND].tolist() == [m.WAYPOINT, m.LAND] and direct[0, m.SEQ] == 3
    assert len(legs_of("arduplane", "RTL", {"RTL_AUTOLAND": 0.0}, items=landing_mission())) == 1


def test_rtl_lands_by_the_landing_sequence_nearest_to_where_it_begins():
    far, *_ = landing_mission()[2:3]
    lat, lon, _ = to_geodetic(HERE, np.array([5000.0, 0.0, 0.0]))
    there = {"lat_e7": int(lat), "lon_e7": int(lon)}
    sequence = [(1, 189, there), (2, 16, there), (3, 21, there)]
    elsewhere = [msgspec.structs.replace(far, seq=seq, command=command, **place) for seq, command, place in sequence]
    near = [msgspec.structs.replace(item, seq=item.seq + 2) for item in landing_mission()[2:]]
    items = (landing_mission()[0], *elsewhere, *near)
    direct = legs_of("arduplane", "RTL", {"RTL_AUTOLAND": 2.0}, items=items)
    assert direct[:, m.SEQ].tolist() == [5, 6]
    home = legs_of("arduplane", "RTL", {"RTL_AUTOLAND": 1.0}, items=items)
    assert home[1:, m.SEQ].tolist() == [5, 6]


def test_px4_returns_by_climb_flight_home_and_descent():
    params = {"RTL_RETURN_ALT": 200.0, "RTL_DESCEND_ALT": 50.0, "RTL_LOITER_RAD": 90.0}
    climb, cruise, circle = legs_of("px4", "RTL", params)
    assert climb[m.KIND] == m.LOITER_TO_ALT and climb[m.P_N : m.P_D + 1] == pytest.approx([1000, 50, -200])
    assert cruise[m.KIND] == m.WAYPOINT and cruise[m.P_N : m.P_D + 1] == pytest.approx([-300, 400, -200])
    assert circle[m.KIND] == m.LOITER_UNLIMITED and circle[m.P_D] == -50.0 and circle[m.RADIUS] == 90.0
    high = legs_of("px4", "RTL", params, entry=np.array([1000, 50, -300.0]), position=np.array([1000, 50, -300.0]))
    assert len(high) == 2 and high[0, m.P_D] == -300.0  # it does not descend on the way
    at_home = legs_of("px4", "RTL", params, entry=HOME + np.array([20.0, 0.0, -180.0]))
    assert len(at_home) == 1
    arrived = legs_of("px4", "RTL", params, position=HOME + np.array([20.0, 0.0, -180.0]))
    assert np.array_equal(arrived, np.array([climb, cruise, circle]))  # the route stays that of the mode change


def test_px4_returns_by_the_mission_are_not_predicted_and_say_so():
    landing = (Item(seq=3, command=21, lat_e7=470_000_000, lon_e7=80_000_000),)
    for kind, items in ((2.0, ()), (4.0, ()), (1.0, landing), (3.0, landing)):
        route = modes.mode_route("px4", "RTL", situation(items=items), {"RTL_TYPE": kind})
        assert not len(route.legs) and f"RTL_TYPE {kind:.0f}" in route.summary
    for kind, items in ((0.0, landing), (1.0, ()), (3.0, ())):
        assert legs_of("px4", "RTL", {"RTL_TYPE": kind}, items=items)[-1, m.P_N] == HOME[0]
    low = {"RTL_RETURN_ALT": 128.0}  # 8 m above the entry
    assert len(legs_of("px4", "RTL", low)) == 2 and len(legs_of("px4", "RTL", low | {"NAV_FW_ALT_RAD": 5.0})) == 3


def test_hand_flown_and_unknown_modes_have_no_route():
    for law, mode in (("arduplane", "FBWA"), ("arduplane", "MANUAL"), ("px4", "POSCTL"), ("textbook", "RTL"), ("", "")):
        assert modes.mode_route(law, mode, situation(), {}) is None


def test_cruise_keeps_its_line_until_the_pilot_has_steered():
    on_line = situation(position=ENTRY + np.array([5.0, 800.0, 3.0]))
    held = modes.after_steering(on_line, pi / 2 + 0.05, 0.0, float("nan"))
    assert held is not None and held.entry == pytest.approx(ENTRY) and held.course == pi / 2
    climbs = modes.after_steering(on_line, pi / 2, 0.0, 25.0)
    assert climbs is not None and climbs.entry[2] == pytest.approx(on_line.position[2] - 25.0)
    assert modes.after_steering(on_line, 0.9, 0.4, 0.0) is None
    turned = modes.after_steering(on_line, 0.9, 0.05, 0.0)
    assert turned is not None and turned.course == 0.9 and turned.entry == pytest.approx(on_line.position)
    aside = modes.after_steering(situation(position=ENTRY + np.array([90.0, 800.0, 0.0])), pi / 2, 0.0, 0.0)
    assert aside is not None and aside.entry[0] == ENTRY[0] + 90.0


def test_a_glide_is_level_where_it_is_the_short_action_and_nose_down_otherwise():
    def pitch_of(**params: float) -> float:
        route = modes.mode_route("arduplane", "FBWA", situation(), {"STAB_PITCH_DOWN": 4.0, **params}, failsafe=True)
        assert route is not None and route.legs[0, m.KIND] == m.GLIDE
        return degrees(route.legs[0, m.RADIUS])

    assert pitch_of(FS_SHORT_ACTN=2.0, THR_FAILSAFE=1.0) == 0.0
    assert pitch_of(FS_SHORT_ACTN=0.0, THR_FAILSAFE=1.0) == pytest.approx(-4.0)
    assert pitch_of(FS_SHORT_ACTN=2.0, THR_FAILSAFE=0.0) == pytest.approx(-4.0)


# --- link loss -------------------------------------------------------------------------------------------------------


def steps(law: str, mode: str, **params: float) -> list[tuple[float, str]]:
    return [(round(step.after_s, 1), step.mode) for step in link_loss_steps(law, mode, params)]


RADIO = {"THR_FAILSAFE": 1.0, "RC_FS_TIMEOUT": 1.0, "FS_LONG_TIMEOUT": 5.0}


@pytest.mark.parametrize(
    ("mode", "short", "long", "expected"),
    [
        ("AUTO", 0, 0, []),
        ("AUTO", 0, 1, [(6.2, "RTL")]),
        ("AUTO", 1, 0, [(1.2, "CIRCLE"), (6.2, "RTL")]),  # a circle never continues
        ("AUTO", 3, 2, [(5.0, "FBWA")]),
        ("AUTO", 2, 4, [(1.2, "FBWA"), (6.2, "AUTO")]),
        ("GUIDED", 4, 0, [(1.2, "FBWB"), (6.2, "RTL")]),
        ("LOITER", 0, 0, [(6.2, "RTL")]),
        ("CRUISE", 0, 0, [(1.2, "CIRCLE"), (6.2, "RTL")]),
        ("CRUISE", 3, 1, [(5.0, "RTL")]),
        ("RTL", 1, 1, []),
        ("RTL", 1, 4, [(6.2, "AUTO")]),
        ("LOITER", 0, 3, []),  # a parachute is no mode
    ],
)
def test_arduplane_takes_its_short_and_its_long_action(mode, short, long, expected):
    assert steps("arduplane", mode, **RADIO, FS_SHORT_ACTN=short, FS_LONG_ACTN=long) == expected


def test_the_ground_station_failsafe_takes_the_long_action_alone():
    ground = {"THR_FAILSAFE": 0.0, "FS_SHORT_ACTN": 1.0, "FS_LONG_ACTN": 1.0, "FS_LONG_TIMEOUT": 12.0}
    assert steps("arduplane", "AUTO", **ground, FS_GCS_ENABL=1.0) == [(12.0, "RTL")]
    assert steps("arduplane", "AUTO", **ground, FS_GCS_ENABL=0.0) == []
    assert steps("arduplane", "GUIDED", **ground, FS_GCS_ENABL=3.0) == []
    assert steps("arduplane", "AUTO", **ground, FS_GCS_ENABL=3.0) == [(12.0, "RTL")]


def test_nothing_is_assumed_of_parameters_that_were_not_received():
    assert steps("arduplane", "AUTO") == [] and steps("px4", "MISSION") == [] and steps("textbook", "AUTO") == []


def test_px4_takes_the_data_link_action_after_its_hold():
    assert steps("px4", "MISSION", NAV_DLL_ACT=2.0, COM_DL_LOSS_T=8.0) == [(8.0, "RTL")]
    late = steps("px4", "MISSION", NAV_DLL_ACT=2.0, COM_DL_LOSS_T=8.0, COM_FAIL_ACT_T=5.0)
    assert late == [(8.0, "LOITER"), (13.0, "RTL")]
    assert steps("px4", "MISSION", NAV_DLL_ACT=1.0) == [(10.0, "LOITER")]
    assert steps("px4", "MISSION", NAV_DLL_ACT=0.0, NAV_RCL_ACT=2.0) == []
    by_link = {"NAV_RCL_ACT": 2.0, "COM_RC_IN_MODE": 1.0, "COM_RC_LOSS_T": 0.5}
    assert steps("px4", "MISSION", **by_link) == [(0.5, "RTL")]
    assert steps("px4", "MISSION", **by_link, COM_RCL_EXCEPT=1.0) == []
