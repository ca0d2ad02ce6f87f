"""Faults of pretend aircraft: servos, sensors, and JSBSim's own account of every change of physics."""

from math import cos, degrees, exp, inf, radians, sin
from pathlib import Path

import numpy as np
import pytest

from fleet.cli import main
from fleet.simulator.conceal.effects import SERVO_LAG_S, reported_values
from fleet.simulator.conceal.paths import EXAM_HOME, baseline_type
from fleet.simulator.faults.carried import SENSOR_FAULTS, FaultSet
from fleet.simulator.faults.kinds import KINDS, parse_fault
from fleet.simulator.faults.physics import Fault
from fleet.simulator.faults.servos import SERVO_FAULTS
from fleet.simulator.vehicle.altered import instrumented_type
from fleet.simulator.vehicle.jsbsim import DT, KG_TO_LB, Aircraft
from fleet.simulator.vehicle.sensors import Estimate, pressure_at, pressure_height
from fleet.simulator.vehicle.types import TYPES

ALOFT = np.array([0.0, 0.0, -150.0])
INCH, FT = 0.0254, 0.3048


def flying(airframe: str, still: bool = True) -> Aircraft:
    kind = baseline_type(airframe) if still else instrumented_type(airframe)
    aircraft = Aircraft(EXAM_HOME, 3, kind=kind)
    _, delta_e, delta_t = aircraft.start(ALOFT, 0.4, kind.cruise, (0.0, 0.0))
    aircraft.set_controls(0.0, delta_e, 0.0, delta_t)
    for _ in range(50):
        aircraft.step()
    return aircraft


def pressed(aircraft: Aircraft, name: str, **values: float) -> np.ndarray:
    """What a whole fault changes at once: moments over inertia [rad/s2], specific force [m/s2]."""
    before = aircraft.evaluate_accelerations()
    FaultSet([Fault(name, "", values)], aircraft).apply_to_physics(1.0)
    return np.asarray(aircraft.evaluate_accelerations() - before)


def loads(aircraft: Aircraft) -> tuple[float, float]:
    """Dynamic pressure times wing area [N], mass [kg]."""
    x = aircraft.truth()
    return 0.5 * x.rho * x.Va**2 * aircraft["metrics/Sw-sqft"] * FT**2, aircraft["inertia/weight-lbs"] / KG_TO_LB


def along_wind(aircraft: Aircraft, force: np.ndarray) -> tuple[float, float]:
    """Drag and lift of a force given in body axes."""
    alpha = aircraft.truth().alpha
    return -force[0] * cos(alpha) - force[2] * sin(alpha), force[0] * sin(alpha) - force[2] * cos(alpha)


# --- when ------------------------------------------------------------------------------------------------------------


def test_a_fault_steps_grows_or_passes() -> None:
    step, ramp = Fault("x", "", {}, 10.0), Fault("x", "", {}, 10.0, 20.0)
    gust, held = Fault("x", "", {}, 10.0, 0.0, 30.0), Fault("x", "", {}, 10.0, 4.0, 30.0)
    assert [step.intensity(t) for t in (9.99, 10.0, 1e6)] == [0, 1, 1]
    assert [ramp.intensity(t) for t in (9.0, 15.0, 30.0, 99.0)] == [0, 0.25, 1, 1]
    assert [round(gust.intensity(t), 6) for t in (10.0, 15.0, 20.0, 25.0, 30.0)] == [0, 0.5, 1, 0.5, 0]
    assert [round(held.intensity(t), 6) for t in (12.0, 14.0, 26.0, 28.0)] == [0.5, 1, 1, 0.5]


# --- servos ----------------------------------------------------------------------------------------------------------


def moved(name: str, commands: np.ndarray, share: float = 1.0, **values: float) -> np.ndarray:
    move = SERVO_FAULTS[name](values, DT)
    return np.array([move(float(u), share) for u in commands])


STEP = np.concatenate([np.zeros(10), np.full(90, 0.4)])


def test_servo_faults_do_what_they_say() -> None:
    lag = moved("actuator_lag", STEP, tau_s=0.2)
    assert lag[10 + 19] == pytest.approx(0.4 * (1 - exp(-1)), rel=0.01)
    delay = moved("actuator_delay", STEP, delay_s=0.25)
    assert np.argmax(delay > 0) == 10 + 25 and delay[-1] == 0.4
    rate = moved("actuator_rate_limit", STEP, rate_per_s=0.5)
    assert np.diff(rate).max() == pytest.approx(0.5 * DT) and rate[-1] == pytest.approx(0.4)
    wave = 0.3 * np.sin(np.arange(400) * 0.05)
    play = moved("actuator_deadband", wave, half_width=0.1)
    assert np.abs(play - wave).max() == pytest.approx(0.1) and play.max() == pytest.approx(0.2, abs=1e-3)
    assert moved("actuator_saturation", wave, limit=0.15).max() == pytest.approx(0.15)
    assert moved("actuator_offset", wave, offset=-0.1) == pytest.approx(wave - 0.1)
    assert moved("control_effectiveness_loss", wave, loss=0.4) == pytest.approx(0.6 * wave)
    assert moved("actuator_stuck", wave, position=0.07) == pytest.approx(0.07)
    assert moved("actuator_stuck", wave[30:]) == pytest.approx(wave[30])  # where it happens to be


@pytest.mark.parametrize("name", SERVO_FAULTS)
def test_servos_are_healthy_before(name: str) -> None:
    values = {"tau_s": 0.2, "delay_s": 0.2, "rate_per_s": 0.1, "half_width": 0.1, "limit": 0.1, "offset": 0.1}
    assert moved(name, STEP, 0.0, **values, loss=0.5) == pytest.approx(STEP)


# --- sensors ---------------------------------------------------------------------------------------------------------

GOOD = Estimate(
    *(np.array([10.0, 20.0, -150.0]), np.array([20.0, 5.0, 1.0]), np.array([0.1, 0.05, 2.0])),
    *(np.array([0.2, 0.1, -0.1]), np.array([0.5, 0.2, -9.8]), 23.0),
    *(pressure_at(155.0), 300.0, 151.0),
)


def spoilt(name: str, of: str = "", share: float = 1.0, **values: float) -> Estimate:
    return SENSOR_FAULTS[name](Fault(name, of, values), 2 * DT)(GOOD, share)


def test_sensor_faults_do_what_they_say() -> None:
    assert spoilt("airspeed_scale", scale=0.88).Va == pytest.approx(0.88 * 23)
    assert spoilt("airspeed_bias", bias_mps=-2.0).Va == 21.0
    assert np.degrees(spoilt("gyro_bias", "q", bias_dps=2.0).rates - GOOD.rates) == pytest.approx([0, 2, 0])
    assert spoilt("accel_bias", "z", bias_mps2=0.5).force - GOOD.force == pytest.approx([0, 0, 0.5])
    assert degrees(spoilt("heading_bias", bias_deg=9.0).euler[2] - 2.0) == pytest.approx(9.0)
    low = spoilt("baro_bias", bias_m=-12.0)
    assert pressure_height(low.pressure) == pytest.approx(143.0) and low.p[2] == pytest.approx(-138.0)
    assert low.gps_height == GOOD.gps_height


def test_a_unit_turned_to_the_right_feels_weight_on_its_left() -> None:
    """Rolled right by phi its y axis points down by phi: of (0, 0, -g) it feels -g sin phi along y."""
    seen = spoilt("imu_misalignment", roll_deg=5.0)
    assert seen.force[1] == pytest.approx(0.2 * cos(radians(5)) - 9.8 * sin(radians(5)))
    assert np.linalg.norm(seen.rates) == pytest.approx(np.linalg.norm(GOOD.rates))
    pitched = spoilt("imu_misalignment", pitch_deg=3.0)  # its x axis points up: it feels weight's counterforce forward
    assert pitched.force[0] == pytest.approx(0.5 * cos(radians(3)) + 9.8 * sin(radians(3)))


def test_late_satellites_tell_the_past() -> None:
    spoil = SENSOR_FAULTS["gps_latency"](Fault("gps_latency", "", {"latency_s": 0.3}), 0.02)
    told_v = [spoil(GOOD._replace(v=np.full(3, float(k))), 1.0).v[0] for k in range(40)]
    assert told_v[39] == 39 - 15


# --- physics ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("airframe", ["small", "c172p"])
def test_knobs_alone_change_nothing(airframe: str) -> None:
    stock = Aircraft(EXAM_HOME, 3, kind=TYPES[airframe])
    stock.start(ALOFT, 0.4, TYPES[airframe].cruise, (0.0, 0.0))
    knobbed = flying(airframe, still=False)
    for _ in range(50):
        stock.step()
    assert np.array_equal(np.concatenate(stock.truth()[:4]), np.concatenate(knobbed.truth()[:4]))


@pytest.mark.parametrize("airframe", ["small", "c172p"])
def test_drag_and_lift_are_as_labelled(airframe: str) -> None:
    aircraft = flying(airframe)
    qS, m = loads(aircraft)
    drag, lift = along_wind(aircraft, pressed(aircraft, "drag_increase", dCD=0.03)[3:])
    assert drag * m / qS == pytest.approx(0.03, rel=0.01) and abs(lift * m / qS) < 3e-4
    fresh = flying(airframe)
    clean = fresh["forces/fwz-aero-lbs"]
    drag, lift = along_wind(fresh, pressed(fresh, "icing", lift_loss=0.12, dCD=0.02)[3:])
    assert drag * m / qS == pytest.approx(0.02, rel=0.02)
    assert fresh["forces/fwz-aero-lbs"] / clean == pytest.approx(0.88, rel=1e-3)


@pytest.mark.parametrize(("airframe", "dm", "dx"), [("small", -1.2, 0.015), ("c172p", 80.0, -0.07)])
def test_mass_and_its_centre_are_as_labelled(airframe: str, dm: float, dx: float) -> None:
    aircraft = flying(airframe)
    m, x = aircraft["inertia/weight-lbs"], aircraft["inertia/cg-x-in"]
    pressed(aircraft, "mass_change", dmass_kg=dm)
    assert (aircraft["inertia/weight-lbs"] - m) / KG_TO_LB == pytest.approx(dm, rel=1e-3)
    assert aircraft["inertia/cg-x-in"] == pytest.approx(x, abs=1e-3)
    aircraft = flying(airframe)
    pressed(aircraft, "cg_shift", dx_m=dx)
    assert -(aircraft["inertia/cg-x-in"] - x) * INCH == pytest.approx(dx, rel=1e-3)  # JSBSim's x points aft


def test_a_centre_of_gravity_moved_forward_pitches_down() -> None:
    assert pressed(flying("small"), "cg_shift", dx_m=0.02)[1] < -0.5


@pytest.mark.parametrize("airframe", ["small", "c172p"])
def test_forces_are_measured_where_the_mass_is(airframe: str) -> None:
    aircraft = flying(airframe)
    assert aircraft.truth().force == pytest.approx(aircraft.evaluate_accelerations()[3:], abs=0.02)


@pytest.mark.parametrize("airframe", ["small", "c172p"])
@pytest.mark.parametrize(("name", "key", "change"), [("roll_damping", "dC_l_p", 0.2), ("pitch_damping", "dC_m_q", 5.0)])
def test_damping_changes_by_the_derivative_labelled(airframe: str, name: str, key: str, change: float) -> None:
    """The moment changes by q_bar S dC rate length^2 / 2 Va."""
    aircraft = flying(airframe)
    for _ in range(40):
        aircraft.set_controls(0.3, 0.3, 0.0, 0.6)
        aircraft.step()
    i, length, inertia = {"dC_l_p": (0, "bw", "ixx"), "dC_m_q": (1, "cbarw", "iyy")}[key]
    x, span = aircraft.truth(), aircraft[f"metrics/{length}-ft"] * FT
    assert abs(x.rates[i]) > 0.02
    moment = pressed(aircraft, name, **{key: change})[i] * aircraft[f"inertia/{inertia}-slugs_ft2"] * 1.3558
    assert moment == pytest.approx(loads(aircraft)[0] * change * x.rates[i] * span**2 / (2.0 * x.Va), rel=0.06)


def test_a_blocked_static_line_lags_and_an_accelerometer_scales() -> None:
    spoil = SENSOR_FAULTS["_static_line_lag"](Fault("_static_line_lag", "", {"tau_s": 5.0}), 0.02)
    true = [100.0 + 0.06 * k for k in range(2000)]
    height = [pressure_height(spoil(GOOD._replace(pressure=pressure_at(h)), 1.0).pressure) for h in true]
    assert true[-1] - height[-1] == pytest.approx(3.0 * 5.0, rel=0.02)  # climbing with 3 m/s
    assert spoilt("_accelerometer_scale", scale=0.1).force == pytest.approx(1.1 * GOOD.force)


def test_the_small_engine_loses_the_share_it_is_told_to() -> None:
    aircraft = flying("small")
    before = aircraft["external/thrust-n"]
    pressed(aircraft, "thrust_loss", fraction=0.25)
    assert aircraft["external/thrust-n"] / before == pytest.approx(0.75, rel=1e-3)


def test_thin_air_is_thin_by_the_share_asked_for() -> None:
    aircraft = flying("c172p")
    before = aircraft.truth().rho
    pressed(aircraft, "air_density", density_ratio=0.88)
    assert aircraft.truth().rho / before == pytest.approx(0.88, abs=0.004)


def test_the_propeller_rolls_left_yaws_left_and_wets_the_tail() -> None:
    """A propeller that turns right as the pilot sees it, at a positive angle of attack."""
    aircraft = flying("c172p")
    thrust, alpha = aircraft["propulsion/engine/thrust-lbs"], aircraft.truth().alpha
    yaw = pressed(aircraft, "p_factor", inches_per_rad=100.0)[2]
    assert yaw == pytest.approx(-thrust * 100 / 12 * alpha / aircraft["inertia/izz-slugs_ft2"], rel=0.03)
    aircraft = flying("c172p")
    torque = pressed(aircraft, "prop_torque", sense=1.0)[0] * aircraft["inertia/ixx-slugs_ft2"]
    assert torque == pytest.approx(aircraft["propulsion/engine/propeller-torque-ftlb"], rel=0.05) and torque < 0
    aircraft = flying("c172p")
    dry = aircraft["aero/coefficient/Cmde"]
    pressed(aircraft, "slipstream_tail", share=1.0)
    wet = aircraft["aero/function/qbar-induced-psf"] / aircraft["aero/qbar-psf"]
    assert wet > 1.05 and aircraft["aero/coefficient/Cmde"] / dry == pytest.approx(wet, rel=0.01)


@pytest.mark.parametrize(
    ("text", "height", "wind"),
    [
        ("wind_steady,speed_mps=5,from_deg=0", 100.0, (-5.0, 0.0, 0.0)),
        ("wind_steady,speed_mps=5,from_deg=270", 100.0, (0.0, 5.0, 0.0)),
        ("wind_shear,mps_per_100m=4,from_deg=90", 150.0, (0.0, -2.0, 0.0)),
        ("updraft,speed_mps=3,at=0,for=20", 100.0, (0.0, 0.0, -3.0)),
    ],
)
def test_winds_blow_from_where_they_say(text: str, height: float, wind: tuple[float, float, float]) -> None:
    world = FaultSet([parse_fault(text, "c172p")], flying("c172p"))
    assert world.wind(10.0, height) == pytest.approx(wind)


def test_a_label_tells_the_whole_servo() -> None:
    assert reported_values("actuator_lag", "small", {"tau_s": 0.2}) == {"tau_s": 0.2 + SERVO_LAG_S["small"]}
    small = Path("fleet/simulator/vehicle/aircraft/aerosonde/aerosonde.xml").read_text()
    assert f"<lag>{1 / SERVO_LAG_S['small']:.0f}</lag>" in small
    assert reported_values("actuator_lag", "c172p", {"tau_s": 0.2}) == {"tau_s": 0.2}


# --- the command line ------------------------------------------------------------------------------------------------


def test_a_fault_is_read_as_written() -> None:
    fault = parse_fault("actuator_lag:elevator,tau_s=0.3,at=120,ramp=5", "small")
    assert fault == Fault("actuator_lag", "elevator", {"tau_s": 0.3}, 120.0, 5.0, inf)
    assert parse_fault("gust_discrete,speed_mps=5,from_deg=90,at=20,for=12", "small").t1 == 32.0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("nonsense", "found 'nonsense', expected one of actuator_lag"),
        ("_loose_hinge,hertz=1", "found '_loose_hinge'"),
        ("actuator_lag,tau_s=1", "expected one of aileron, elevator, rudder after a colon"),
        ("drag_increase:wing,dCD=0.1", "expected nothing after its name"),
        ("actuator_lag:elevator", "found no tau_s"),
        ("drag_increase,dCD=much", "found dCD=much, expected a number"),
        ("drag_increase,dCD=nan", "found dCD=nan, expected a number"),
        ("drag_increase,dCD=0.1,at=-3", "found at=-3"),
        ("drag_increase,dCD=0.1,for=3", "found 'for'"),
        ("drag_increase,dCD=9", "expected a number -0.02..0.2"),
        ("updraft,speed_mps=3", "found no for"),
        ("flap_deployed,flap_deg=10", "found aircraft 'small', expected c172p"),
    ],
)
def test_a_wrong_fault_is_refused_in_a_sentence(text: str, said: str, capsys: pytest.CaptureFixture) -> None:
    for verb in (["fly", "--for", "1"], ["up", "--uavs", "1", "--no-viewer"]):
        assert main([*verb, "--fault", text]) == 2
        assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--fault-uav", "1"], "add --fault"),
        (["--fault-uav", "9", "--fault", "drag_increase,dCD=0.03"], "expected one of 0-1"),
    ],
)
def test_the_faulty_one_must_fly(words: list[str], said: str, capsys: pytest.CaptureFixture) -> None:
    assert main(["fly", "--uavs", "0-1", "--for", "1", *words]) == 2
    assert said in capsys.readouterr().err


def test_real_aircraft_carry_their_own_faults(capsys: pytest.CaptureFixture) -> None:
    assert main(["up", "--link", "udpin:0.0.0.0:14999", "--fault", "drag_increase,dCD=0.03"]) == 2
    assert "expected simulated aircraft" in capsys.readouterr().err


def test_one_of_two_flies_with_its_fault(tmp_path: Path) -> None:
    good, bad = tmp_path / "good.tlog", tmp_path / "bad.tlog"
    flown = ["fly", "--uavs", "0", "--for", "4", "--tlog"]
    assert main([*flown, str(good)]) == 0
    assert main([*flown, str(bad), "--fault", "airspeed_bias,bias_mps=3,at=2"]) == 0
    a, b = good.read_bytes(), bad.read_bytes()
    same = next(i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y)
    assert 0.4 < same / len(a) < 0.9  # alike until it begins


def test_every_kind_can_be_flown_by_one_type_at_least() -> None:
    assert all(kind.aircraft for kind in KINDS.values()) and len(KINDS) > 25
