"""The hybrid: what it identifies on flights whose numbers are known, how it flies, and what its bundle says."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.autopilots import arduplane, laws
from fleet.contract import Item
from fleet.frames import G, Origin
from fleet.mission import unroll_route
from fleet.physics import point_mass as H
from fleet.window import Window
from tests.support import flights
from tests.twin_worker.prediction.test_predict import AHEAD, FLOWN_S, NORTH, level, situation
from twin_worker.identification.fixed_wing import energy_balance
from twin_worker.identification.fixed_wing.energy_balance import PointMassData, RegressionResult
from twin_worker.identification.fixed_wing.point_mass_model import PointMassModel, identify
from twin_worker.prediction.closed_loop import InitialCondition, synchronise_controller
from twin_worker.prediction.fixed_wing import ensemble
from twin_worker.prediction.fixed_wing.point_mass_rollout import (
    fly_point_mass,
    ground_velocity,
    start_and_air,
    unexplained_velocity,
)

SPEED = 22.0
HOME = Origin(470_000_000, 80_000_000, 500_000)


def body(**other: float) -> np.ndarray:
    """An aircraft in trim at 22 m/s and half throttle."""
    out = np.zeros(H.N_PARAMETERS)
    out[[H.WN_PHI, H.ZETA_PHI, H.WN_THETA, H.ZETA_THETA]] = 3.0, 0.9, 3.0, 0.9
    out[[H.K_PSI, H.A_N, H.C_T, H.C_V, H.C_N, H.T_0, H.V_0]] = 1.0, 0.06, 4.0, -0.1, -0.2, 0.5, SPEED
    for name, value in other.items():
        out[getattr(H, name)] = value
    return out


def known(**other: float) -> PointMassModel:
    return PointMassModel(body(**other), RegressionResult(np.zeros(4), np.diag([0.01, 0.1, 1e-4, 0.01])), 0.0)


# --- what is identified ----------------------------------------------------------------------------------------------


def second_order_response(command: np.ndarray, lag: tuple[float, float, float]) -> np.ndarray:
    """The lag from rest at 0, four steps a row; back at 0 after a row without a command."""
    (wn, zeta, bias), h = lag, energy_balance.STEP / 4
    angle, rate, out = 0.0, 0.0, []
    for target in command + bias:
        out.append(angle)
        if not np.isfinite(target):
            angle, rate = 0.0, 0.0
            continue
        for _ in range(4):
            rate += h * (wn * wn * (target - angle) - 2.0 * zeta * wn * rate)
            angle += h * rate
    return np.array(out)


@pytest.mark.parametrize("lag", [(2.0, 0.7, 0.02), (4.0, 1.0, -0.03)])
def test_a_lag_is_found_again_from_its_own_flight(lag):
    rng = np.random.default_rng(3)
    command = np.repeat(rng.uniform(-0.6, 0.6, 40), 30)
    out = second_order_response(command, lag)
    found = energy_balance.fit_attitude_lag(command, out + 0.01 * rng.standard_normal(len(out)))
    assert np.allclose(found, lag, rtol=0.08, atol=0.006)


def test_the_derivatives_of_the_lag_are_those_of_its_free_run():
    """One pass sums what the free runs beside each other give, also after lost commands."""
    rng = np.random.default_rng(5)
    command = np.repeat([0.1, 0.5, np.nan, -0.5, 0.2], 60)
    lags = np.array([2.5, 0.8, 0.01]) + energy_balance._BESIDE
    y = second_order_response(command, (2.0, 0.9, 0.0)) + 0.05 * rng.standard_normal(len(command))
    y[~np.isfinite(command)] = 0.0
    y[180] = 0.0
    y[0] = 0.0
    sums = np.empty((4, 4))
    energy_balance._lag_sums(command, y, lags, np.empty((4, 2)), sums)
    weight = 1.0 / (0.02 * np.sqrt(10))
    runs = np.array([second_order_response(command, tuple(lag)) for lag in lags])[:, np.isfinite(command)]
    residual = (runs[0] - y[np.isfinite(command)]) * weight
    d = np.vstack([residual, (runs[1:] - runs[0]) * weight / np.diag(energy_balance._BESIDE[1:])[:, None]])
    huber = 1.0 / np.maximum(np.abs(residual) / (3.0 / np.sqrt(10)), 1.0)
    assert np.allclose(sums, (huber * d) @ d.T, rtol=1e-6)


def test_a_lag_survives_lost_commands_and_holds_to_what_is_usual_without_any():
    command = np.repeat([0.0, 0.5, np.nan, -0.5, 0.2], 60)
    out = second_order_response(command, (2.5, 0.8, 0.0))
    assert np.isfinite(energy_balance.fit_attitude_lag(command, out)).all()
    assert np.allclose(energy_balance.fit_attitude_lag(np.full(100, np.nan), np.zeros(100)), [3.0, 0.9, 0.0], atol=1e-6)


def gusty(seconds: float, gust: float, seed: int) -> PointMassData:
    """Energy alone, c_t = 3.4, c_v = -0.1: a throttle that answers every gust, climbs asked for now and then."""
    rng, dt = np.random.default_rng(seed), energy_balance.STEP
    n = round(seconds / dt)
    V, h, thr, blown = np.full(n, SPEED), np.full(n, 100.0), np.full(n, 0.4), 0.0
    climb = np.repeat(rng.choice([0.0, 0.0, 1.5, -1.5], n // 200 + 1), 200)[:n]
    I = 0.0
    for k in range(1, n):
        blown += dt / 4.0 * -blown + gust * np.sqrt(2 * dt / 4.0) * rng.standard_normal()
        I = np.clip(I + dt * 0.02 * (SPEED - V[k - 1]), -0.3, 0.3)
        thr[k] = np.clip(0.4 + G * climb[k] / SPEED / 3.4 + 0.15 * (SPEED - V[k - 1]) + I, 0.0, 1.0)
        V[k] = V[k - 1] + dt * (3.4 * (thr[k] - 0.4) - 0.1 * (V[k - 1] - SPEED) + blown - G * climb[k] / SPEED)
        h[k] = h[k - 1] + dt * climb[k]
    level = np.zeros(n)
    return PointMassData(V, h, climb, level, level, level, thr, climb, np.full(n, SPEED), level, level)


def test_power_is_told_by_what_the_route_asks_not_by_what_gusts_do():
    flights = [gusty(240.0, 0.8, seed) for seed in range(12)]
    plain, instrumented = [], []
    for flight in flights:
        X = np.column_stack(
            [
                np.ones(len(flight) - 20),
                energy_balance.moving_mean(flight.delta_t) - 0.4,
                energy_balance.moving_mean(flight.V) - SPEED,
            ]
        )
        y = energy_balance.moving_slope(0.5 * flight.V**2 + G * flight.h) / energy_balance.moving_mean(flight.V)
        plain.append(np.linalg.lstsq(X, y, rcond=None)[0][1])
        instrumented.append(energy_balance.fit_excess_power(flight, 0.4, SPEED).value[1])
    assert np.median(plain) < 0.75 * 3.4  # what feedback makes of it
    assert np.median(instrumented) == pytest.approx(3.4, rel=0.15)


def test_a_flight_too_short_says_so():
    now = situation()
    with pytest.raises(ValueError, match=r"hybrid: found .* s of flight, expected 20 s; wait"):
        identify(now.window.part(0, 100), now.history, 1.0)


def circling(bias: np.ndarray, noise: float = 0.01) -> PointMassData:
    """Turns at 20 m/s whose bank is reported with an error that shows in the turn rate, (n,) [rad/s]."""
    n, dt = len(bias), energy_balance.STEP
    phi = 0.35 + 0.05 * np.sin(0.15 * np.arange(n) * dt)
    rate = G * np.tan(phi) / 20.0 + bias + noise * np.random.default_rng(4).standard_normal(n)
    level, V = np.zeros(n), np.full(n, 20.0)
    return PointMassData(V, level, level, phi, level, np.cumsum(rate) * dt, level + 0.4, level, V, phi, level)


def test_the_turn_rate_of_a_drifting_attitude_is_that_of_now():
    """An attitude estimate that drifts in a long turn: the mean over two minutes was wrong by half of the drift."""
    bias = np.linspace(-0.04, 0.06, 1200)
    k, b = energy_balance.fit_turn_rate(circling(bias)).value
    expected = bias[-1] + (1.0 - k) * G * np.tan(0.35) / 20.0
    assert b == pytest.approx(expected, abs=0.012) and k == pytest.approx(1.0, abs=0.12)


def test_a_constant_turn_bias_is_found_as_before():
    k, b = energy_balance.fit_turn_rate(circling(np.full(1200, 0.02))).value
    assert b + (k - 1.0) * G * np.tan(0.35) / 20.0 == pytest.approx(0.02, abs=0.004)


def test_rows_in_a_gap_count_for_nothing():
    flight = circling(np.full(900, 0.01))
    valid = np.ones(900, bool)
    valid[400:440] = False
    psi = np.where(valid, flight.psi, 99.0)
    broken = replace(flight, psi=psi, valid=valid)
    assert not broken.measured[395:430].any() and broken.measured[:370].all() and broken.measured[450:].all()
    whole, holed = (energy_balance.fit_turn_rate(one).value for one in (flight, broken))
    assert np.allclose(whole, holed, atol=0.02)


# --- how it flies ----------------------------------------------------------------------------------------------------


def test_it_begins_where_and_as_fast_as_the_aircraft_is():
    now = situation()
    start = synchronise_controller(now)
    assert isinstance(start, InitialCondition)
    state, air = start_and_air(now, start.window)
    got = fly_point_mass(now, start, known(), AHEAD)
    assert got.path is not None and np.allclose(got.path[0], start.window.p[-1])
    v = (got.path[1] - got.path[0])[:2]
    assert np.allclose(v, ground_velocity(start.window)[:2], atol=0.4)
    assert np.allclose(unexplained_velocity(state, air, ground_velocity(start.window)[:2]), air[[H.REST_N, H.REST_E]])


def test_an_aircraft_that_accelerates_and_climbs_begins_at_its_present_speed_and_climb():
    """A mode change: the mean airspeed of 0.8 s lags 3 m/s2 by 1.2 m/s, and the rest would look like a gust."""
    window = accelerating(3.0, 4.0)
    laid = flights.turn(FLOWN_S, rate=0.0, psi=0.0, bank=0.0, Va=SPEED)
    t, air = laid["air"]
    air[:, 0] += 3.0 * np.clip(t - (window.t[-1] - 2.0), 0.0, None)
    now = replace(situation(window=window), history=flights.remembered(flights.messages(laid)))
    state, wind = start_and_air(now, now.window)
    assert state[H.V] == pytest.approx(SPEED + 6.0, abs=0.5)
    assert np.sin(state[H.GAMMA]) * state[H.V] == pytest.approx(8.0, abs=0.5)
    assert np.abs(wind[[H.REST_N, H.REST_E]]).max() < 1.5  # the climb takes a part of the speed


def accelerating(forward: float, climb: float) -> Window:
    """Level flight to the north, but for the last two seconds: accelerations forward and up [m/s2]."""
    steady = level()
    since = np.clip(steady.t - (steady.t[-1] - 2.0), 0.0, None)
    x, p, v = steady.x.copy(), steady.p.copy(), steady.v.copy()
    x[:, 0] += forward * since
    v[:, 0] += forward * since
    v[:, 2] -= climb * since
    p[:, 0] += 0.5 * forward * since**2
    p[:, 2] -= 0.5 * climb * since**2
    return replace(steady, x=x, p=p, v=v)


def test_it_flies_the_route_and_turns_where_that_turns():
    now = situation(items=(NORTH[0], NORTH[1], replace_item(NORTH[2], east=3000.0)))
    start = synchronise_controller(now)
    assert isinstance(start, InitialCondition)
    got = fly_point_mass(now, start, known(), np.arange(0.0, 181.0))
    assert got.path is not None and np.abs(got.path[:, 1]).max() < 5.0  # its first leg is 5 km long
    assert got.path[-1, 0] - got.path[0, 0] == pytest.approx(180 * SPEED, rel=0.06)


def replace_item(item: Item, east: float) -> Item:
    import msgspec

    return msgspec.structs.replace(item, lon_e7=item.lon_e7 + int(east * 130))


def control() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A controller on a leg of 9 km to the north, at 100 m."""
    place = [(HOME.lat_e7 + 400_000 * k, HOME.lon_e7, 100.0 if k else 500.0) for k in range(3)]
    items = tuple(Item(seq=k, command=16, lat_e7=lat, lon_e7=lon, alt_m=alt) for k, (lat, lon, alt) in enumerate(place))
    way = unroll_route(items, seq=1, origin=HOME, params={})
    par, _ = laws.parameters("arduplane", arduplane.DEFAULTS | {"AIRSPEED_CRUISE": SPEED, "AIRSPEED_MAX": 30.0}, 600.0)
    p, v = np.array([0.0, 0.0, -100.0]), np.array([SPEED, 0.0, 0.0])
    return laws.init(par, way.legs, 0, p, p, v, np.zeros(3), SPEED, 0.0, 0.5), par, way.legs  # type: ignore


def flown(
    air: np.ndarray, chance: np.ndarray, seconds: float = 60.0, dt: float = H.STEP, phi: float = 0.0
) -> np.ndarray:
    ctl, par, legs = control()
    start = np.zeros(H.N_START)
    start[2], start[H.V], start[H.THROTTLE], start[H.PHI] = -100.0, SPEED, 0.5, phi
    out = np.empty((round(seconds / dt) + 1, 3))
    assert H.simulate_route(ctl, par, legs, body(), air, start, chance, dt, out) == len(out)
    return out


def calm(**other: float) -> np.ndarray:
    air = np.zeros(H.N_AIR)
    air[[H.SCALE, H.DRIFT_S, H.REST_S]] = 1.0, 60.0, 7.0
    for name, value in other.items():
        air[getattr(H, name)] = value
    return air


def test_wind_carries_it_and_a_gust_passes():
    none = np.empty((0, 4))
    still, blown = flown(calm(), none), flown(calm(W_N=4.0), none)
    assert (blown - still)[-1, 0] == pytest.approx(240.0, abs=10.0)
    gust = (flown(calm(REST_N=3.0), none) - still)[:, 0]
    assert 0.0 < gust[10] < 3.3 and abs(gust[-1] - gust[-100]) < 6.0  # carried for seconds, not for a minute
    assert np.abs(still[:, 1]).max() < 1.0 and np.abs(still[:, 2] + 100.0).max() < 6.0


def test_a_turn_keeps_to_its_tangent_whatever_the_step():
    """Seconds into a steady turn, before guidance rolls out: as the course that a bank of 0.6 rad turns."""
    none = np.empty((0, 4))
    for dt in (0.05, H.STEP, H.COARSE_STEP):
        path = flown(calm(), none, seconds=2.0, dt=dt, phi=0.6)
        course = np.arctan2(*np.diff(path, axis=0)[0, 1::-1])
        rate = 9.81 * np.tan(0.6) / SPEED
        assert course == pytest.approx(0.5 * rate * dt, abs=0.15 * rate * dt)


def test_coarse_steps_fly_the_same_flight():
    none = np.empty((0, 4))
    fine, coarse = flown(calm(W_E=3.0), none), flown(calm(W_E=3.0), none, dt=H.COARSE_STEP)
    assert np.linalg.norm(fine[::10] - coarse[::4], axis=1).max() < 6.0  # of 1,300 m


# --- the bundle ------------------------------------------------------------------------------------------------------


def test_the_first_of_a_bundle_is_the_flight_itself_and_the_others_differ():
    ctl, par, legs = control()
    start = np.zeros(H.N_START)
    start[2], start[H.V], start[H.THROTTLE] = -100.0, SPEED, 0.5
    chance = np.random.default_rng(1).standard_normal((5, 61, 4))
    chance[0] = 0.0
    air = calm(DRIFT=0.6, REST=0.8)
    rows = [np.tile(row, (5, 1)) for row in (body(), air, start)]
    out = np.empty((5, 61, 3))
    H.simulate_ensemble((ctl, par, legs), *rows, chance, np.arange(0, 241, 4), out)  # type: ignore
    assert np.allclose(out[0], flown(calm(), np.empty((0, 4)), dt=H.COARSE_STEP)[::4])
    assert np.isfinite(out).all() and (np.ptp(out[:, -1, 0]) > 5.0)


def test_the_spread_grows_and_rougher_air_widens_it():
    now = situation()
    start = synchronise_controller(now)
    assert isinstance(start, InitialCondition)
    ahead = np.arange(0.0, 61.0)
    now.wind_filter._P *= 1e-3  # as after minutes of flight
    now.wind_filter._mean_nis = np.full((3, 2), 0.2)
    one = ensemble.ensemble_std(now, start, known(), ahead, np.random.default_rng(0))
    now.wind_filter._mean_nis = np.full((3, 2), 9.0)
    rough = ensemble.ensemble_std(now, start, known(), ahead, np.random.default_rng(0))
    assert one is not None and rough is not None and one.shape == (61, 3)
    assert one[60, 0] > 3 * one[5, 0] > 0.0 and one[60, 0] > one[60, 1] and rough[60, 0] > 1.3 * one[60, 0]


def test_a_bundle_that_falls_apart_gives_no_spread():
    now = situation()
    start = synchronise_controller(now)
    assert isinstance(start, InitialCondition)
    wild = known(C_0=-30.0)
    assert ensemble.ensemble_std(now, start, replace(wild), np.arange(0.0, 61.0), np.random.default_rng(0)) is None
    assert fly_point_mass(now, start, wild, AHEAD).diverged
