"""Pulse widths to inputs: who moves what, which way, how far."""

import numpy as np
import pytest

from fleet.airframes.airframe import servo_map

PLANE = {"SERVO1_FUNCTION": 4, "SERVO2_FUNCTION": 19, "SERVO3_FUNCTION": 70, "SERVO4_FUNCTION": 21}
ELEVONS = {"SERVO1_FUNCTION": 77, "SERVO2_FUNCTION": 78, "SERVO3_FUNCTION": 70}


def inputs(params: dict[str, float], **pulses: float) -> list[float]:
    """Inputs delta_a, delta_e, delta_r, delta_t of one row; servos not named stand at 1500."""
    row = np.full((1, 8), 1500.0)
    for name, pulse in pulses.items():
        row[0, int(name[1:]) - 1] = pulse
    return servo_map(params).inputs(row)[0].round(9).tolist()


def test_full_throw_is_one_either_way():
    assert inputs(PLANE, s1=1900, s2=1100, s3=1100, s4=1700) == [1.0, -1.0, 0.5, 0.0]


def test_off_centre_trim_scales_each_side_by_itself():
    params = PLANE | {"SERVO2_MIN": 1000.0, "SERVO2_TRIM": 1400.0, "SERVO2_MAX": 2000.0, "SERVO3_MIN": 1500.0}
    assert inputs(params, s2=1400)[1] == 0.0
    assert inputs(params, s2=2000)[1] == 1.0
    assert inputs(params, s2=1000)[1] == -1.0
    assert inputs(params, s2=1700)[1] == 0.5


def test_reversed_servos():
    params = PLANE | {"SERVO1_REVERSED": 1.0}
    assert inputs(params, s1=1900)[0] == -1.0
    assert inputs(PLANE, s1=1900)[0] == 1.0


def test_throttle_runs_from_nothing_to_one():
    params = PLANE | {"SERVO3_MIN": 1000.0, "SERVO3_MAX": 2000.0, "SERVO3_TRIM": 1000.0}
    assert [inputs(params, s3=pulse)[3] for pulse in (1000, 1250, 2000)] == [0.0, 0.25, 1.0]
    assert inputs(params, s3=800)[3] == 0.0  # disarmed
    back = params | {"SERVO3_REVERSED": 1.0}
    assert [inputs(back, s3=pulse)[3] for pulse in (2000, 1750, 1000)] == [0.0, 0.25, 1.0]


def test_elevons_mix():
    calm = {"s3": 1100.0}
    assert inputs(ELEVONS, s1=1900, s2=1900, **calm) == [0.0, 1.0, 0.0, 0.0]  # both up: pitch
    assert inputs(ELEVONS, s1=1100, s2=1900, **calm) == [1.0, 0.0, 0.0, 0.0]  # left down, right up: roll right
    assert inputs(ELEVONS, s1=1500, s2=1900, **calm) == [0.5, 0.5, 0.0, 0.0]


def test_a_v_tail_mixes_pitch_and_yaw():
    tail = PLANE | {"SERVO2_FUNCTION": 79, "SERVO4_FUNCTION": 80}
    assert inputs(tail, s2=1900, s4=1900, s3=1100)[1:3] == [1.0, 0.0]
    assert inputs(tail, s2=1900, s4=1100, s3=1100)[1:3] == [0.0, 1.0]  # left = pitch + yaw, right = pitch - yaw
    px4 = {"PWM_MAIN_FUNC1": 201, "PWM_MAIN_FUNC2": 202, "CA_SV_CS0_TYPE": 7, "CA_SV_CS1_TYPE": 8}
    assert inputs(px4, s1=2000, s2=1000)[1:3] == [0.0, 1.0]
    assert inputs(px4, s1=2000, s2=2000)[1:3] == [1.0, 0.0]


def test_flaperons_are_ailerons_whose_flaps_cancel():
    flaperons = {"SERVO1_FUNCTION": 24, "SERVO2_FUNCTION": 25}
    assert inputs(flaperons, s1=1900, s2=1900)[0] == 1.0
    assert inputs(flaperons, s1=1700, s2=1300)[0] == 0.0  # 200 us of flap


def test_differential_thrust_is_its_mean():
    twin = PLANE | {"SERVO3_FUNCTION": 73, "SERVO5_FUNCTION": 74}
    assert inputs(twin, s3=1100, s5=1900)[3] == 0.5
    assert inputs(twin, s3=1900, s5=1900)[3] == 1.0


OLD = {f"RC{n}_REV": 1.0 for n in range(1, 9)} | {f"RC{n}_MIN": 1000.0 for n in range(1, 9)}
OLD |= {f"RC{n}_MAX": 2000.0 for n in range(1, 9)} | {f"RC{n}_TRIM": 1500.0 for n in range(1, 9)}


def old_mixer(a: float, b: float, signs: tuple[int, int]) -> tuple[float, float]:
    """The outputs of the two channels for pitch `a` and roll or yaw `b`, with a gain of 0.5."""
    return 1500 + 500 * signs[0] * 0.5 * (a - b), 1500 + 500 * signs[1] * 0.5 * (a + b)


def test_old_firmware_follows_its_channels():
    assert inputs(OLD | {"RC3_TRIM": 1000.0}, s1=2000, s2=1250, s3=1500, s4=1750) == [1.0, -0.5, 0.5, 0.5]
    assert inputs(OLD | {"RC1_REV": -1.0}, s1=2000, s3=1000)[0] == -1.0
    second = OLD | {"RC5_FUNCTION": 4.0}
    assert inputs(second, s1=2000, s5=1500, s3=1000)[0] == 0.5
    swapped = OLD | {"RCMAP_ROLL": 2.0, "RCMAP_PITCH": 1.0}
    assert inputs(swapped, s1=2000, s3=1000)[:2] == [0.0, 1.0]
    assert servo_map(OLD).sentence == ""


@pytest.mark.parametrize(("value", "signs"), [(1, (1, 1)), (2, (1, -1)), (3, (-1, 1)), (4, (-1, -1))])
@pytest.mark.parametrize(("a", "b"), [(1.0, 0.0), (0.0, 1.0), (0.4, -0.6)])
def test_old_elevons_and_v_tails_are_unmixed(value: int, signs: tuple[int, int], a: float, b: float):
    pitch, other = old_mixer(a, b, signs)
    elevons = inputs(OLD | {"ELEVON_OUTPUT": float(value)}, s2=pitch, s1=other, s3=1000)
    assert elevons == pytest.approx([b / 2, a / 2, 0.0, 0.0])  # as later firmware: half of each at a gain of 0.5
    tail = inputs(OLD | {"VTAIL_OUTPUT": float(value)}, s2=pitch, s4=other, s3=1000)
    assert tail == pytest.approx([0.0, a / 2, b / 2, 0.0])


@pytest.mark.parametrize("reversed_pitch", [1.0, -1.0])
@pytest.mark.parametrize("reversed_other", [1.0, -1.0])
def test_reversed_channels_of_old_elevons(reversed_pitch: float, reversed_other: float):
    pitch, other = old_mixer(0.4 * reversed_pitch, -0.6 * reversed_other, (1, 1))
    params = OLD | {"ELEVON_OUTPUT": 1.0, "RC2_REV": reversed_pitch, "RC1_REV": reversed_other}
    assert inputs(params, s2=pitch, s1=other, s3=1000) == pytest.approx([-0.3, 0.2, 0.0, 0.0])


def test_two_ailerons_share_one_input():
    params = PLANE | {"SERVO5_FUNCTION": 4}
    assert inputs(params, s1=1900, s5=1900)[0] == 1.0
    assert inputs(params, s1=1900, s5=1500)[0] == 0.5


def test_without_functions_the_usual_order_is_assumed_and_said():
    assert "assumed" in servo_map({}).sentence
    assert inputs({}, s1=1900, s2=1100, s3=1500, s4=1700) == [1.0, -1.0, 0.5, 0.5]
    assert servo_map(PLANE).sentence == ""


def test_px4_says_the_same_in_other_words():
    outputs = {"PWM_MAIN_FUNC1": 201, "PWM_MAIN_FUNC2": 202, "PWM_MAIN_FUNC3": 101, "PWM_MAIN_FUNC4": 203}
    px4 = outputs | {"CA_SV_CS0_TYPE": 2, "CA_SV_CS1_TYPE": 3, "CA_SV_CS2_TYPE": 4, "PWM_MAIN_REV": 0b10}
    assert servo_map(px4).sentence == ""
    assert inputs(px4, s1=2000, s2=2000, s3=1250, s4=1250) == [1.0, -1.0, -0.5, 0.25]
    left = px4 | {"CA_SV_CS0_TYPE": 1}
    assert inputs(left, s1=2000, s3=1000)[0] == -1.0
    assert inputs(px4 | {"PWM_MAIN_MIN3": 1200.0}, s3=1600)[3] == 0.5
    elevons = px4 | {"CA_SV_CS0_TYPE": 5, "CA_SV_CS1_TYPE": 6, "PWM_MAIN_REV": 0}
    assert inputs(elevons, s1=1000, s2=2000, s3=1000)[:2] == [1.0, 0.0]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1e30, 0.0])
@pytest.mark.parametrize("name", ["SERVO1_FUNCTION", "SERVO1_MIN", "SERVO1_MAX", "SERVO1_TRIM", "SERVO1_REVERSED"])
def test_absurd_parameters_give_finite_inputs(name: str, value: float):
    got = servo_map(PLANE | {name: value}).inputs(np.linspace(900, 2100, 40).reshape(5, 8))
    assert np.isfinite(got).all()
    assert (np.abs(got) <= 1.2).all()


def test_absurd_pulses_stay_within_the_throw():
    got = servo_map(PLANE).inputs(np.array([[0.0] * 8, [65535.0] * 8]))
    assert np.abs(got).max() <= 1.2 and got[:, 3].min() >= 0.0


# --- outputs 9 to 16 -------------------------------------------------------------------------------------------------


def wide(params, width: int = 16, **servos: float) -> list[float]:
    """Inputs of one row of 16 outputs; those not named have no pulse."""
    row = np.zeros((1, width))
    for name, pulse in servos.items():
        row[0, int(name[1:]) - 1] = pulse
    return servo_map(params).inputs(row)[0].round(9).tolist()


def test_outputs_up_to_16_are_mapped():
    last = {"SERVO9_FUNCTION": 4, "SERVO10_FUNCTION": 79, "SERVO16_FUNCTION": 80, "SERVO13_FUNCTION": 70}
    last |= {"SERVO9_MIN": 1000.0, "SERVO9_MAX": 2000.0, "SERVO9_TRIM": 1400.0, "SERVO9_REVERSED": 1.0}
    assert wide(last, s9=1700, s10=1900, s16=1900, s13=1500) == [-0.5, 1.0, 0.0, 0.5]
    assert wide(last, s9=1400, s10=1900, s16=1100, s13=1100) == [0.0, 0.0, 1.0, 0.0]
    thrust = {"SERVO9_FUNCTION": 73, "SERVO12_FUNCTION": 74}
    assert wide(thrust, s9=1100, s12=1900)[3] == 0.5


def test_an_output_without_a_pulse_does_not_halve_the_other():
    params = PLANE | {"SERVO12_FUNCTION": 4, "SERVO11_FUNCTION": 70}
    assert wide(params, s1=1700, s12=1900)[0] == 0.75
    assert wide(params, s1=1700)[0] == wide(params, width=8, s1=1700)[0] == 0.5
    assert wide(params, width=8, s3=1500)[3] == 0.5


def test_aux_outputs_of_px4_are_9_to_16():
    px4 = {"PWM_AUX_FUNC1": 201, "PWM_AUX_FUNC2": 202, "PWM_AUX_REV": 0b10, "CA_SV_CS0_TYPE": 2, "CA_SV_CS1_TYPE": 3}
    px4 |= {"PWM_AUX_MIN1": 1000.0, "PWM_AUX_MAX1": 1800.0, "PWM_MAIN_FUNC1": 101}
    assert wide(px4, s1=1250, s9=1800, s10=1750) == [1.0, -0.5, 0.0, 0.25]
    many = px4 | {"PWM_MAIN_FUNC9": 202}  # a MAIN of more than eight outputs
    assert wide(many, s9=2000)[:2] == [0.0, 1.0]
