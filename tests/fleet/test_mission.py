"""Missions become legs; bad missions become sentences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet import mission as m
from fleet.contract import MAX_ITEMS, Item
from fleet.frames import Origin

ORIGIN = Origin(470_000_000, 80_000_000, 400_000)
HOME = Item(seq=0, command=16, frame=0, lat_e7=470_000_000, lon_e7=80_000_000, alt_m=410.0)
NORTH = 90_000  # about 1 km


def waypoint(seq: int, north: float = 0.0, east: float = 0.0, **more) -> Item:
    base = {"command": 16, "frame": 3, "alt_m": 100.0}
    lat, lon = ORIGIN.lat_e7 + int(north * NORTH), ORIGIN.lon_e7 + int(east * NORTH)
    return Item(**{"seq": seq, "lat_e7": lat, "lon_e7": lon, **base, **more})


def jump(seq: int, target: float, count: float) -> Item:
    return Item(seq=seq, command=177, param1=target, param2=count)


def fly(items, seq=1, params=None, limit=64) -> m.Route:
    return m.unroll_route(items, seq=seq, origin=ORIGIN, params=params or {}, limit=limit)


def seqs(route: m.Route) -> list[int]:
    return [int(leg[m.SEQ]) for leg in route.legs]


def test_waypoints_become_legs_and_return_follows():
    r = fly([HOME, waypoint(1, 1), waypoint(2, 1, 1, param2=30.0), waypoint(3, 0, 1, param3=25.0)], 2)
    assert seqs(r) == [2, 3, -1]
    assert r.sentences == ()
    assert r.legs.shape == (3, m.N_COLUMNS)
    assert r.start[0] == pytest.approx(r.legs[0, m.P_N], abs=1)
    assert r.legs[0, m.ACCEPT_RADIUS] == 30.0
    assert r.legs[1, m.ACCEPT_RADIUS] == -25.0  # flown past, not cut
    back = r.legs[-1]
    assert back[m.KIND] == m.LOITER_UNLIMITED
    np.testing.assert_allclose(back[m.P_N : m.P_D + 1], [0, 0, -110], atol=1e-6)  # home is 10 m above the origin
    assert "3 legs from item 2" in str(r)


@pytest.mark.parametrize(
    ("frame", "down"), [(3, -110.0), (6, -110.0), (0, 300.0), (5, 300.0), (10, -110.0), (11, -110.0)]
)
def test_altitude_frames(frame, down):
    r = fly([HOME, waypoint(1, 1, frame=frame)])
    assert r.legs[0, m.P_D] == pytest.approx(down)
    assert any("terrain" in s for s in r.sentences) == (frame in (10, 11))


def test_rtl_altitude_current_older_and_keep():
    items = [HOME, waypoint(1, 1)]
    assert fly(items, params={"RTL_ALTITUDE": 70.0}).legs[-1, m.P_D] == pytest.approx(-80)
    assert fly(items, params={"ALT_HOLD_RTL": 5000.0}).legs[-1, m.P_D] == pytest.approx(-60)
    assert fly(items, params={"RTL_ALTITUDE": -1.0}).legs[-1, m.P_D] == fly(items).legs[0, m.P_D]
    assert np.isfinite(fly(items, params={"RTL_ALTITUDE": float("nan"), "RTL_RADIUS": float("inf")}).legs).all()


def test_kinds_carry_what_they_need():
    items = [
        HOME,
        Item(seq=1, command=22, frame=3, alt_m=50.0),
        waypoint(2, 1),
        waypoint(3, 1, 1, command=18, param1=2.0, param3=-80.0),
        waypoint(4, 2, 1, command=19, param1=30.0, param3=-1.0),
        waypoint(5, 2, 2, command=31, param2=-100.0),
        waypoint(6, 3, 2, command=17, param3=70.0),
        waypoint(7, 0, 0, command=21),
    ]
    r = fly(items, params={"WP_LOITER_RAD": 60.0})
    kinds = [m.TAKEOFF, m.WAYPOINT, m.LOITER_TURNS, m.LOITER_TIME, m.LOITER_TO_ALT, m.LOITER_UNLIMITED, m.LAND]
    assert [int(k) for k in r.legs[:, m.KIND]] == kinds  # and nothing follows a landing
    assert list(r.legs[2:6, m.RADIUS]) == [-80, -60, -100, 70]
    assert list(r.legs[2:4, m.TURNS]) == [2, 30]
    np.testing.assert_allclose(r.legs[0, m.P_N : m.P_D], 0, atol=1e-6)  # no position: over home
    assert np.isnan(fly(items, 2).start).all()  # the line after a takeoff begins where the aircraft is
    np.testing.assert_array_equal(fly(items, 4).start, r.legs[2, m.P_N : m.P_D + 1])  # after a circle at its centre
    assert np.isfinite(fly(items, 3).start).all()


def test_the_line_after_a_circle_starts_at_its_exit_where_param4_is_positive():
    def circles(param4):
        return [
            HOME,
            waypoint(1, 1),
            waypoint(2, 2, command=18, param1=1.0, param3=80.0, param4=param4),
            waypoint(3, 2, 1, command=19, param1=30.0, param4=param4),
            waypoint(4, 2, 2, command=31, param2=90.0, param4=param4),
            waypoint(5, 3),
        ]

    for param4, at_exit in ((0.0, 0.0), (1.0, 1.0), (-1.0, 0.0), (NAN, 0.0)):
        r = fly(circles(param4))
        assert list(r.legs[1:4, m.ACCEPT_RADIUS]) == [at_exit] * 3
        for seq in (3, 4, 5):
            assert np.isnan(fly(circles(param4), seq).start).all() == bool(at_exit)


@pytest.mark.parametrize("default", [70.0, -70.0, 0.0])
def test_without_a_radius_a_circle_has_the_size_and_a_direction_of_wp_loiter_rad(default):
    def radius(command, value):
        place = {31: "param2"}.get(command, "param3")
        items = [HOME, waypoint(1, 1), waypoint(2, 2, command=command, **{place: value})]
        return fly(items, 2, {"WP_LOITER_RAD": default}).legs[0, m.RADIUS]

    size = abs(default) or 60.0  # up to 1 m it is not used
    for command in (17, 18, 19, 31):
        assert radius(command, 0.0) == 0.0  # the autopilot's radius and direction
        assert radius(command, 1.0) == 0.0
        assert radius(command, -1.0) == -size
    assert (radius(18, 120.0), radius(31, -120.0)) == (120.0, -120.0)
    assert (radius(19, 120.0), radius(19, -120.0)) == (0.0, -size)  # the time has no radius, only a direction


def test_a_waypoint_is_passed_by_less_its_acceptance_radius():
    r = fly([HOME, waypoint(1, 1, param2=10.0, param3=40.0), waypoint(2, 2)])
    assert r.legs[0, m.ACCEPT_RADIUS] == -30.0


def test_change_of_altitude_continues_on_the_line_of_the_leg_before():
    change = Item(seq=2, command=30, frame=3, param1=1.0, alt_m=150.0)
    r = fly([HOME, waypoint(1, 1), change, waypoint(3, 3)])
    assert [int(k) for k in r.legs[:3, m.KIND]] == [m.WAYPOINT, m.CHANGE_ALTITUDE, m.WAYPOINT]
    np.testing.assert_array_equal(r.legs[1, m.P_N : m.P_D], r.legs[0, m.P_N : m.P_D])
    assert (r.legs[1, m.TURNS], r.legs[1, m.P_D]) == (1.0, -160.0)
    assert r.sentences == ()
    refused = m.unroll_route([waypoint(0, 1), waypoint(1, 2), change], seq=0, origin=ORIGIN, params={}, first=0)
    assert m.CHANGE_ALTITUDE not in refused.legs[:, m.KIND] and "command 30" in refused.sentences[0]


LANDING = [
    *[HOME, waypoint(1, 1), waypoint(2, 4)],
    Item(seq=3, command=189, frame=3),
    waypoint(4, 3, 1),
    waypoint(5, 3, command=21),
    Item(seq=6, command=189, frame=3),
    waypoint(7, 0, -9),
    waypoint(8, 0, -9, command=21),
]


def test_do_land_start_is_passed_in_the_mission_and_entered_from_a_return():
    assert seqs(fly(LANDING))[:4] == [1, 2, 4, 5]
    items = [*LANDING[:3], Item(seq=3, command=20), *(Item(**vars_of(i) | {"seq": i.seq + 1}) for i in LANDING[3:])]
    assert seqs(fly(items)) == [1, 2, 3]  # RTL_AUTOLAND 0: it circles at home
    for autoland in (1.0, 2.0):
        r = fly(items, params={"RTL_AUTOLAND": autoland})
        assert seqs(r)[:5] == [1, 2, 3, 5, 6]  # the landing nearest to where the return starts
        assert r.legs[2, m.TURNS] == autoland
    no_landing = fly([*LANDING[:3]], params={"RTL_AUTOLAND": 2.0})
    assert seqs(no_landing) == [1, 2, -1] and no_landing.legs[-1, m.TURNS] == 0.0


def vars_of(item: Item) -> dict:
    return {name: getattr(item, name) for name in item.__struct_fields__}


def test_home_set_by_the_mission_is_where_it_returns():
    moved = waypoint(1, 5, command=179, alt_m=20.0)
    r = fly([HOME, moved, waypoint(2, 1)])
    assert r.legs[-1, m.P_N] == pytest.approx(5000, rel=0.01)
    assert r.legs[-1, m.P_D] == pytest.approx(-10 - 20 - 100)
    assert fly([HOME, Item(**vars_of(moved) | {"param1": 1.0}), waypoint(2, 1)]).legs[-1, m.P_N] == pytest.approx(0)


def test_a_delay_is_over_at_once_in_flight():
    r = fly([HOME, waypoint(1, 1), Item(seq=2, command=93, param1=30.0), waypoint(3, 2)])
    assert (seqs(r), r.sentences) == ([1, 3, -1], ())


def test_jump_tags_lead_to_their_tag():
    items = [HOME, waypoint(1, 1), Item(seq=2, command=600, param1=7.0), waypoint(3, 2), waypoint(4, 2, 1)]
    items += [Item(seq=5, command=601, param1=7.0, param2=1.0), waypoint(6, 3)]
    assert seqs(fly(items)) == [1, 3, 4, 3, 4, 6, -1] and fly(items).sentences == ()
    unknown = [*items[:5], Item(seq=5, command=601, param1=8.0, param2=1.0), waypoint(6, 3)]
    assert seqs(fly(unknown)) == [1, 3, 4, 6, -1] and "jump to 8" in fly(unknown).sentences[0]


def test_jumps_taken_before_do_not_repeat():
    items = [HOME, waypoint(1, 1), waypoint(2, 1, 1), jump(3, 1, 2), waypoint(4, 3)]
    for taken, expected in ((0, [2, 1, 2, 1, 2, 4, -1]), (1, [2, 1, 2, 4, -1]), (2, [2, 4, -1])):
        r = m.unroll_route(items, seq=2, origin=ORIGIN, params={}, jumps_taken={3: taken})
        assert seqs(r) == expected


def test_the_counter_of_a_completed_jump_starts_again_unless_an_option_keeps_it():
    items = [HOME, waypoint(1, 1), waypoint(2, 2), jump(3, 1, 1), waypoint(4, 2, 1), jump(5, 1, 1), waypoint(6, 3)]
    assert seqs(fly(items)) == [1, 2, 1, 2, 4, 1, 2, 1, 2, 4, 6, -1]
    assert seqs(fly(items, params={"MIS_OPTIONS": 8.0})) == [1, 2, 1, 2, 4, 1, 2, 4, 6, -1]


def test_loiter_here_is_at_the_point_before():
    r = fly([HOME, waypoint(1, 1, 2), Item(seq=2, command=18, frame=3, param1=1, alt_m=90.0)])
    np.testing.assert_array_equal(r.legs[1, m.P_N : m.P_D], r.legs[0, m.P_N : m.P_D])


def test_jumps_unroll_as_often_as_asked():
    items = [HOME, waypoint(1, 1), waypoint(2, 1, 1), jump(3, 1, 2), waypoint(4, 3)]
    assert seqs(fly(items)) == [1, 2, 1, 2, 1, 2, 4, -1]
    assert seqs(fly(items, 4)) == [4, -1]
    endless = [*items[:3], jump(3, 1, -1), waypoint(4, 3)]
    assert seqs(fly(endless, limit=7)) == [1, 2, 1, 2, 1, 2, 1]
    assert len(fly(endless).legs) == 64


def test_a_jump_inside_a_jump_keeps_its_own_count():
    items = [HOME, waypoint(1, 1), jump(2, 1, 0), waypoint(3, 2), jump(4, 1, 1)]
    assert seqs(fly(items)) == [1, 3, 1, 3, -1]


def speed(seq: int, value: float, kind: float = 0.0) -> Item:
    return Item(seq=seq, command=178, param1=kind, param2=value, param3=-1)


def test_speed_in_force_counts_before_seq_and_across_jumps():
    items = [HOME, speed(1, 15.0), waypoint(2, 1), speed(3, 22.0), waypoint(4, 2), jump(5, 2, 1), speed(6, -1.0)]
    items += [waypoint(7, 3), speed(8, -2.0), waypoint(9, 4)]
    assert list(fly(items, 2).legs[:, m.VA_C]) == [15, 22, 22, 22, 22, 0, 0]
    assert fly(items, 4).legs[0, m.VA_C] == 22
    assert fly(items, 7).legs[0, m.VA_C] == 22


def test_a_ground_speed_is_no_airspeed_for_arduplane_but_for_px4():
    r = fly([HOME, speed(1, 15.0, kind=1.0), waypoint(2, 1)], 2)
    assert r.legs[0, m.VA_C] == 0
    assert any("ground speed" in s and "ignored" in s for s in r.sentences)
    px4 = without_home([speed(0, 15.0, kind=1.0), waypoint(1, 1)])
    assert px4.legs[0, m.VA_C] == 15 and "used as airspeed" in px4.sentences[0]


def test_an_airspeed_beyond_the_limits_is_ignored_as_by_the_autopilot():
    items = [HOME, speed(1, 15.0), speed(2, 40.0), speed(3, 5.0), waypoint(4, 1)]
    for names in (("AIRSPEED_MIN", "AIRSPEED_MAX"), ("ARSPD_FBW_MIN", "ARSPD_FBW_MAX")):
        r = fly(items, 4, dict(zip(names, (10.0, 30.0), strict=True)))
        assert r.legs[0, m.VA_C] == 15 and len(r.sentences) == 2
    assert fly(items, 4).legs[0, m.VA_C] == 5


def test_other_commands_only_use_up_a_number():
    r = fly([HOME, waypoint(1, 1), Item(seq=2, command=189, frame=3), waypoint(3, 2)])
    assert seqs(r) == [1, 3, -1]
    assert r.sentences == ()


NAN, INF = float("nan"), float("inf")
BAD = {
    "no items": ([], 0, "upload a mission"),
    "home only": ([HOME], 0, "upload a mission"),
    "nan altitude": ([HOME, waypoint(1, 1, alt_m=NAN), waypoint(2, 2)], 1, "item 1: found altitude nan"),
    "nan latitude": ([HOME, waypoint(1, 1, lat_e7=NAN), waypoint(2, 2)], 1, "item 1: found latitude nan"),
    "absurd longitude": ([HOME, waypoint(1, 1, lon_e7=2**31 - 1), waypoint(2, 2)], 1, "item 1: found longitude"),
    "local frame": ([HOME, waypoint(1, 1, frame=1), waypoint(2, 2)], 1, "item 1: found frame 1"),
    "nan home": ([waypoint(0, 0, alt_m=NAN), waypoint(2, 2)], 1, "item 0"),
    "item lost": ([HOME, waypoint(2, 2)], 1, "found 2 of 3 items"),
    "jump circle": ([HOME, jump(1, 1, -1), waypoint(2, 2)], 1, "item 1: found a jump loop"),
    "jump circle of two": ([HOME, jump(1, 2, -1), jump(2, 1, -1), waypoint(3, 2)], 1, "jump loop"),
    "jump too far": ([HOME, jump(1, 9, 1), waypoint(2, 2)], 1, "item 1: found jump to 9"),
    "jump home": ([HOME, jump(1, 0, 1), waypoint(2, 2)], 1, "item 1: found jump to 0"),
    "jump to nan": ([HOME, jump(1, NAN, 1), waypoint(2, 2)], 1, "item 1: found jump to nan"),
    "zero length": ([HOME, waypoint(1, 1), waypoint(2, 1), waypoint(3, 2)], 1, "item 2: found a leg of zero length"),
    "seq too high": ([HOME, waypoint(2, 2)], 77, "found current item 77"),
    "seq unknown": ([HOME, waypoint(2, 2)], -1, "found current item -1"),
    "too many": ([HOME, *(waypoint(i, i * 1e-3) for i in range(1, MAX_ITEMS + 5)), waypoint(2, 2)], 2, "at most"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_mission_is_a_sentence_and_the_rest_flies(name):
    items, seq, sentence = BAD[name]
    r = fly(items, seq)
    assert any(sentence in s for s in r.sentences), r.sentences
    assert np.isfinite(r.legs).all()
    if len(items) > 1:
        assert 2 in seqs(r) or 3 in seqs(r)
    else:
        assert len(r.legs) == 0
        assert "nothing to fly" in str(r)


numbers = st.one_of(st.floats(width=32), st.integers(-5, 12).map(float))
whole = st.one_of(st.integers(-(2**31), 2**31 - 1), st.just(NAN), st.just(0))
an_item = st.builds(
    Item,
    seq=st.integers(-3, 12),
    command=st.sampled_from([16, 17, 18, 19, 20, 21, 22, 30, 31, 82, 93, 177, 178, 179, 189, 600, 601]),
    frame=st.sampled_from([0, 1, 2, 3, 5, 6, 10, 11]),
    param1=numbers,
    param2=numbers,
    param3=numbers,
    lat_e7=whole,
    lon_e7=whole,
    alt_m=st.floats(),
)


@settings(max_examples=300)
@given(
    st.lists(an_item, max_size=14),
    st.integers(-2, 14),
    st.dictionaries(st.sampled_from(m.ROUTE_PARAMS), st.one_of(st.floats(), st.integers(-2, 16).map(float))),
)
def test_nothing_raises_and_every_leg_is_finite(items, seq, params):
    r = fly(items, seq, params)
    assert np.isfinite(r.legs).all()
    assert len(r.legs) <= 64
    assert all("mission" in s and ";" in s for s in r.sentences)


# --- a mission that does not hold home (PX4) -------------------------------------------------------------------------


def without_home(items, seq=0) -> m.Route:
    return m.unroll_route(items, seq=seq, origin=ORIGIN, params={}, limit=6, first=m.FIRST_ITEM["px4"])


def test_without_home_item_0_is_flown_and_jumps_go_to_it():
    r = without_home([waypoint(0, 1), waypoint(1, 1, 1), jump(2, 0, 1)])
    assert seqs(r) == [0, 1, 0, 1, -1] and r.sentences == ()
    assert r.legs[0, m.P_D] == pytest.approx(-100)  # home is the origin
    assert r.legs[-1, m.KIND] == m.LOITER_UNLIMITED  # it stays where its mission ends
    np.testing.assert_allclose(r.legs[-1, m.P_N : m.P_D + 1], r.legs[-2, m.P_N : m.P_D + 1])
    assert np.isnan(r.start).all()
    assert seqs(without_home([waypoint(0, 1)], seq=99)) == [0, -1]
    empty = without_home([])
    assert not len(empty.legs) and "at least one" in empty.sentences[0]


def test_without_home_circles_have_a_radius_and_an_exit_of_their_own():
    timed = waypoint(1, 1, 1, command=19, param1=40.0, param2=1.0, param3=-120.0)
    climb = waypoint(2, 1, 2, command=31, param1=0.0, param2=90.0)
    legs = without_home([waypoint(0, 1), timed, climb]).legs
    assert legs[1, [m.TURNS, m.RADIUS, m.ACCEPT_RADIUS]].tolist() == [40.0, -120.0, 1.0]
    assert legs[2, [m.RADIUS, m.ACCEPT_RADIUS]].tolist() == [90.0, 0.0]
    home_first = fly([HOME, timed]).legs[0]
    assert home_first[[m.RADIUS, m.ACCEPT_RADIUS]].tolist() == [-60.0, 0.0]  # ArduPlane reads the direction only
