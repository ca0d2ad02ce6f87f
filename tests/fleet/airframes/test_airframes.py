"""Airframes: every file that comes with ParaUAV is one, its signs are physics, and what is none says what to mend."""

from pathlib import Path

import numpy as np
import pytest

from fleet import airframes
from fleet.airframes import GENERIC, derivatives, load
from fleet.airframes.airframe import servo_map
from fleet.contract import Params
from fleet.physics.wrench import NAMES, OFFSETS, WIND
from twin_worker.diagnosis.data.card import read_card
from twin_worker.twin.state.state import Twin, ingest

FILES = sorted(path.stem for path in Path(airframes.__file__).parent.glob("*.toml"))
GOOD = (Path(airframes.__file__).parent / f"{GENERIC}.toml").read_text()


def changed(tmp_path: Path, old: str, new: str) -> str:
    """A copy of the generic airframe with one line another."""
    assert GOOD.count(old) == 1, old
    path = tmp_path / "mine.toml"
    path.write_text(GOOD.replace(old, new))
    return str(path)


def test_there_are_some():
    assert {GENERIC, "aerosonde"} <= set(FILES)


@pytest.mark.parametrize("name", FILES)
def test_every_file_is_a_whole_airframe_with_its_source(name):
    found = load(name)
    assert found.name and found.source
    left_out = {NAMES[k] for k in (*OFFSETS, WIND, WIND + 1)}
    assert set(derivatives(found, 20.0)) == set(NAMES) - left_out


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("speed", [12.0, 22.0, 40.0])
def test_signs_are_physics(name, speed):
    d = derivatives(load(name), speed)
    pushes = {
        "elevator up pitches up": d["M_de"],
        "aileron right rolls right": d["L_da"],
        "rudder right yaws right": d["N_dr"],
        "throttle pushes": d["X_dt"],
        "weathercock: wind from the right yaws right": d["N_v"],
        "induced drag and lift tilt forward": d["X_w"],
    }
    holds_back = {
        "drag grows with speed": d["X_u"],
        "lift answers sinking": d["Z_w"],
        "nose-up is opposed": d["M_w"],
        "side-slip is opposed": d["Y_v"],
        "dihedral": d["L_v"],
        "pitch damping": d["M_q"],
        "roll damping": d["L_p"],
        "yaw damping": d["N_r"],
    }
    assert all(value > 0 for value in pushes.values()), pushes
    assert all(value < 0 for value in holds_back.values()), holds_back


@pytest.mark.parametrize("name", FILES)
def test_forces_grow_with_speed_and_controls_with_its_square(name):
    slow, fast = (derivatives(load(name), speed) for speed in (20.0, 40.0))
    for one in ("M_de", "L_da", "N_dr", "Y_dr"):
        assert fast[one] == pytest.approx(4 * slow[one])
    for one in ("M_q", "L_p", "N_r", "M_w", "L_v", "N_v", "Y_v"):
        assert fast[one] == pytest.approx(2 * slow[one])


def test_a_derivative_by_hand():
    d = derivatives(load(GENERIC), 30.0)
    pressure = 0.5 * 1.225 * 30.0**2 * 0.55
    assert d["M_de"] == pytest.approx(pressure * 0.18994 / 1.135 * -0.5 * -0.4)
    assert d["M_q"] == pytest.approx(pressure * 0.18994 / 1.135 * -3.6 * 0.18994 / 60.0)
    drag = pressure * 0.0437 + 0.0230 * (13.5 * 9.80665) ** 2 / pressure
    assert d["X_u"] == pytest.approx(-4.5 * drag / 13.5 / 30.0, rel=1e-3)
    gamma = 0.8244 * 1.759 - 0.1204**2
    assert d["L_p"] == pytest.approx(pressure * 2.8956**2 / 60.0 * (1.759 * -0.26 + 0.1204 * 0.022) / gamma)
    assert d["N_r"] == pytest.approx(pressure * 2.8956**2 / 60.0 * (0.1204 * 0.14 + 0.8244 * -0.35) / gamma)


WRONG = (
    ("mass = 13.5 ", "mass = 0 ", "mass = 0, expected more than 0"),
    ("mass = 13.5 ", "mass = -1.0 ", "mass = -1, expected more than 0"),
    ("mass = 13.5 ", "mass = nan ", "mass = nan, expected a number"),
    ("mass = 13.5 ", "mass = inf ", "mass = inf, expected a number"),
    ("mass = 13.5 ", "mass = true ", "mass = True, expected a number"),
    ("mass = 13.5 ", 'mass = "heavy" ', "mass = 'heavy', expected a number"),
    ("mass = 13.5 ", "mass_kg = 13.5 ", "mass = None, expected a number"),
    ("doubt = 1.0 ", "doubt = 0.0 ", "doubt = 0, expected more than 0"),
    ("J_xz = 0.1204 ", "J_xz = 9.0 ", "J_xz = 9, expected less than sqrt"),
    ("delta_e = -0.4", "delta_x = -0.4", "delta_e = None, expected a number"),
    ("[throw]", "[thrown]", "delta_a = None, expected a number"),
    ("[coefficients]", "[coefficient]", "C_L_0 = None, expected a number"),
    ("C_m_q = -3.6", "C_m_q = []", r"C_m_q = \[\], expected a number"),
    ("mass = 13.5 ", "mass = = ", "invalid TOML"),
)


@pytest.mark.parametrize(("old", "new", "said"), WRONG, ids=[said.split(",")[0] for *_, said in WRONG])
def test_a_wrong_field_is_named_in_one_sentence(tmp_path, old, new, said):
    with pytest.raises(ValueError, match=rf"^mine\.toml: found .*{said}.*; correct it$"):
        load(changed(tmp_path, old, new))


def test_throws_of_another_sign_are_taken_as_they_are(tmp_path):
    turned = load(changed(tmp_path, "delta_e = -0.4", "delta_e = 0.4"))
    assert derivatives(turned, 20.0)["M_de"] == -derivatives(load(GENERIC), 20.0)["M_de"]


@pytest.mark.parametrize("which", ["spitfire", "no/such/file.toml", "../airframes/aerosonde"])
def test_an_airframe_that_is_not_there_is_named_with_those_that_are(which):
    with pytest.raises(OSError, match=r"found no airframe, expected .*aerosonde.*small_fixed_wing; check"):
        load(which)


def test_bytes_that_are_no_text_are_no_airframe(tmp_path):
    path = tmp_path / "noise.toml"
    path.write_bytes(bytes(range(128, 256)))
    with pytest.raises(ValueError, match="invalid TOML"):
        load(str(path))
    with pytest.raises(OSError):
        load(str(tmp_path))


SERVOS = """
[[servo]]
surface = "aileron"
output = 9
sign = -1
min = 1000
trim = 1450
max = 1900
[[servo]]
surface = "elevator"
output = 2
[[servo]]
surface = "throttle_left"
output = 3
[[servo]]
surface = "throttle_right"
output = 10
"""


def with_servos(tmp_path: Path, text: str = SERVOS) -> str:
    path = tmp_path / "mine.toml"
    path.write_text(GOOD + text)
    return str(path)


def test_a_file_may_give_the_servo_map(tmp_path):
    servos = servo_map(load(with_servos(tmp_path)).servo_params)
    row = np.zeros((1, 16))
    row[0, [8, 1, 2, 9]] = 1900, 1300, 1100, 1900
    assert servos.sentence == ""
    assert servos.inputs(row)[0].round(9).tolist() == [-1.0, -0.5, 0.0, 0.5]
    assert load(GENERIC).servo_params == {}


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('"aileron"', '"flap"', "found servo surface = 'flap', expected one of aileron, elevator"),
        ("output = 9", "output = 17", "found output = 17 of aileron, expected 1 to 16"),
        ("output = 9", "output = 2", "found output 2 twice"),
        ("sign = -1", "sign = 0", "found sign = 0 of aileron, expected 1 or -1"),
        ("trim = 1450", "trim = 1950", "found min = 1000, trim = 1950, max = 1900 of aileron, expected rising"),
        ("trim = 1450", "trim = nan", "expected rising"),
        ("max = 1900", 'max = "high"', "found max = 'high' of aileron, expected a pulse width"),
    ],
)
def test_a_wrong_servo_is_named(tmp_path, old, new, match):
    with pytest.raises(ValueError, match=match):
        load(with_servos(tmp_path, SERVOS.replace(old, new, 1)))


def test_the_map_of_the_file_replaces_parameters_and_learning(tmp_path):
    airframe = load(with_servos(tmp_path))
    twin, own = Twin.of(1, airframe=airframe), servo_map(airframe.servo_params)
    assert twin.telemetry.servo_map.equals(own)
    ingest(twin, Params(uav=1, t=1e9, values={"SERVO1_FUNCTION": 4.0, "SERVO2_FUNCTION": 19.0}))
    twin.telemetry.learn_servo_map()
    assert twin.telemetry.servo_map.equals(own)
    card = read_card(Path(with_servos(tmp_path)))
    pulses = np.full((1, 16), 1700.0)
    np.testing.assert_array_equal(card.commands(pulses, {"SERVO1_FUNCTION": 4.0}), own.inputs(pulses))
