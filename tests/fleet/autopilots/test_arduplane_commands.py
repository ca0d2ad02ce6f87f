"""Mission commands as ArduPlane flies them: circle exits, returns, changes of altitude, lines and their absence."""

from math import atan2, degrees, pi, radians, tan

import numpy as np
import pytest

from fleet import mission as m
from fleet.autopilots import arduplane as ap
from fleet.autopilots import control_law as S
from fleet.autopilots.arduplane import l1
from fleet.autopilots.arduplane import legs as leg_rules
from fleet.frames import G
from tests.support.point_mass import PLANE, Plane, begin, fly, leg, route


def after_circle(param4, kind=m.LOITER_TURNS, turns=1.0):
    """Fly a clockwise circle about (300, 0), then 2 km east; give the rows of the eastbound leg."""
    legs = route(leg(kind, n=300.0, radius=80.0, turns=turns, accept_radius=param4), leg(n=300.0, e=2000.0))
    rows, ctl = fly(legs, Plane(), 150)
    return rows[rows[:, 14] == 2], ctl


@pytest.mark.parametrize(("kind", "turns"), [(m.LOITER_TURNS, 1.0), (m.LOITER_TIME, 40.0), (m.LOITER_TO_ALT, 0.0)])
def test_the_line_after_a_circle_starts_at_its_centre_or_at_the_exit(kind, turns):
    for param4 in (0.0, 1.0):
        rows, ctl = after_circle(param4, kind, turns)
        north = np.interp(700.0, rows[:, 2], rows[:, 1]) - 300.0
        exit_line = (rows[0, 1] - 300.0) * (2000 - 700) / (2000 - rows[0, 2])
        assert north == pytest.approx(exit_line if param4 else 0.0, abs=8)
        assert exit_line > 35  # the two lines are apart
        assert ctl[S.PREV_N] == pytest.approx(rows[0, 1] if param4 else 300.0, abs=3)


def test_the_slope_after_a_circle_starts_at_the_height_of_its_centre():
    legs = route(leg(m.LOITER_TURNS, n=300.0, radius=80.0, turns=0.5, h=120.0), leg(n=300.0, e=2000.0, h=200.0))
    _, ctl = fly(legs, Plane(), 60)
    assert ctl[ap.LEG] == 1 and ctl[S.PREV_D] == -120.0
    at = np.array([300.0, 1000.0, -150.0])
    assert leg_rules.height_demand(ctl, ap.parameters(PLANE)[0], legs, at) == pytest.approx(160.0)


@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize("wind", [(0.0, 0.0), (6.0, -4.0)])
def test_a_circle_is_left_where_its_tangent_points_to_the_next_target(direction, wind):
    """The ground course leads or lags in wind; ArduPlane compares the tangent of the circle."""
    legs = route(leg(m.LOITER_TURNS, n=300.0, radius=80.0 * direction, turns=2.0), leg(n=2000.0, e=900.0))
    rows, _ = fly(legs, Plane(wind=wind), 200)
    out = rows[rows[:, 14] == 2][0]
    angle = atan2(out[2], out[1] - 300.0)
    n, e = 300.0 + 80.0 * np.cos(angle), 80.0 * np.sin(angle)
    error = atan2(900.0 - e, 2000.0 - n) - (angle + direction * pi / 2)
    assert abs(degrees((error + pi) % (2 * pi) - pi)) <= 12.5
    circle = rows[rows[:, 14] == 1]
    swept = np.unwrap(np.arctan2(circle[:, 2], circle[:, 1] - 300.0))
    on = np.argmax(abs(np.hypot(circle[:, 1] - 300.0, circle[:, 2]) - 80.0) < 8)
    assert 4 * pi - 0.9 < abs(swept[-1] - swept[on]) < 6 * pi + 0.2  # two turns, and at most one for the heading


def test_a_target_inside_the_circle_is_left_for_at_its_chord():
    legs = route(leg(m.LOITER_TURNS, n=300.0, radius=100.0, turns=1.0), leg(n=300.0, e=40.0), leg(n=2000.0))
    rows, _ = fly(legs, Plane(), 120)
    out = rows[rows[:, 14] == 2][0]
    expected = pi / 2 - 2 * np.arcsin((100 - 40) / 200)  # clockwise: before the bearing of the target
    assert degrees(atan2(out[2], out[1] - 300.0)) == pytest.approx(degrees(expected), abs=13)


def test_the_widened_radius_is_limited_by_navl1_lim_bank():
    def radius(requested, altitude, bank, va=20.0):
        par, _ = ap.parameters({**PLANE, "NAVL1_LIM_BANK": bank}, altitude)
        return l1.circle_radius(par, requested, va), ap.eas2tas(altitude) ** 2

    smallest = 400.0 / (G * tan(radians(45.0)))  # of a turn at 20 m/s, at sea level [m]
    for altitude in (0.0, 3000.0):
        r, widening = radius(100.0, altitude, 0.0)
        assert r == pytest.approx(100.0 * widening)
        assert radius(100.0, altitude, 45.0)[0] == pytest.approx(max(smallest * widening, 100.0))
        assert radius(0.9 * smallest, altitude, 45.0)[0] == pytest.approx(0.9 * smallest * widening)  # not achievable


def test_a_loiter_radius_up_to_1_m_is_replaced_by_the_default():
    par, _ = ap.parameters({**PLANE, "WP_LOITER_RAD": 0.0})
    rows, _ = fly(route(leg(m.LOITER_UNLIMITED, n=300.0)), Plane(), 120, par)
    assert np.hypot(rows[-300:, 1] - 300, rows[-300:, 2]).mean() == pytest.approx(60, abs=3)


def test_change_of_altitude_goes_straight_on_and_ends_at_its_height():
    legs = route(leg(n=800.0), leg(m.CHANGE_ALTITUDE, n=800.0, h=170.0), leg(n=4000.0, e=900.0, h=170.0))
    rows, ctl = fly(legs, Plane(wind=(0.0, 3.0)), 90, start=(0, 0, -100))
    change = rows[rows[:, 14] == 2]
    assert change[-1, 1] > 900 and abs(change[:, 2]).max() < 4  # beyond the waypoint, on its line
    assert -change[-1, 3] == pytest.approx(165, abs=1.5)
    assert ctl[ap.LEG] == 2
    assert ctl[S.PREV_E] == pytest.approx(0, abs=1e-6) and (ctl[S.PREV_N] - 800.0) % 300.0 == pytest.approx(0)
    assert ctl[S.PREV_N] - change[-1, 1] >= 200.0 - 3.0
    for climb, done in ((1.0, [False, False, True]), (2.0, [True, True, False]), (0.0, [False, True, False])):
        legs[1, m.TURNS] = climb
        ctl = begin(legs, Plane(), start=(0, 0, -100))
        ap.set_leg(ctl, ap.parameters(PLANE)[0], legs, 1, np.array([0.0, 0.0, -100.0]))
        for height, expected in zip((150.0, 167.0, 176.0), done, strict=True):
            p = np.array([900.0, 0.0, -height])
            assert leg_rules.steer(ctl, ap.parameters(PLANE)[0], legs, p, np.array([20.0, 0, 0]), np.zeros(3), 0.1)[
                1
            ] == (expected)


def test_after_a_takeoff_it_flies_directly_to_the_target_not_along_a_line():
    par, _ = ap.parameters(PLANE)
    legs = route(leg(m.TAKEOFF, h=110.0), leg(n=1000.0), leg(n=2000.0))
    plane = Plane((0.0, 0.0, -111.0))
    ctl = begin(legs, plane)
    leg_rules.begin(ctl, par, legs, 1, plane.p)
    aside = np.array([200.0, 100.0, -111.0])
    to_target = 20.0 * np.array([800.0, -100.0, 0.0]) / np.hypot(800.0, 100.0)
    a_lat, _ = leg_rules.steer(ctl, par, legs, aside, to_target, np.array([0.0, 0.0, atan2(-100.0, 800.0)]), 0.1)
    assert abs(a_lat) < 0.05
    ctl[S.FOLLOW_LINE] = 1.0
    assert leg_rules.steer(ctl, par, legs, aside, to_target, np.array([0.0, 0.0, -0.12]), 0.1)[0] < -1.0


def returning(autoland, here):
    legs = route(leg(n=500.0), leg(m.LOITER_UNLIMITED, h=180.0, radius=80.0, turns=autoland, accept_radius=1.0))
    legs = np.vstack([legs, route(leg(n=-900.0, e=-900.0))])
    rows, ctl = fly(legs, Plane((0.0, 20.0, -here)), 140, start=(0, 0, -100))
    return legs, rows, ctl


@pytest.mark.parametrize(("autoland", "last"), [(0.0, 1), (1.0, 2), (2.0, 2)])
def test_a_return_has_no_line_climbs_at_once_and_lands_if_asked(autoland, last):
    legs, rows, ctl = returning(autoland, 100.0)
    assert ctl[ap.LEG] == last
    home = rows[rows[:, 14] == 2]
    if autoland == 2.0:
        assert len(home) == 1  # the landing sequence is entered at once
    else:
        assert home[40, 6] < -1.0  # climbs from the start
        if autoland:
            assert np.hypot(*home[-1, 1:3]) < 2.1 * 80.0 and -home[-1, 3] > 168  # where the circle is captured
    fresh = begin(legs, Plane((480.0, 40.0, -100.0)), start=(0, 0, -100))
    leg_rules.begin(fresh, ap.parameters(PLANE)[0], legs, 1, np.array([480.0, 40.0, -100.0]))
    assert fresh[S.FOLLOW_LINE] < 0.0 and fresh[S.PREV_N] == 480.0


def test_beyond_the_largest_radius_a_waypoint_is_not_accepted():
    par, _ = ap.parameters({**PLANE, "WP_MAX_RADIUS": 20.0})
    legs = route(leg(accept_radius=60.0), leg(e=500.0))
    for north, expected in ((-50.0, False), (-15.0, True)):
        plane = Plane((north, 0.0, -100.0))
        ctl = begin(legs, plane, par, (-500.0, 0.0, -100.0))
        assert leg_rules.steer(ctl, par, legs, plane.p, plane.v, np.zeros(3), 0.1)[1] == expected


def test_an_item_out_of_order_is_flown_to_directly():
    """As s03 of the recordings: a return enters the landing sequence, whose first line starts at the aircraft."""
    par, _ = ap.parameters(PLANE)
    legs = route(leg(n=500.0), leg(n=1000.0), leg(n=1500.0, e=800.0))
    ctl = begin(legs, Plane(), start=(0, 0, -100))
    here = np.array([100.0, 60.0, -100.0])
    leg_rules.begin(ctl, par, legs, 2, here)
    assert (ctl[ap.LEG], ctl[S.FOLLOW_LINE], ctl[S.PREV_N], ctl[S.PREV_E]) == (2, -1.0, 100.0, 60.0)
