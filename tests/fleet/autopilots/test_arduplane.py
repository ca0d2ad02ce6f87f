"""The ArduPlane law against known answers, on a point mass with lags."""

from math import atan2, hypot, pi, radians, sin, tan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet import mission as m
from fleet.autopilots import arduplane as ap
from fleet.autopilots import control_law as S
from fleet.autopilots.arduplane import legs as leg_rules
from fleet.autopilots.arduplane import params as P
from fleet.frames import G
from tests.support.point_mass import HERE, PAR, PLANE, TRIM_ALPHA, TRIM_THR, Plane, begin, fly, leg, route


def crosstrack(rows, a, b):
    t = (np.array(b) - a) / np.linalg.norm(np.array(b) - a)
    return (rows[:, 1] - a[0]) * t[1] - (rows[:, 2] - a[1]) * t[0]


@pytest.mark.parametrize("side", [-80.0, 80.0])
@pytest.mark.parametrize("dt", [0.02, 0.1])
def test_a_straight_leg_is_captured_without_error(side, dt):
    rows, _ = fly(route(leg(n=3000.0)), Plane((0.0, side, -100.0), wind=(0.0, 3.0)), 100, start=(0, 0, -100), dt=dt)
    last = rows[rows[:, 0] > 90]
    assert abs(crosstrack(last, (0, 0), (3000, 0))).max() < 1.5
    assert abs(rows[:, 2]).max() <= abs(side) + 2
    assert abs(last[:, 11]).max() < radians(2)


def test_an_aircraft_that_points_away_turns_one_way_and_comes_back():
    rows, _ = fly(route(leg(n=3000.0)), Plane((0.0, 5.0, -100.0), psi=pi), 60, start=(0, 0, -100))
    turning = rows[(rows[:, 0] < 5), 11]
    assert (abs(turning) > radians(20)).all()
    assert (np.sign(turning) == np.sign(turning[0])).all()
    assert abs(rows[-1, 2]) < 10


@pytest.mark.parametrize("radius", [-80.0, 80.0])
def test_a_circle_is_captured_and_held(radius):
    legs = route(leg(m.LOITER_UNLIMITED, n=400.0, radius=radius))
    rows, ctl = fly(legs, Plane(wind=(0.0, 2.0)), 150)
    last = rows[rows[:, 0] > 100]
    r = np.hypot(last[:, 1] - 400, last[:, 2])
    assert abs(r - 80).max() < 4
    turn = (last[:, 1] - 400) * last[:, 5] - last[:, 2] * last[:, 4]
    assert (np.sign(turn) == np.sign(radius)).all()
    assert ctl[S.ANGLE] > 2 * pi


def test_radius_zero_is_wp_loiter_rad_and_widens_in_thin_air():
    for altitude in (0.0, 3000.0):
        par, _ = ap.parameters({**PLANE, "WP_LOITER_RAD": -70.0}, altitude)
        rows, _ = fly(route(leg(m.LOITER_UNLIMITED, n=300.0)), Plane(), 150, par)
        r = np.hypot(rows[-300:, 1] - 300, rows[-300:, 2])
        assert r.mean() == pytest.approx(70 * ap.eas2tas(altitude) ** 2, abs=3)


def test_turns_are_counted_and_the_exit_points_to_the_next_leg():
    legs = route(leg(m.LOITER_TURNS, n=300.0, radius=70.0, turns=2.0), leg(n=1500.0))
    rows, _ = fly(legs, Plane(), 200)
    circle = rows[rows[:, 14] == 1]
    angle = np.unwrap(np.arctan2(circle[:, 2], circle[:, 1] - 300))
    on = abs(np.hypot(circle[:, 1] - 300, circle[:, 2]) - 70) < 10
    turned = angle[-1] - angle[on][0]
    assert 4 * pi - 0.8 < turned < 6 * pi
    out = circle[-1]
    off = atan2(out[5], out[4]) - atan2(0 - out[2], 1500 - out[1])
    assert abs((off + pi) % (2 * pi) - pi) < radians(12)
    assert rows[-1, 14] == 2


def test_loiter_time_and_loiter_to_altitude_end():
    rows, _ = fly(route(leg(m.LOITER_TIME, n=300.0, radius=70.0, turns=30.0), leg(n=1500.0)), Plane(), 90)
    inside = rows[np.hypot(rows[:, 1] - 300, rows[:, 2]) < 151]  # here the circle law takes over
    left = rows[rows[:, 14] == 2][0, 0]
    assert 30 <= left - inside[0, 0] < 55
    legs = route(leg(m.LOITER_TO_ALT, n=300.0, radius=70.0, h=150.0), leg(n=1500.0, h=150.0))
    rows, _ = fly(legs, Plane(), 120)
    first = rows[rows[:, 14] == 2][0]
    assert -first[3] == pytest.approx(150, abs=6)


def over(legs, p, start, v=(20.0, 0.0, 0.0), par=PAR):
    plane = Plane(p)
    ctl = begin(legs, plane, par, start)
    return leg_rules.steer(ctl, par, legs, plane.p, np.array(v), np.zeros(3), 0.1)[1]


def test_switching_distance_shrinks_with_the_turn():
    start = (-500.0, 0.0, -100.0)
    right = route(leg(), leg(e=500.0))
    assert not over(right, (-50.5, 0.0, -100.0), start)
    assert over(right, (-49.5, 0.0, -100.0), start)
    half = route(leg(), leg(n=500.0, e=500.0))  # 45 deg: half the distance
    assert not over(half, (-25.5, 0.0, -100.0), start)
    assert over(half, (-24.5, 0.0, -100.0), start)
    on = route(leg(), leg(n=500.0))  # straight on: to the finish line
    assert not over(on, (-1.0, 60.0, -100.0), start)
    assert over(on, (1.0, 60.0, -100.0), start)


def test_acceptance_of_the_item_the_l1_distance_and_the_largest_radius():
    start = (-500.0, 0.0, -100.0)
    assert over(route(leg(accept_radius=120.0), leg(e=500.0)), (-119.0, 0.0, -100.0), start)
    past = route(leg(accept_radius=-30.0), leg(e=500.0))
    assert not over(past, (29.0, 0.0, -100.0), start)
    assert over(past, (31.0, 0.0, -100.0), start)
    right = route(leg(), leg(e=500.0))
    l1 = 0.75 * 17 * 5 / pi  # slow: the L1 distance is below WP_RADIUS
    assert not over(right, (-l1 - 1, 0.0, -100.0), start, v=(5.0, 0.0, 0.0))
    assert over(right, (-l1 + 1, 0.0, -100.0), start, v=(5.0, 0.0, 0.0))
    near, _ = ap.parameters({**PLANE, "WP_MAX_RADIUS": 20.0})
    assert not over(right, (1.0, 60.0, -100.0), start, par=near)


def demand(legs, p, start, par=PAR):
    plane = Plane(p)
    return leg_rules.height_demand(begin(legs, plane, par, start), par, legs, plane.p)


def test_height_slopes_along_the_leg_and_steps_where_it_should():
    start, p = (0.0, 0.0, -100.0), (250.0, 20.0, -100.0)
    assert demand(route(leg(n=1000.0, h=180.0)), p, start) == pytest.approx(120)
    assert demand(route(leg(n=1000.0, h=20.0)), p, start) == pytest.approx(80)
    assert demand(route(leg(n=1000.0, h=180.0)), (-50.0, 0.0, -90.0), start) == pytest.approx(100)
    assert demand(route(leg(n=1000.0, h=112.0)), p, start) == 112  # less than ALT_SLOPE_MIN: at once
    at_once, _ = ap.parameters({**PLANE, "FLIGHT_OPTIONS": float(1 << 14)})
    assert demand(route(leg(n=1000.0, h=180.0)), p, start, at_once) == 180
    assert demand(route(leg(n=1000.0, h=20.0)), p, start, at_once) == pytest.approx(80)
    back = route(leg(m.LOITER_UNLIMITED, n=1000.0, h=180.0))
    back[0, m.SEQ] = -1
    assert demand(back, p, start) == 180


@pytest.mark.parametrize("dt", [0.02, 0.1])
@pytest.mark.parametrize(("h", "va"), [(140.0, 20.0), (60.0, 20.0), (100.0, 25.0), (130.0, 15.0)])
def test_tecs_reaches_height_and_speed_and_settles(h, va, dt):
    rows, _ = fly(route(leg(n=9000.0, h=h, va_c=va)), Plane(), 120, start=(0, 0, -h), dt=dt)
    last = rows[rows[:, 0] > 105]
    assert abs(-last[:, 3] - h).max() < 1.0
    assert abs(last[:, 10] - va).max() < 0.5
    climb = -rows[:, 6]
    assert climb.max() < 5.0 * 1.3
    assert climb.min() > -5.0 * 1.3
    assert abs(np.diff(last[:, 13])).max() < 0.02


def test_trim_is_held_without_a_bump():
    rows, _ = fly(route(leg(n=9000.0)), Plane(), 10, start=(0, 0, -100))
    assert abs(rows[:, 12] - TRIM_ALPHA).max() < radians(0.5)
    assert abs(rows[:, 13] - TRIM_THR).max() < 0.02
    assert abs(rows[:, 3] + 100).max() < 0.3


def test_without_an_airspeed_sensor_it_still_climbs_and_flies_on():
    rows, _ = fly(route(leg(n=9000.0, h=140.0)), Plane(), 120, start=(0, 0, -140), sensor=False)
    assert np.isfinite(rows).all()
    assert abs(-rows[-1, 3] - 140) < 3
    assert rows[50:150, 13].mean() > rows[-50:, 13].mean() + 0.02  # more throttle in the climb


def test_underspeed_pushes_the_throttle_and_lowers_the_nose():
    legs, plane = route(leg(n=9000.0, h=200.0)), Plane(Va=9.0)
    ctl = begin(legs, plane, start=(0, 0, -200))
    for _ in range(50):
        _, theta_c, delta_t = ap.guide(ctl, PAR, legs, plane.p, plane.v, plane.euler, 9.0, 0.0, 0.1)
    assert ctl[S.UNDERSPEED] == 1.0
    assert delta_t == 1.0
    assert theta_c < 0


def test_a_square_is_flown_within_a_few_metres():
    corners = [(0.0, 0.0), (800.0, 0.0), (800.0, 800.0), (0.0, 800.0), (0.0, 0.0)]
    rows, _ = fly(route(*(leg(n=n, e=e) for n, e in corners[1:])), Plane(), 157, start=(0, 0, -100))
    for k in range(4):
        a, b = np.array(corners[k]), np.array(corners[k + 1])
        part = rows[rows[:, 14] == k + 1]
        along = (part[:, 1:3] - a) @ (b - a) / 800
        late = part[along > 550]
        assert len(late)
        assert abs(crosstrack(late, a, b)).max() < 6
    far = [min(np.hypot(rows[:, 1] - n, rows[:, 2] - e)) for n, e in corners[1:4]]
    assert max(far) < 60
    assert abs(rows[:, 3] + 100).max() < 3


def test_a_takeoff_climbs_wings_level_and_the_last_leg_is_held():
    legs = route(leg(m.TAKEOFF, h=160.0), leg(n=1500.0, h=160.0), leg(m.LAND, n=1500.0, e=500.0, h=160.0))
    rows, ctl = fly(legs, Plane(), 220)
    up = rows[rows[:, 14] == 1]
    assert abs(up[:, 11]).max() == 0
    assert -up[-1, 3] == pytest.approx(160, abs=2)
    assert int(ctl[ap.LEG]) == 2
    assert hypot(rows[-1, 1] - 1500, rows[-1, 2] - 500) < 300


def test_an_empty_route_keeps_height_and_level():
    legs, plane = np.empty((0, m.N_COLUMNS)), Plane()
    ctl = begin(legs, plane)
    ap.set_leg(ctl, PAR, legs, 5, plane.p)
    phi_c, theta_c, delta_t = ap.guide(ctl, PAR, legs, plane.p, plane.v, plane.euler, 20.0, 0.0, 0.1)
    assert (phi_c, theta_c) == (0.0, pytest.approx(TRIM_ALPHA, abs=0.01))
    assert 0 <= delta_t <= 1


def test_set_leg_is_clamped_and_forgets_the_circle():
    legs, plane = route(leg(m.LOITER_TURNS, n=80.0, radius=80.0, turns=9.0), leg(n=900.0)), Plane()
    _, ctl = fly(legs, plane, 60)
    assert ctl[S.ANGLE] > pi
    ap.set_leg(ctl, PAR, legs, 99, plane.p)
    assert (ctl[ap.LEG], ctl[S.ANGLE], ctl[S.PREV_N]) == (1, 0, plane.p[0])
    ap.set_leg(ctl, PAR, legs, -3, HERE)
    assert ctl[ap.LEG] == 0
    assert np.isfinite(ctl).all()


def test_surfaces_have_the_signs_and_sizes_of_the_law():
    level = np.zeros(3)
    ctl = np.zeros(S.N_CTL)
    delta_a, delta_e, delta_r = ap.stabilise(ctl, PAR, 0.1, 0.05, level, level, 20.0, 1e3)  # filters settled
    full = radians(45)
    p_d, gains = 0.1 / 0.5, (0.345, 0.08, 0.666)
    assert delta_a == pytest.approx((gains[0] * p_d + gains[1] * p_d + gains[2]) / full, rel=1e-2)
    assert delta_a > 0 and delta_e > 0
    assert delta_r == pytest.approx(0.5 * delta_a)
    ctl = np.zeros(S.N_CTL)
    rolling = ap.stabilise(ctl, PAR, 0.0, 0.0, level, np.array([0.5, 0.4, 0.0]), 20.0, 0.02)
    assert rolling[0] < 0 and rolling[1] < 0  # damping
    banked = ap.stabilise(np.zeros(S.N_CTL), PAR, 1.0, 0.0, np.array([1.0, 0, 0]), level, 20.0, 0.02)
    assert banked[1] > 0  # a turn needs pitch rate


def test_surfaces_shrink_with_speed_and_saturate_without_windup():
    level = np.zeros(3)
    slow, fast = (ap.stabilise(np.zeros(S.N_CTL), PAR, 0.3, 0.0, level, level, va, 0.02)[0] for va in (20.0, 28.0))
    assert 0 < fast < 0.8 * slow
    ctl = np.zeros(S.N_CTL)
    for _ in range(3000):
        delta = ap.stabilise(ctl, PAR, 1.5, 0.0, level, level, 20.0, 0.02)
    assert delta[0] == 1.0
    assert ctl[S.I_A] <= 0.666
    assert np.isfinite(ap.stabilise(ctl, PAR, 0.1, 0.1, level, level, np.nan, 0.02)).all()


@pytest.mark.parametrize("dt", [0.02, 0.04])
def test_rate_loops_hold_an_attitude(dt):
    """Flown on p' = 30 (delta_a - disturbance) - 12 p, and the same in pitch."""
    ctl, euler, rates = np.zeros(S.N_CTL), np.zeros(3), np.zeros(3)
    for _ in range(round(20 / dt)):
        delta = ap.stabilise(ctl, PAR, 0.5, 0.1, euler, rates, 20.0, dt)
        for i in range(2):
            rates[i] += (30 * (delta[i] - 0.03) - 12 * rates[i]) * dt
        q_turn = G / 20 * tan(euler[0]) * sin(euler[0])
        euler = euler + np.array([rates[0], rates[1] - q_turn, 0]) * dt
    assert euler[0] == pytest.approx(0.5, abs=0.02)
    assert euler[1] == pytest.approx(0.1, abs=0.03)


anything = st.floats(-1e6, 1e6)
vector = st.tuples(anything, anything, anything).map(np.array)
angles = st.tuples(st.floats(-4, 4), st.floats(-1.6, 1.6), st.floats(-7, 7)).map(np.array)
any_leg = st.builds(
    lambda kind, p, more: [kind, *p, *more, 1.0],
    st.integers(0, 6),
    vector,
    st.tuples(st.floats(-1e4, 1e4), st.floats(0, 1e4), st.floats(-10, 400), st.floats(-1e3, 1e3)),
)


@settings(max_examples=200)
@given(
    st.lists(any_leg, max_size=4), vector, vector, angles, st.one_of(st.floats(-10, 1e3), st.just(float("nan"))),
    st.floats(-1e3, 1e3), st.floats(0.0, 0.2), st.integers(-5, 9),
)  # fmt: skip
def test_finite_in_finite_out(rows, p, v, euler, Va, Va_dot, dt, k):
    legs = np.array(rows) if rows else np.empty((0, m.N_COLUMNS))
    ctl = ap.init(PAR, legs, k, HERE, p, v, euler, Va, 0.0, 0.5)
    for _ in range(3):
        out = ap.guide(ctl, PAR, legs, p, v, euler, Va, Va_dot, dt)
        surfaces = ap.stabilise(ctl, PAR, out[0], out[1], euler, v * 1e-3, Va, dt)
    assert np.isfinite(ctl).all() and np.isfinite(out).all() and np.isfinite(surfaces).all()
    assert abs(out[0]) <= PAR[P.ROLL_LIMIT] and 0 <= out[2] <= 1
    assert max(abs(s) for s in surfaces) <= 1
