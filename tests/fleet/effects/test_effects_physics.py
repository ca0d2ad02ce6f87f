"""Effects do what their equation says: each against another way of reckoning the same."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fleet.effects import MEMORY, Body, Flow, catalogue

ALL = catalogue("")
DT = 0.04
CARD = Body(mass=900.0, S=16.0, b=11.0, c=1.5, D=1.9)


def served(name: str, u: np.ndarray, *par: float, dt: float = DT) -> np.ndarray:
    out = u.copy()
    ALL[name].act(out, np.full(MEMORY, u[0]), dt, np.repeat(np.array(par)[:, None], len(u), 1))
    return out


def flow(height: float = 100.0, body: Body = CARD, **numbers: float) -> Flow:
    return Flow(t=0.0, h=height, height=height, body=body, **numbers)


@pytest.fixture
def u() -> np.ndarray:
    return np.cumsum(np.random.default_rng(4).uniform(-0.1, 0.1, 300))


# --- servos ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay", [0.04, 0.1, 0.3, 0.99])
def test_a_delay_is_the_command_of_then(delay: float, u: np.ndarray) -> None:
    t = DT * np.arange(len(u))
    assert served("actuator_delay", u, delay) == pytest.approx(np.interp(t - delay, t, u))


def test_a_delay_longer_than_the_memory_is_as_long_as_the_memory(u: np.ndarray) -> None:
    longest = (MEMORY - 1) * DT
    assert np.array_equal(served("actuator_delay", u, 5.0), served("actuator_delay", u, longest))


def test_a_rate_limit_turns_a_step_into_a_ramp_and_leaves_what_is_slow() -> None:
    step, slow = np.r_[0.0, np.full(99, 0.5)], np.linspace(0.0, 0.3, 100)
    assert served("actuator_rate_limit", step, 4.0) == pytest.approx(np.minimum(np.arange(100) * DT / 4.0, 0.5))
    assert np.array_equal(served("actuator_rate_limit", slow, 4.0), slow)


def test_play_loses_its_whole_width_at_every_turn() -> None:
    triangle = np.abs((np.arange(400) / 100.0) % 2.0 - 1.0)
    moved = served("actuator_deadband", triangle, 0.1)
    assert np.ptp(moved[100:]) == pytest.approx(0.8, abs=1e-9)
    assert np.abs(moved - triangle).max() == pytest.approx(0.1)
    assert np.ptp(served("actuator_deadband", 0.05 * triangle, 0.1)) == 0.0


def test_lost_travel_offset_weak_and_stuck(u: np.ndarray) -> None:
    assert np.array_equal(served("actuator_saturation", u, 0.75), np.clip(u, -0.25, 0.25))
    assert np.array_equal(served("actuator_offset", u, -0.1), u - 0.1)
    assert served("control_effectiveness_loss", u, 0.4) == pytest.approx(0.6 * u)
    assert served("actuator_stuck", u, 1.0, 0.2) == pytest.approx(np.full(len(u), 0.2))


# --- air -------------------------------------------------------------------------------------------------------------


def test_turbulence_is_as_strong_and_as_slow_as_dryden_and_independent_by_axis() -> None:
    t = np.arange(0.0, 20000.0, 0.5)
    seen = Flow(t=t, h=0.0, height=0.0, body=CARD)
    gusts = np.stack(list(ALL["turbulence"].act(seen, 2.0).values()))
    assert gusts.std(axis=1) == pytest.approx([2.0] * 3, rel=0.05)
    assert np.abs(np.corrcoef(gusts) - np.eye(3)).max() < 0.1
    for lag in (2, 10, 20):  # Dryden's autocorrelation: exp(-lag / 5 s)
        alike = (gusts[:, lag:] * gusts[:, :-lag]).mean() / (gusts**2).mean()
        assert alike == pytest.approx(np.exp(-0.5 * lag / 5.0), abs=0.05)


def test_shear_is_nothing_at_100_m_and_turns_round_below() -> None:
    act = ALL["wind_shear"].act
    assert act(flow(100.0), 3.0, -4.0) == {"w_n": 0.0, "w_e": 0.0}
    assert act(flow(250.0), 2.0, -4.0) == {"w_n": 3.0, "w_e": -6.0}
    assert act(flow(50.0), 2.0, -4.0) == {"w_n": -1.0, "w_e": 2.0}


def test_rising_air_blows_against_down() -> None:
    assert ALL["updraft"].act(flow(), 2.0) == {"w_d": -2.0}


# --- forces and moments ----------------------------------------------------------------------------------------------


def test_the_engine_turns_with_its_throttle_and_the_propeller_pulls_with_thrust_and_diameter() -> None:
    torque, oblique, beside = ALL["prop_torque"].act, ALL["p_factor"].act, ALL["thrust_asymmetry"].act
    assert torque(flow(delta_t=0.5, T=0.0), 0.1)["L"] == pytest.approx(0.19 * 0.5 * 0.25 * 900.0 * 9.80665)
    assert torque(flow(delta_t=0.0, T=1000.0), 0.1)["L"] == 0.0
    assert oblique(flow(T=1000.0, alpha=0.1, beta=0.02), 0.5) == pytest.approx({"N": 95.0, "M": -19.0})
    assert beside(flow(T=1000.0), 0.1) == {"N": 100.0}


def test_the_tail_does_more_in_the_slipstream_and_windmilling_takes_at_most_half() -> None:
    act, disc = ALL["slipstream_tail"].act, np.pi * 1.9**2 / 4.0
    blown = act(flow(T=900.0 * disc, q_bar=900.0, C_m_elevator=-0.05, C_n_rudder=0.02), 0.5)
    assert blown == pytest.approx({"C_m": -0.025, "C_n": 0.01})
    assert act(flow(T=-1e6, q_bar=900.0, C_m_elevator=-0.05), 1.0)["C_m"] == pytest.approx(0.025)
    assert np.isfinite(act(flow(T=1000.0, q_bar=0.0, C_m_elevator=-0.05), 1.0)["C_m"])


def test_damping_follows_its_own_rate_made_dimensionless_by_span_or_chord() -> None:
    moving = flow(Va=50.0, p=0.5, q=0.3, r=0.2)
    assert ALL["roll_damping"].act(moving, 0.2) == pytest.approx({"C_l": 0.2 * 0.5 * CARD.b / 100.0, "C_l_p": 0.2})
    assert ALL["pitch_damping"].act(moving, -4.0) == pytest.approx({"C_m": -4.0 * 0.3 * CARD.c / 100.0})
    assert ALL["yaw_damping"].act(moving, 0.05) == pytest.approx({"C_n": 0.05 * 0.2 * CARD.b / 100.0})


def test_a_battery_loses_with_what_was_used() -> None:
    assert ALL["battery_sag"].act(flow(throttle_time=50.0), 0.2) == pytest.approx({"thrust": -0.1})


@pytest.mark.parametrize(("of", "over"), [("8 deg", 5.0), ("10 deg", 3.0), ("12 deg", 1.0), ("14 deg", 0.0)])
def test_a_stall_begins_at_its_break(of: str, over: float) -> None:
    said = ALL["stall"].act(flow(alpha=np.radians(13.0)), 4.0, 1.0, of=of)
    assert said == pytest.approx({"C_L": -4.0 * np.radians(over), "C_D": np.radians(over)})


def test_the_ground_is_felt_within_a_span_and_takes_no_more_than_induced_drag() -> None:
    act = ALL["ground_effect"].act
    low, half, high = (act(flow(height, C_L=0.8), 0.2, 1.0, 0.0) for height in (0.0, 5.5, 22.0))
    assert low["lift"] > 3.0 * half["lift"] > 30.0 * high["lift"] > 0.0
    assert 0.0 < -low["C_D"] < 0.8**2 / (np.pi * 0.8 * 11.0**2 / 16.0)
    assert act(flow(-5.0, C_L=0.8), 0.2, 1.0, 0.0) == low  # a field that lies lower than the start


def test_ice_a_flap_weak_thrust_and_weight_have_their_signs() -> None:
    assert ALL["icing"].act(flow(), 0.1, 0.02, 0.01) == {"lift": -0.1, "C_D": 0.02, "C_m": 0.01}
    assert ALL["flap_deployed"].act(flow(), 0.2, 0.02, -0.03) == {"C_L": 0.2, "C_D": 0.02, "C_m": -0.03}
    assert ALL["thrust_loss"].act(flow(), 0.3) == {"thrust": -0.3}
    assert ALL["air_density"].act(flow(), -0.1) == {"rho": -0.1}
    assert ALL["mass_change"].act(flow(), 0.1) == {"mass": 0.1}
    assert ALL["cg_shift"].act(flow(), 0.05) == {"x_cg": 0.05}
    assert ALL["cg_shift_side"].act(flow(), 0.05) == {"y_cg": 0.05}


# --- sensors ---------------------------------------------------------------------------------------------------------


def test_late_readings_are_those_of_then() -> None:
    t = DT * np.arange(200)
    true = {"t": t, "v_n": 3.0 * t, "v_e": -t, "v_d": np.zeros(200), "h": 2.0 * t}
    said = ALL["gps_latency"].act(true, 0.3)
    assert said["v_n"][20:] == pytest.approx(3.0 * (t[20:] - 0.3)) and said["h"][20:] == pytest.approx(2 * t[20:] - 0.6)


def test_a_unit_mounted_askew_reads_both_vectors_in_its_own_axes() -> None:
    rng = np.random.default_rng(5)
    true = {name: rng.standard_normal(50) for name in ("p", "q", "r", "a_x", "a_y", "a_z")}
    turn = (0.05, -0.3, 0.2)
    said = ALL["imu_misalignment"].act(true, *turn)
    for names in (("p", "q", "r"), ("a_x", "a_y", "a_z")):
        expected = Rotation.from_rotvec(turn).inv().apply(np.stack([true[n] for n in names], 1))
        assert np.stack([said[n] for n in names], 1) == pytest.approx(expected, abs=1e-12)
    level = ALL["imu_misalignment"].act(dict.fromkeys(true, np.zeros(1)) | {"a_z": np.array([-9.81])}, 0.0, 0.1, 0.0)
    assert level["a_x"][0] == pytest.approx(9.81 * np.sin(0.1))  # its nose up, it feels the support forward


@pytest.mark.parametrize(
    ("name", "of", "reading"),
    [
        ("gyro_bias", {"of": "q"}, "q"),
        ("accel_bias", {"of": "z"}, "a_z"),
        ("airspeed_bias", {}, "Va"),
        ("heading_bias", {}, "psi"),
        ("baro_bias", {}, "baro"),
    ],
)
def test_a_bias_is_added_to_its_own_reading(name: str, of: dict[str, str], reading: str) -> None:
    assert ALL[name].act({reading: 1.5}, 0.25, **of) == {reading: 1.75}


# --- told ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "par", "expected"),
    [
        ("wind_shear", (0.0, -4.0), {"mps_per_100m": 4.0, "from_deg": 90.0}),
        ("gust_discrete", (3.0, 0.0), {"speed_mps": 3.0, "from_deg": 180.0}),
        ("air_density", (-0.12,), {"density_ratio": 0.88}),
        ("actuator_rate_limit", (2.0,), {"rate_per_s": 0.5}),
        ("mass_change", (-0.05,), {"dmass_kg": -45.6}),
        ("gyro_bias", (np.pi / 180,), {"bias_dps": 1.0}),
        ("heading_bias", (-np.pi / 18,), {"bias_deg": -10.0}),
        ("imu_misalignment", (0.0, np.pi / 90, 0.0), {"roll_deg": 0.0, "pitch_deg": 2.0, "yaw_deg": 0.0}),
    ],
)
def test_told_numbers_are_right(name: str, par: tuple[float, ...], expected: dict[str, float]) -> None:
    assert ALL[name].reported(ALL[name], np.array(par), Body(mass=912.0)) == pytest.approx(expected)
