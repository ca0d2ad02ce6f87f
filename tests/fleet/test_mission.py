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
    assert np.isnan(fly(items, 4).start).all()
    assert np.isfinite(fly(items, 3).start).all()


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


def test_ground_speed_is_taken_as_airspeed_and_said():
    r = fly([HOME, speed(1, 15.0, kind=1.0), waypoint(2, 1)], 2)
    assert r.legs[0, m.VA_C] == 15
    assert any("ground speed" in s for s in r.sentences)


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
    command=st.sampled_from([16, 17, 18, 19, 20, 21, 22, 31, 82, 93, 177, 178, 189, 600]),
    frame=st.sampled_from([0, 1, 2, 3, 5, 6, 10, 11]),
    param1=numbers,
    param2=numbers,
    param3=numbers,
    lat_e7=whole,
    lon_e7=whole,
    alt_m=st.floats(),
)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(st.lists(an_item, max_size=14), st.integers(-2, 14), st.dictionaries(st.just("RTL_ALTITUDE"), st.floats()))
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
