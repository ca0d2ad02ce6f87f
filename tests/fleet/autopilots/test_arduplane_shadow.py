"""The shadow run: what telemetry tells about the controller's memory; and the parameters both read."""

from math import radians

import numpy as np
import pytest

from fleet import mission as m
from fleet.autopilots import arduplane as ap
from fleet.autopilots import control_law as S
from fleet.autopilots.arduplane import params as P
from fleet.autopilots.shadow import NO_MEMORY, replay_controller
from tests.support.point_mass import HERE, PAR, Plane, begin, fly, leg, route

LAP = [(800.0, 0.0, 100.0), (800.0, 700.0, 130.0), (0.0, 700.0, 130.0), (0.0, 0.0, 90.0), (800.0, 0.0, 100.0)]


def recorded(seconds):
    """Fly a lap with guidance and rate loops; give the record, surfaces, rates and the controller's end state."""
    legs, plane = route(*(leg(n=n, e=e, h=h) for n, e, h in LAP)), Plane(wind=(3.0, -2.0))
    ctl = begin(legs, plane, start=(0, 0, -100))
    rows, deltas = [], []
    for _ in range(round(seconds * 10)):
        row, ctl = fly(legs, plane, 0.1, ctl=ctl)
        row[0, 0] = len(rows) * 0.1
        surfaces = ap.stabilise(ctl, PAR, row[0, 11], row[0, 12], row[0, 7:10], np.zeros(3), row[0, 10], 0.1)
        rows.append(row[0])
        deltas.append([*surfaces, row[0, 13]])
    return legs, plane, np.array(rows), np.array(deltas), ctl


def shadowed(legs, rows, deltas, begin_s, start=HERE, **changed):
    part = rows[:, 0] >= begin_s - 1e-9
    r, d = rows[part], deltas[part]
    columns = {"phi_c": r[:, 11].copy(), "theta_c": r[:, 12].copy(), "delta": d.copy(), "p": r[:, 1:4].copy()} | changed
    ahead = legs[int(np.argmax(legs[:, m.SEQ] == r[0, 14])) :]
    ctl, rms = replay_controller(
        PAR, ahead, np.array(start, float), r[:, 0].copy(), columns["p"], r[:, 4:7].copy(), r[:, 7:10].copy(),
        np.zeros((len(r), 3)), r[:, 10].copy(), columns["phi_c"], columns["theta_c"], columns["delta"], r[:, 14].copy(),
        NO_MEMORY,
    )  # fmt: skip
    return ahead, ctl, rms


@pytest.mark.parametrize("seconds", [95.0, 110.0, 125.0])
def test_the_shadow_run_recovers_the_controller(seconds):
    legs, plane, rows, deltas, true = recorded(seconds)
    ahead, ctl, rms = shadowed(legs, rows, deltas, seconds - 60)
    assert rms < radians(2)
    assert ahead[int(ctl[ap.LEG]), m.SEQ] == rows[-1, 14]
    for _ in range(100):
        at = (plane.p, plane.v, plane.euler, plane.Va, np.nan, 0.1)
        a, b = ap.guide(true, PAR, legs, *at), ap.guide(ctl, PAR, ahead, *at)
        assert b[0] == pytest.approx(a[0], abs=radians(2.5))
        assert b[1] == pytest.approx(a[1], abs=radians(1))
        assert b[2] == pytest.approx(a[2], abs=0.04)
        s, u = (ap.stabilise(c, PAR, *a[:2], plane.euler, np.zeros(3), plane.Va, 0.1) for c in (true, ctl))
        np.testing.assert_allclose(s, u, atol=0.03)
        plane.step(*a, 0.1)


def test_the_shadow_run_follows_the_reported_item_not_its_own_opinion():
    legs, _, rows, deltas, _ = recorded(60)
    behind = rows.copy()
    behind[:, 14] = 1  # the aircraft says it still flies item 1
    ahead, ctl, _ = shadowed(legs, behind, deltas, 0)
    assert ahead[int(ctl[ap.LEG]), m.SEQ] == 1
    early = rows.copy()
    early[300:, 14] = 3  # it was sent ahead
    ahead, ctl, _ = shadowed(legs, early, deltas, 0)
    assert ahead[int(ctl[ap.LEG]), m.SEQ] == 3
    unknown = rows.copy()
    unknown[:, 14] = 50
    _, ctl, _ = shadowed(legs, unknown, deltas, 0)
    assert np.isfinite(ctl).all()


def test_legs_of_one_number_are_left_without_a_report_as_in_a_return():
    legs, _, rows, deltas, true = recorded(60)
    assert int(true[ap.LEG]) > 0
    unnumbered = rows.copy()
    unnumbered[:, 14] = -1
    legs[:, m.SEQ] = -1
    _, ctl, rms = shadowed(legs, unnumbered, deltas, 0)
    assert int(ctl[ap.LEG]) == int(true[ap.LEG]) and rms < radians(2)


def circled(until_s, delay_s):
    """Fly a circle and leave it; the items are reported once a second and late. Give route, record, surfaces."""
    legs = route(leg(m.LOITER_TURNS, n=400.0, radius=80.0, turns=1.0), leg(n=400.0, e=2000.0))
    rows, _ = fly(legs, Plane(), 80)
    left = int(np.argmax(rows[:, 14] == 2))
    flown = rows[: left + round(until_s * 10)].copy()
    k = np.arange(len(flown))
    flown[:, 14] = rows[np.maximum(k - round(delay_s * 10), 0), 14]
    return legs, flown, np.hstack([np.zeros((len(flown), 3)), flown[:, 13:14]])


@pytest.mark.parametrize("until_s", [0.3, 0.9, 1.5])
def test_a_circle_is_left_before_the_item_is_reported(until_s):
    """Who waits for the report misses the exit, and predicts another turn."""
    legs, rows, deltas = circled(until_s, 1.0)
    ahead, ctl, _ = shadowed(legs, rows, deltas, 0)
    assert ahead[int(ctl[ap.LEG]), m.SEQ] == 2


def test_an_exit_that_no_report_confirms_is_taken_back():
    legs, rows, deltas = circled(6.0, 100.0)
    ahead, ctl, _ = shadowed(legs, rows, deltas, 0)
    assert ahead[int(ctl[ap.LEG]), m.SEQ] == 1
    assert ctl[S.ANGLE] > 0 and ctl[S.CIRCLE_REACHED] == 1.0  # and the circle goes on


def test_the_shadow_run_passes_over_what_is_missing():
    legs, _, rows, deltas, _ = recorded(60)
    rng = np.random.default_rng(5)
    lost = rng.random(len(rows)) < 0.3
    holes = {"phi_c": rows[:, 11], "theta_c": rows[:, 12], "delta": deltas, "p": rows[:, 1:4]}
    holes = {name: column.copy() for name, column in holes.items()}
    for column in holes.values():
        column[lost] = np.nan
    _, whole, _ = shadowed(legs, rows, deltas, 0)
    _, ctl, rms = shadowed(legs, rows, deltas, 0, **holes)
    assert np.isfinite(ctl).all() and np.isfinite(rms)
    assert ctl[S.I_SEB] == pytest.approx(whole[S.I_SEB], abs=3.0)  # 3 m2/s3: about 1 deg of pitch
    empty = {name: np.full_like(column, np.nan) for name, column in holes.items()}
    _, ctl, rms = shadowed(legs, rows, deltas, 0, **empty)
    assert np.isfinite(ctl).all() and np.isnan(rms)


def test_a_changed_result_does_not_change_the_next_one():
    values, absent = ap.read({"NAVL1_PERIOD": 21.0, "RLL2SRV_P": 1.2})
    expected = dict(values)
    values["NAVL1_PERIOD"] = 0.0
    assert ap.read({"NAVL1_PERIOD": 21.0, "RLL2SRV_P": 1.2, "OTHER": 1.0}) == (expected, absent)


def test_old_names_are_read():
    old = {"LIM_ROLL_CD": 5500, "TRIM_ARSPD_CM": 1800, "ARSPD_FBW_MIN": 11, "ARSPD_FBW_MAX": 27, "LIM_PITCH_MAX": 2200}
    old |= {"LIM_PITCH_MIN": -1800, "TRIM_PITCH_CD": 150, "GLIDE_SLOPE_MIN": 12, "TRIM_THROTTLE": 40, "THR_MAX": 90}
    par, absent = ap.parameters(old)
    expect = {P.ROLL_LIMIT: radians(55), P.VA_CRUISE: 18, P.VA_MIN: 11, P.VA_MAX: 27, P.PITCH_HIGH: radians(22)}
    expect |= {P.PITCH_LOW: radians(-18), P.PITCH_TRIM: radians(1.5), P.SLOPE_MIN: 12, P.THR_TRIM: 0.4, P.THR_MAX: 0.9}
    for i, value in expect.items():
        assert par[i] == pytest.approx(value), P.NAMES[i]
    assert not {P.NAMES[i] for i in expect} & set(absent)
    new, _ = ap.parameters({**old, "ROLL_LIMIT_DEG": 60})
    assert new[P.ROLL_LIMIT] == pytest.approx(radians(60))  # the current name wins


def test_old_angle_gains_become_rate_gains():
    old = {"RLL2SRV_P": 1.2, "RLL2SRV_I": 0.2, "RLL2SRV_D": 0.06, "RLL2SRV_IMAX": 2250, "RLL2SRV_TCONST": 0.4}
    par, absent = ap.parameters(old)
    ff = (1.2 - 0.2 * 0.4) * 0.4 - 0.06
    np.testing.assert_allclose(par[[P.ROLL_FF, P.ROLL_P, P.ROLL_I, P.ROLL_IMAX]], [ff, 0.06, 0.08, 0.5])
    assert "RLL_RATE_P" not in absent and "PTCH_RATE_P" in absent


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1.0, 1e12])
def test_absurd_parameters_count_as_absent(bad):
    par, absent = ap.parameters(dict.fromkeys(ap.NAMES, bad))
    assert np.isfinite(par).all()
    assert "NAVL1_PERIOD" in absent and "AIRSPEED_CRUISE" in absent
    assert par[P.PERIOD] == ap.DEFAULTS["NAVL1_PERIOD"]


def test_contradictions_fall_back_and_defaults_are_complete():
    par, absent = ap.parameters({**ap.DEFAULTS, "AIRSPEED_MIN": 30, "AIRSPEED_MAX": 20})
    assert par[P.VA_MIN] < par[P.VA_MAX] and "AIRSPEED_MIN" in absent
    par, absent = ap.parameters(ap.DEFAULTS, 2000.0)
    assert absent == ()
    assert par.shape == (ap.N_PAR,)
    assert par[P.EAS2TAS] == pytest.approx(1.1028, abs=1e-3)  # ISA: density ratio 0.8217 at 2 km
    assert ap.LAW == "arduplane: L1 + TECS"
