"""Every control law behind the one door: lines, circles, wind, switching, height and speed, shadow, parameters."""

from math import atan, degrees, hypot, pi, radians, tan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet import mission as m
from fleet.autopilots import arduplane, laws
from fleet.autopilots import control_law as S
from fleet.autopilots import control_law as parameter_vector
from fleet.autopilots.px4_fixedwing import l1
from fleet.autopilots.px4_fixedwing import params as P
from fleet.autopilots.px4_fixedwing import path as npfg
from fleet.autopilots.shadow import NO_MEMORY, replay_controller
from fleet.autopilots.textbook import params as T
from fleet.frames import G
from tests.support.point_mass import HERE, PLANE, TRIM_ALPHA, Plane, begin, fly, leg, route

OURS = {  # what a plane of 20 m/s needs of each law
    "arduplane": PLANE,
    "px4": {"FW_AIRSPD_TRIM": 20, "FW_AIRSPD_MIN": 12, "FW_AIRSPD_MAX": 28, "FW_THR_TRIM": 0.5},
    "px4_l1": {"FW_AIRSPD_TRIM": 20, "FW_AIRSPD_MIN": 12, "FW_AIRSPD_MAX": 28, "FW_THR_TRIM": 0.5, "FW_L1_PERIOD": 15},
    "textbook": {"Va_c": 20},
}
NEW = ("px4", "px4_l1", "textbook")


def par_of(law, wind=(0.0, 0.0), **more):
    return laws.with_wind(laws.parameters(law, {**OURS[law], **more})[0], *wind)


@pytest.mark.parametrize("wind", [(0.0, 0.0), (0.0, 6.0), (-7.0, 3.0)])
@pytest.mark.parametrize("side", [-80.0, 80.0])
@pytest.mark.parametrize("law", NEW)
def test_a_line_is_captured_and_held_in_wind(law, side, wind):
    plane = Plane((0.0, side, -100.0), wind=wind)
    rows, _ = fly(route(leg(n=4000.0)), plane, 100, par_of(law, wind), start=(0, 0, -100))
    last = rows[rows[:, 0] > 85]
    assert abs(last[:, 2]).max() < 1.0
    assert abs(rows[:, 2]).max() <= abs(side) + 10
    assert abs(last[:, 11]).max() < radians(1)


@pytest.mark.parametrize("radius", [-80.0, 80.0])
@pytest.mark.parametrize("law", NEW)
def test_a_circle_is_captured_and_held_in_wind(law, radius):
    legs = route(leg(m.LOITER_UNLIMITED, n=400.0, radius=radius))
    rows, ctl = fly(legs, Plane(wind=(0.0, 4.0)), 150, par_of(law, (0.0, 4.0)))
    last = rows[rows[:, 0] > 100]
    assert abs(np.hypot(last[:, 1] - 400, last[:, 2]) - 80).max() < 3
    turn = (last[:, 1] - 400) * last[:, 5] - last[:, 2] * last[:, 4]
    assert (np.sign(turn) == np.sign(radius)).all()
    assert ctl[S.ANGLE] > 2 * pi


@pytest.mark.parametrize(("h", "va"), [(140.0, 20.0), (60.0, 20.0), (100.0, 25.0), (130.0, 15.0)])
@pytest.mark.parametrize("law", NEW)
def test_height_and_speed_are_reached_and_settle(law, h, va):
    rows, _ = fly(route(leg(n=9000.0, h=h, va_c=va)), Plane(), 120, par_of(law), start=(0, 0, -h))
    last = rows[rows[:, 0] > 105]
    assert abs(-last[:, 3] - h).max() < 0.5
    assert abs(last[:, 10] - va).max() < 0.3
    assert abs(np.diff(last[:, 13])).max() < 1e-3
    assert ((rows[:, 13] >= 0) & (rows[:, 13] <= 1)).all()


def test_px4_climbs_no_faster_than_its_climb_rate():
    fast, slow = (
        -fly(route(leg(n=9000.0, h=200.0)), Plane(), 60, par_of("px4", **more), start=(0, 0, -200))[0][:, 6].min()
        for more in ({"FW_T_CLMB_R_SP": 3.0}, {"FW_T_CLMB_R_SP": 1.5})
    )
    assert fast == pytest.approx(3.0, abs=0.4)
    assert slow == pytest.approx(1.5, abs=0.4)


@pytest.mark.parametrize("law", NEW)
def test_trim_is_held_without_a_bump(law):
    rows, _ = fly(route(leg(n=9000.0)), Plane(), 10, par_of(law), start=(0, 0, -100))
    assert abs(rows[:, 12] - TRIM_ALPHA).max() < radians(0.5)
    assert abs(rows[:, 13] - 0.5).max() < 0.02
    assert abs(rows[:, 3] + 100).max() < 0.3


@pytest.mark.parametrize("law", NEW)
def test_without_an_airspeed_sensor_height_is_held(law):
    rows, _ = fly(route(leg(n=9000.0, h=120.0)), Plane(), 120, par_of(law), start=(0, 0, -120), sensor=False)
    assert np.isfinite(rows).all()
    assert abs(-rows[-1, 3] - 120) < 3


@pytest.mark.parametrize("law", NEW)
def test_a_square_is_flown_in_wind(law):
    corners = [(0.0, 0.0), (800.0, 0.0), (800.0, 800.0), (0.0, 800.0), (0.0, 0.0)]
    legs = route(*(leg(n=n, e=e) for n, e in corners[1:]))
    rows, _ = fly(legs, Plane(wind=(3.0, 2.0)), 150, par_of(law, (3.0, 2.0)), start=(0, 0, -100))
    for k in range(4):
        a, b = np.array(corners[k]), np.array(corners[k + 1])
        part = rows[rows[:, 14] == k + 1]
        way = part[:, 1:3] - a
        late = way[way @ (b - a) / 800 > 500] @ np.array([[-(b - a)[1]], [(b - a)[0]]]) / 800
        assert len(late) and abs(late).max() < 2
    assert abs(rows[:, 3] + 100).max() < 3


def test_npfg_looks_ahead_as_its_equations_say():
    par = par_of("px4")
    v, tau = np.array([20.0, 0.0, 0.0]), 10 * 0.7071
    assert npfg.error_bound(par, 20.0) == pytest.approx(20 * tau)
    assert npfg.switch_distance(par, 20.0) == pytest.approx(0.32 * 20 * tau)
    assert npfg.switch_distance(par, 0.1) == 10.0  # NAV_ACC_RAD
    gain = 4 * pi * 0.7071 / 10 * 20
    assert npfg.follow(par, 1.0, 0.0, 0.0, 0.0, v, 0.0, 20.0) == pytest.approx(0.0, abs=1e-9)
    right = npfg.follow(par, 1.0, 0.0, 1e4, 0.0, v, 0.0, 20.0)  # far right of it: squarely back
    assert right == pytest.approx(-gain)
    half = npfg.follow(par, 1.0, 0.0, 10 * tau, 0.0, v, 0.0, 20.0)  # la = pi/8: 67.5 deg towards it
    assert half == pytest.approx(-gain * np.sin(3 * pi / 8), rel=1e-3)
    on = npfg.follow(par, 1.0, 0.0, 0.0, 1 / 100, v, 0.0, 20.0)
    assert on == pytest.approx(20**2 / 100)  # curvature feed-forward
    slow = par_of("px4", NPFG_PERIOD=1.0)
    assert npfg.period(slow) == pytest.approx(pi * 0.5 / 0.7071 * 1.5)


def test_l1_of_px4_flies_straight_on_against_the_direction_of_a_circle_and_towards_a_far_one():
    legs, par = route(leg(m.LOITER_UNLIMITED, radius=100.0)), par_of("px4_l1")
    omega, zeta = 2 * pi / 15, 0.75
    east = np.array([0.0, 18.0, 0.0])

    def a_lat(p, v, on_circle):
        ctl = np.zeros(S.N_CTL)
        ctl[P.ON_CIRCLE] = on_circle
        return l1.follow_circle(ctl, par, legs[0], np.array([*p, -100.0]), v, 100.0), ctl[P.ON_CIRCLE]

    inside, outside = 90.0 * omega**2, 18.0**2 / 110
    assert a_lat((110.0, 0.0), east, 1.0)[0] == pytest.approx(10 * omega**2 + outside)  # the right way round, 10 m out
    assert a_lat((10.0, 0.0), east, 1.0)[0] == pytest.approx(-inside + 18.0**2 / 50)
    assert a_lat((10.0, 0.0), -east, 1.0)[0] == pytest.approx(18.0**2 / 50)  # the wrong way: no turn inwards
    assert a_lat((10.0, 0.0), -east, 0.0)[0] == pytest.approx(-inside + 18.0**2 / 50)
    far, on_circle = a_lat((-500.0, 0.0), east, 1.0)  # the centre is abeam on the left
    assert far == pytest.approx(-4 * zeta**2 * 18.0**2 / (zeta * 15 * 18.0 / pi)) and on_circle == 0.0


def test_npfg_crabs_into_the_wind_it_believes_in_and_gives_up_into_a_storm():
    v = np.array([20.0, 0.0, 0.0])
    crabbing = npfg.follow(par_of("px4", (0.0, 5.0)), 1.0, 0.0, 0.0, 0.0, v, 0.0, 20.0)
    assert crabbing == pytest.approx(4 * pi * 0.7071 / 10 * 20 * (np.sin(atan(5 / 20) - np.arcsin(5 / 20))), rel=1e-3)
    storm = par_of("px4", (0.0, 30.0))
    away = npfg.follow(storm, 1.0, 0.0, 0.0, 0.0, np.array([20.0, 30.0, 0.0]), 0.0, 20.0)
    assert away < 0  # turns left, to the west, into the wind


@pytest.mark.parametrize("law", NEW)
def test_phi_is_limited(law):
    plane = Plane((0.0, 500.0, -100.0), psi=pi / 2)
    rows, _ = fly(route(leg(n=3000.0)), plane, 20, par_of(law), start=(0, 0, -100))
    most = radians(50) if law in ("px4", "px4_l1") else T.DEFAULTS["phi_max"]
    assert abs(rows[:, 11]).max() == pytest.approx(most)
    if law in ("px4", "px4_l1"):
        assert abs(np.diff(rows[:, 11])).max() <= radians(90) * 0.1 + 1e-9  # FW_PN_R_SLEW_MAX


def over(law, legs, p, start, v=(20.0, 0.0, 0.0)):
    plane, par = Plane(p), par_of(law)
    ctl = begin(legs, plane, par, start)
    return laws.fly(ctl, par, legs, plane.p, np.array(v), np.zeros(3), 20.0, 0.0, 0.1)[3]


def test_px4_switches_within_its_distance_at_the_height_accepted():
    start, corner = (-500.0, 0.0, -100.0), route(leg(), leg(e=500.0))
    reach = 0.32 * 20 * 7.071
    assert not over("px4", corner, (-reach - 1, 0.0, -100.0), start)
    assert over("px4", corner, (-reach + 1, 0.0, -100.0), start)
    assert not over("px4", corner, (-reach + 1, 0.0, -85.0), start)  # NAV_FW_ALT_RAD 10 m
    assert not over("px4", corner, (1.0, reach + 5, -100.0), start)  # missed: it is flown to again
    assert over("px4", route(leg(accept_radius=120.0), leg(e=500.0)), (-119.0, 0.0, -100.0), start)


def test_px4_circles_at_a_waypoint_until_it_is_high_enough():
    legs = route(leg(n=300.0, h=190.0), leg(n=2500.0, h=190.0))
    rows, _ = fly(legs, Plane(), 200, par_of("px4"), start=(0, 0, -100))
    switched = rows[rows[:, 14] == 2][0]
    assert -switched[3] == pytest.approx(190, abs=11)
    turned = abs(np.unwrap(rows[:, 9])[rows[:, 14] == 1]).max()
    assert turned > 1.5 * pi
    assert rows[-1, 14] == 2


def test_the_textbook_cuts_corners_by_a_fillet():
    start, corner = (-900.0, 0.0, -100.0), route(leg(), leg(e=900.0))
    cut = T.DEFAULTS["R_fillet"] * tan(pi / 4)
    assert not over("textbook", corner, (-cut - 1, 30.0, -100.0), start)
    assert over("textbook", corner, (-cut + 1, 30.0, -100.0), start)  # the half plane, not a distance
    rows, _ = fly(corner, Plane(start), 80, par_of("textbook"), start=start)
    near = np.hypot(rows[:, 1], rows[:, 2]).min()
    assert near == pytest.approx(cut * (2**0.5 - 1), abs=8)  # nearest point of the arc to the corner
    arc = rows[(rows[:, 1] > -cut) & (rows[:, 2] < cut)]
    assert abs(np.hypot(arc[:, 1] + cut, arc[:, 2] - cut) - cut).max() < 8


def test_px4_leaves_a_timed_circle_towards_the_next_leg_only_where_asked():
    def left(accept):
        circle = leg(m.LOITER_TIME, n=300.0, radius=70.0, turns=30.0, accept_radius=accept)
        rows, _ = fly(route(circle, leg(n=1500.0)), Plane(), 120, par_of("px4"))
        near = rows[abs(np.hypot(rows[:, 1] - 300, rows[:, 2]) - 70) < 1.2 * 0.32 * 20 * 7.071][0, 0]
        out = rows[rows[:, 14] == 2][0]
        off = np.arctan2(out[5], out[4]) - np.arctan2(-out[2], 1500 - out[1])
        return out[0] - near, abs((off + pi) % (2 * pi) - pi)

    at_once, when_aligned = left(0.0), left(1.0)
    assert at_once[0] == pytest.approx(30, abs=1)
    assert when_aligned[0] > at_once[0] + 2
    assert degrees(when_aligned[1]) < 14


LAP = [(800.0, 0.0, 100.0), (800.0, 700.0, 120.0), (0.0, 700.0, 120.0), (0.0, 0.0, 100.0), (800.0, 0.0, 100.0)]


@pytest.mark.parametrize("seconds", [95.0, 125.0])
@pytest.mark.parametrize("law", tuple(laws.LAWS))
def test_the_shadow_run_meets_the_memory_of_the_controller_that_flew(law, seconds):
    wind = (3.0, -2.0)
    par, legs, plane = par_of(law, wind), route(*(leg(n=n, e=e, h=h) for n, e, h in LAP)), Plane(wind=wind)
    true = begin(legs, plane, par, start=(0, 0, -100))
    rows, deltas = [], []
    for k in range(round(seconds * 10)):
        row, true = fly(legs, plane, 0.1, par, ctl=true)
        row[0, 0] = 0.1 * k
        surfaces = laws.stabilise(true, par, row[0, 11], row[0, 12], row[0, 7:10], np.zeros(3), row[0, 10], 0.1)
        rows.append(row[0])
        deltas.append([*surfaces, row[0, 13]])
    r, d = np.array(rows)[-600:], np.array(deltas)[-600:]
    now = int(np.argmax(legs[:, m.SEQ] == r[0, 14]))
    ahead, start = legs[now:], legs[now - 1, m.P_N : m.P_D + 1].copy() if now else np.array([0.0, 0.0, -100.0])
    told = (np.ascontiguousarray(c) for c in (r[:, 0], r[:, 1:4], r[:, 4:7], r[:, 7:10], np.zeros((600, 3)), r[:, 10]))
    told = (*told, r[:, 11].copy(), r[:, 12].copy(), d.copy(), r[:, 14].copy())
    ctl, rms = replay_controller(par, ahead, start, *told, NO_MEMORY)
    assert rms < radians(4)  # a fillet begun before is not seen
    assert ahead[int(ctl[S.LEG]), m.SEQ] == r[-1, 14]
    for _ in range(60):
        at = (plane.p, plane.v, plane.euler, plane.Va, np.nan, 0.1)
        a, b = laws.guide(true, par, legs, *at), laws.guide(ctl, par, ahead, *at)
        np.testing.assert_allclose(b, a, atol=0.045)
        s, u = (laws.stabilise(c, par, *a[:2], plane.euler, np.zeros(3), plane.Va, 0.1) for c in (true, ctl))
        np.testing.assert_allclose(s, u, atol=0.04)
        plane.step(*a, 0.1)


@pytest.mark.parametrize("law", tuple(laws.LAWS))
def test_rate_loops_hold_an_attitude(law):
    """Flown on p' = 30 (delta_a - disturbance) - 12 p, the same in pitch and yaw."""
    par, ctl, euler, rates = par_of(law), np.zeros(S.N_CTL), np.zeros(3), np.zeros(3)
    for _ in range(1000):
        delta = laws.stabilise(ctl, par, 0.5, 0.1, euler, rates, 20.0, 0.02)
        for i in range(3):
            rates[i] += (30 * (delta[i] - 0.03) - 12 * rates[i]) * 0.02
        turn = G / 20 * tan(euler[0]) * np.sin(euler[0])
        euler = euler + np.array([rates[0], (rates[1] - turn) / np.cos(euler[0]), 0]) * 0.02
    assert euler[0] == pytest.approx(0.5, abs=0.035)
    assert euler[1] == pytest.approx(0.1, abs=0.12 if law == "textbook" else 0.05)


def test_the_door_leads_arduplane_to_its_own_law_bit_for_bit():
    own, _ = arduplane.parameters(PLANE, 500.0)
    padded, _ = laws.parameters("arduplane", PLANE, 500.0)
    legs = route(leg(n=600.0), leg(m.LOITER_TURNS, n=600.0, e=400.0, radius=90.0, turns=1.0), leg(n=0.0))
    rows, ctl = fly(legs, Plane(), 100, own)
    again, ctl2 = fly(legs, Plane(), 100, padded)
    assert np.array_equal(rows, again) and np.array_equal(ctl, ctl2)
    plane = Plane()
    direct = arduplane.init(own, legs, 0, HERE, plane.p, plane.v, plane.euler, plane.Va, TRIM_ALPHA, 0.5)
    for row in rows[:-1]:
        at = (row[1:4].copy(), row[4:7].copy(), row[7:10].copy(), row[10], np.nan, 0.1)
        assert tuple(row[11:14]) == arduplane.guide(direct, own, legs, *at)


@pytest.mark.parametrize("law", tuple(laws.LAWS))
def test_every_law_knows_its_mark_and_fits_the_vector(law):
    par, absent = laws.parameters(law, {})
    assert par.shape == (parameter_vector.N_PAR,) and par[parameter_vector.LAW] == laws.LAWS[law].code
    assert absent == laws.LAWS[law].names
    assert len(laws.LAWS[law].names) + 1 <= parameter_vector.N_PAR + parameter_vector.W_N
    assert tuple(laws.with_wind(par, 1.0, 2.0)[[parameter_vector.W_N, parameter_vector.W_E]]) == (1.0, 2.0)
    assert par[parameter_vector.W_N] == 0.0  # the original is as it was
    assert len({known.description for known in laws.LAWS.values()}) == len(laws.LAWS)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1e9, 1e12])
@pytest.mark.parametrize("law", NEW)
def test_absurd_parameters_count_as_absent(law, bad):
    names = laws.LAWS[law].names
    par, absent = laws.parameters(law, dict.fromkeys(names, bad))
    assert set(absent) == set(names)
    np.testing.assert_array_equal(par, laws.parameters(law, {})[0])


def test_px4_reads_older_names_and_puts_contradictions_back():
    par, absent = laws.parameters("px4", {"FW_THR_CRUISE": 0.4, "FW_T_THR_DAMP": 0.2, "FW_L1_R_SLEW_MAX": 45})
    assert (par[P.THR_TRIM], par[P.THR_DAMP], par[P.ROLL_SLEW]) == (0.4, 0.2, pytest.approx(radians(45)))
    assert not {"FW_THR_TRIM", "FW_T_THR_DAMPING", "FW_PN_R_SLEW_MAX"} & set(absent)
    par, absent = laws.parameters("px4", {**P.DEFAULTS, "FW_AIRSPD_MIN": 30, "FW_AIRSPD_MAX": 20})
    assert par[P.VA_MIN] < par[P.VA_CRUISE] < par[P.VA_MAX]
    assert set(absent) == {"FW_AIRSPD_MIN", "FW_AIRSPD_MAX", "FW_AIRSPD_TRIM"}


anything = st.floats(-1e6, 1e6)
vector = st.tuples(anything, anything, anything).map(np.array)
angles = st.tuples(st.floats(-4, 4), st.floats(-1.6, 1.6), st.floats(-7, 7)).map(np.array)
any_leg = st.builds(
    lambda kind, p, more: [kind, *p, *more, 1.0],
    st.integers(0, 6),
    vector,
    st.tuples(st.floats(-1e4, 1e4), st.floats(0, 1e4), st.floats(-10, 400), st.floats(-1e3, 1e3)),
)


@pytest.mark.parametrize("law", NEW)
@settings(max_examples=150)
@given(
    st.lists(any_leg, max_size=4), vector, vector, angles, st.one_of(st.floats(-10, 1e3), st.just(float("nan"))),
    st.floats(-1e3, 1e3), st.floats(0.0, 0.2), st.integers(-5, 9),
)  # fmt: skip
def test_finite_in_finite_out(law, rows, p, v, euler, Va, Va_dot, dt, k):
    legs, par = np.array(rows) if rows else np.empty((0, m.N_COLUMNS)), par_of(law, (3.0, -4.0))
    ctl = laws.init(par, legs, k, HERE, p, v, euler, Va, np.nan, np.nan)
    for _ in range(3):
        out = laws.guide(ctl, par, legs, p, v, euler, Va, Va_dot, dt)
        surfaces = laws.stabilise(ctl, par, out[0], out[1], euler, v * 1e-3, Va, dt)
    assert np.isfinite(ctl).all() and np.isfinite(out).all() and np.isfinite(surfaces).all()
    assert abs(out[0]) <= 1.0 and 0 <= out[2] <= 1
    assert max(abs(s) for s in surfaces) <= 1
    assert hypot(*surfaces[:2]) <= 1.5


# --- modes without a mission -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", ["arduplane"])
def test_a_constant_bank_is_held_at_the_height_where_it_began(law):
    rows, _ = fly(route(leg(m.CONSTANT_BANK, h=0.0, turns=radians(18))), Plane(), 60, par_of(law))
    last = rows[rows[:, 0] > 20]
    assert last[:, 11] == pytest.approx(radians(18), abs=radians(0.5))
    assert abs(last[:, 3] + 100).max() < 3.0
    assert abs(last[:, 10] - 20).max() < 0.5


def test_a_glide_is_idle_at_its_pitch():
    rows, _ = fly(route(leg(m.GLIDE, radius=radians(-2))), Plane(), 5, par_of("arduplane"))
    assert (rows[:, 13] == 0.0).all() and rows[:, 12] == pytest.approx(radians(-2))
    assert rows[:, 11] == pytest.approx(0.0)
    assert rows[-1, 3] > rows[0, 3]


def test_after_a_mode_change_no_line_is_followed():
    legs = route(leg(n=3000.0, e=3000.0))
    along = np.array([1.0, -1.0]) / np.sqrt(2)  # across the line from the start
    direct, on_line = (
        fly(legs, Plane(), 60, par_of("arduplane"), start=start)[0] for start in (np.full(3, np.inf), (0, 0, -100))
    )
    assert abs(on_line[-1, 1:3] @ along) < 3.0
    assert direct[-1, 1:3] @ along > 8.0  # as far as the turn has carried it
    to_go = np.array([3000.0, 3000.0]) - direct[-1, 1:3]
    assert np.arctan2(direct[-1, 5], direct[-1, 4]) == pytest.approx(np.arctan2(to_go[1], to_go[0]), abs=0.02)


@pytest.mark.parametrize("law", ["arduplane", "px4", "textbook"])
def test_a_scheduled_change_starts_its_leg_in_time_and_the_next_one_after_it(law):
    legs = route(leg(n=9000.0), leg(n=9000.0), leg(m.LOITER_UNLIMITED, e=400.0, radius=80.0), leg(n=-9000.0))
    plane = Plane()
    ctl = laws.init(par_of(law), legs, 0, np.zeros(3), plane.p, plane.v, plane.euler, plane.Va, TRIM_ALPHA, 0.5)
    ctl[[S.SWITCH_S, S.SWITCH_LEG, S.NEXT_S, S.NEXT_LEG]] = 3.0, 2, 5.0, 3
    rows, _ = fly(legs, plane, 12, par_of(law), ctl=ctl)
    switches = rows[np.flatnonzero(np.diff(rows[:, 14])) + 1]
    assert switches[:, 14].tolist() == [3, 4]
    assert switches[:, 0] == pytest.approx([3.0, 8.0], abs=0.15)


@pytest.mark.parametrize("law", ["arduplane", "px4"])
def test_a_controller_continues_on_another_route_at_another_height(law):
    par = laws.parameters(law, {}, 0.0)[0]
    ctl = np.arange(float(S.N_CTL))
    fresh = np.full(S.N_CTL, -1.0)
    laws.restore(fresh, par, laws.remember(ctl, par, 100.0), 130.0)
    heights = 4 if law == "arduplane" else 1
    assert fresh[S.H_IN : S.H_IN + heights] == pytest.approx(ctl[S.H_IN : S.H_IN + heights] + 30.0)
    assert fresh[[S.I_THR, S.I_SEB, S.I_KE]] == pytest.approx(ctl[[S.I_THR, S.I_SEB, S.I_KE]])
    assert (fresh[: S.N_LEG] == -1.0).all() and fresh[S.V_HAT] == fresh[S.HAS_VELOCITY] == -1.0  # leg, measurements
