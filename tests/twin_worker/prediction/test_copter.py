"""The multirotor's law: limits and units, corners, stops, waits, wind, and a route laid as segments."""

from math import inf

import numpy as np
import pytest

from fleet.autopilots import copter
from fleet.autopilots.copter import corner_speed, limits
from tests.support.flights import HERE, item
from twin_worker.prediction.multirotor.route import (
    limit_speeds,
    numbered_from_one,
    return_segments,
    segments_from_mission,
    stopping_segment,
)

PARAMS = {"WPNAV_SPEED": 800.0, "WPNAV_ACCEL": 250.0, "WPNAV_SPEED_UP": 250.0, "WPNAV_SPEED_DN": 150.0}
LIMIT, _ = limits(PARAMS)
P = np.array([0.0, 0.0, -100.0])
DT = 0.1


def fly(segments, seconds: float = 120.0, *, wn: float = 2.0, air=(np.nan, 0.0, 0.0)) -> np.ndarray:
    out = np.empty((round(seconds / DT), 3))
    start = segments[0, :3].copy()
    par = np.array([LIMIT.jerk, wn, 0.9, *air])
    copter.follow(np.zeros(copter.N_FOLLOW), segments, start, np.zeros(3), par, DT, out)
    return out


def way(*items, seq: int = 1, p=P) -> np.ndarray:
    laid, _ = segments_from_mission((item(0), *items), seq, HERE, p, PARAMS)
    return limit_speeds(laid, LIMIT)


def test_limits_come_in_the_autopilots_own_units():
    old, absent = limits({"WPNAV_SPEED": 750.0, "WPNAV_RADIUS": 200.0, "LAND_SPEED": 60.0})
    assert (old.speed, old.radius, old.land) == (7.5, 2.0, 0.6)
    assert "speed" not in absent and "acc" in absent and old.acc == 2.5
    assert limits({"WP_SPD": 7.5})[0].speed == 7.5  # metres since 4.7
    assert limits({"MPC_XY_CRUISE": 5.0, "MPC_ACC_HOR": 3.0})[0][:1] == (5.0,)
    assert limits({"Q_WP_SPEED": 500.0}, "Q_")[0].speed == 5.0
    assert limits({"WPNAV_ACCEL": 300.0})[0].acc_corner == 6.0


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e9, 0.0, 1e30])
def test_absurd_limits_are_not_taken(value):
    got, absent = limits(dict.fromkeys(("WPNAV_SPEED", "WPNAV_ACCEL", "WPNAV_JERK"), value))
    assert got.speed == 10.0 and {"speed", "acc", "jerk"} <= set(absent)


def test_a_corner_is_the_slower_the_sharper():
    north = np.array([1.0, 0.0, 0.0])
    speeds = [corner_speed(north, np.array([np.cos(a), np.sin(a), 0.0]), LIMIT) for a in (0.1, 0.8, 1.6, 3.1)]
    assert speeds == sorted(speeds, reverse=True) and speeds[0] > 20.0 and speeds[-1] == 0.0
    assert speeds[2] == pytest.approx((LIMIT.acc_corner * LIMIT.radius / (1 / np.cos(0.8) - 1)) ** 0.5)


def test_it_stops_at_a_wait_for_as_long_and_goes_on():
    path = fly(way(item(1, 16, 100.0, param1=5.0), item(2, 16, 100.0, 100.0)))
    near = np.linalg.norm(path - [100.0, 0.0, -100.0], axis=1) < 0.5
    assert 4.5 < near.sum() * DT < 9.0
    assert path[:, 0].max() < 101.0  # no overshoot
    assert np.allclose(path[-1], [100.0, 100.0, -100.0], atol=0.3)


def test_it_flies_no_faster_than_allowed_in_any_direction():
    path = fly(way(item(1, 16, 300.0), item(2, 16, 300.0, 80.0, alt_m=160.0), item(3, 16, 300.0, 80.0, alt_m=60.0)))
    v = np.diff(path, axis=0) / DT
    assert 7.5 < np.hypot(*v[:, :2].T).max() < 8.5
    assert -v[:, 2].min() > 2.4 and v[:, 2].max() > 1.4
    assert ((v[:, 2] < -2.5 * 1.1) | (v[:, 2] > 1.5 * 1.1)).mean() < 0.1  # to catch up after a corner
    assert np.abs(np.diff(v, axis=0) / DT).max() < 8.0


def test_a_shallow_corner_is_not_a_stop():
    out = fly(way(item(1, 16, 150.0), item(2, 16, 300.0, 20.0)), 60.0)
    v = np.linalg.norm(np.diff(out, axis=0), axis=1) / DT
    begin, end = np.flatnonzero(v > 7.0)[[0, -1]]
    assert v[begin:end].min() > 6.0


def test_a_headwind_slows_what_tilts_no_further():
    calm, windy = (fly(way(item(1, 16, 1000.0)), 60.0, air=air)[-1, 0] for air in ((10.0, 0.0, 0.0), (10.0, -7.0, 0.0)))
    assert calm > 350.0 and 0.2 < windy / calm < 0.5


def test_the_slower_the_lag_the_wider_the_corner():
    route = way(item(1, 16, 100.0), item(2, 16, 100.0, 100.0))
    off = [np.linalg.norm(fly(route, wn=wn) - [100.0, 0.0, -100.0], axis=1).min() for wn in (0.7, 2.8)]
    assert off[0] > off[1]


def test_take_off_goes_straight_up_and_landing_straight_down():
    up = way(item(1, 22, alt_m=30.0), item(2, 16, 80.0, alt_m=30.0), p=np.zeros(3))
    path = fly(up, 60.0)
    climbing = path[path[:, 2] > -28.0]
    assert np.abs(climbing[:, :2]).max() < 0.5 and path[-1, 2] == pytest.approx(-30.0, abs=0.3)
    down = fly(way(item(1, 21, 50.0)), 200.0)
    assert np.allclose(down[-1], [50.0, 0.0, 0.0], atol=0.3)
    low = down[(down[:, 2] > -9.0) & (down[:, 2] < -1.0)]
    assert np.abs(low[:, :2] - [50.0, 0.0]).max() < 0.5
    assert len(low) * DT == pytest.approx(8.0 / LIMIT.land, rel=0.2)


def test_a_circle_goes_round_as_often_as_asked():
    path = fly(way(item(1, 18, 60.0, param1=2.0, param3=20.0), item(2, 16, 200.0)), 150.0)
    r = path[:, :2] - [60.0, 0.0]
    around = np.hypot(*r.T) < 25.0
    angle = np.unwrap(np.arctan2(r[around, 1], r[around, 0]))
    assert 1.8 * 2 * np.pi < angle.max() - angle.min() < 2.8 * 2 * np.pi


def test_it_stays_after_the_last_item_and_returns_when_told():
    assert np.allclose(fly(way(item(1, 16, 40.0)), 90.0)[-1], [40.0, 0.0, -100.0], atol=0.3)
    back = fly(way(item(1, 16, 40.0), item(2, 20)), 240.0)[-1]
    assert np.allclose(back, [0.0, 0.0, 0.0], atol=0.5)
    home = limit_speeds(return_segments((item(0),), HERE, np.array([30.0, 0.0, -5.0]), PARAMS), LIMIT)
    path = fly(home, 120.0)
    assert path[:, 2].min() == pytest.approx(-15.0, abs=0.5) and np.allclose(path[-1], 0.0, atol=0.5)
    assert not len(return_segments((), HERE, P, PARAMS))


def test_holding_is_a_stop_ahead_not_behind():
    laid = stopping_segment(P, np.array([6.0, 0.0, 0.0]), LIMIT)
    assert 6.0 < laid[-1, copter.B_N] < 25.0 and laid[-1, copter.HOLD] == inf
    assert np.allclose(stopping_segment(P, np.zeros(3), LIMIT)[-1, 3:6], P)


def test_a_mission_without_home_is_numbered_anew():
    moved = numbered_from_one((item(0, 16, 10.0), item(1, 177, param1=0.0)), HERE)
    assert [i.seq for i in moved] == [0, 1, 2] and moved[2].param1 == 1.0
    assert (moved[0].lat_e7, moved[0].alt_m) == (HERE.lat_e7, 500.0)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1e9, 1e30])
def test_hostile_items_give_segments_of_numbers(value):
    items = (
        item(0),
        item(1, 22, alt_m=value),
        item(2, 18, 50.0, param1=value, param3=value),
        item(3, 19, 60.0, param1=value),
        item(4, 178, param2=value),
        item(5, 16, 90.0, param1=value),
        item(6, 21),
    )
    for seq in (0, 1, 5, 99, -3):
        laid, _ = segments_from_mission(
            items, seq, HERE, P, {"CIRCLE_RATE": value, "RTL_ALT": value, "CIRCLE_RADIUS": value}
        )
        if len(laid):
            assert np.isfinite(fly(limit_speeds(laid, LIMIT), 30.0)).all()
