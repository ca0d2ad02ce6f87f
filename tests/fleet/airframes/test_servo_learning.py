"""The servo map learnt from flight: surfaces, signs, mixers; nothing where flight tells nothing."""

from pathlib import Path

import numpy as np
import pytest

from fleet.airframes.servo_learning import learn_servo_map
from tests.fleet.telemetry.onboard_logs.test_table_logs import read, rows

N = 400


def flight(seed: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors, rates and throttle of a flight with stabilisation."""
    rng = np.random.default_rng(seed)
    smooth = np.ones(8) / 8
    errors = np.column_stack([np.convolve(rng.normal(0, 0.3, N), smooth, "same") for _ in range(2)])
    rates = np.gradient(errors, axis=0) * -3.0
    return errors, rates, 0.6 + 0.1 * np.convolve(rng.normal(0, 1, N), smooth, "same")


def outputs(width: int = 8, **surfaces: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pulses of outputs such as `s5="+a"`, with a little noise, and the signals behind them."""
    errors, rates, throttle = flight()
    aileron, elevator = errors[:, 0] - 0.2 * rates[:, 0], errors[:, 1] - 0.2 * rates[:, 1]
    value = {"a": aileron, "e": elevator, "r": 0.5 * aileron, "t": 3.0 * (throttle - 0.6)}
    value |= {
        "e-a": elevator - aileron,
        "e+a": elevator + aileron,
        "e+r": elevator + aileron,
        "e-r": elevator - aileron,
    }
    pulses = np.full((N, width), 1500.0)
    for name, surface in surfaces.items():
        sign = -1.0 if surface[0] == "-" else 1.0
        pulses[:, int(name[1:]) - 1] += sign * 300.0 * value[surface[1:]]
    pulses += np.random.default_rng(5).normal(0, 2.0, pulses.shape)
    return pulses, errors, rates, throttle


def inputs(learnt, **pulses: float) -> list[float]:
    row = np.full((1, 16), 1500.0)
    for name, pulse in pulses.items():
        row[0, int(name[1:]) - 1] = pulse
    return learnt.inputs(row)[0].tolist()


def test_ailerons_on_five_and_six_are_found_with_their_signs() -> None:
    learnt = learn_servo_map(*outputs(s2="-e", s3="+t", s4="+r", s5="+a", s6="-a"))
    assert learnt is not None
    assert learnt.sentence == ("servo map learnt from flight: 2 elevator, 3 throttle, 4 rudder, 5 aileron, 6 aileron")
    da, de, dr, _ = inputs(learnt, s5=1900, s6=1100, s2=1100, s4=1900)
    assert (da, de, dr) == pytest.approx((1.0, 1.0, 1.0), abs=0.15)
    assert abs(inputs(learnt, s5=1900, s6=1900)[0]) < 0.15


def test_elevons_are_told_apart() -> None:
    learnt = learn_servo_map(*outputs(s1="+e-a", s2="+e+a", s3="+t"))
    assert learnt is not None and "1 elevon, 2 elevon, 3 throttle" in learnt.sentence
    assert inputs(learnt, s1=1900, s2=1900)[:2] == pytest.approx((0.0, 1.0), abs=0.15)
    assert inputs(learnt, s1=1100, s2=1900)[:2] == pytest.approx((1.0, 0.0), abs=0.15)


def test_beside_ailerons_a_mixed_pair_is_a_v_tail() -> None:
    learnt = learn_servo_map(*outputs(s1="+a", s2="+e+r", s4="+e-r", s3="+t"))
    assert learnt is not None and "2 V-tail" in learnt.sentence and "4 V-tail" in learnt.sentence
    assert inputs(learnt, s2=1900, s4=1900)[1:3] == pytest.approx((1.0, 0.0), abs=0.15)
    assert inputs(learnt, s2=1900, s4=1100)[1:3] == pytest.approx((0.0, 1.0), abs=0.15)


def test_nothing_is_learnt_where_nothing_is_told() -> None:
    pulses, errors, rates, throttle = outputs(s1="+a", s2="+e")
    rng = np.random.default_rng(1)
    assert learn_servo_map(1500 + rng.normal(0, 50, pulses.shape), errors, rates, throttle) is None
    assert learn_servo_map(pulses[:50], errors[:50], rates[:50], throttle[:50]) is None
    assert learn_servo_map(np.full_like(pulses, np.nan), errors, rates, throttle) is None
    assert learn_servo_map(np.where(np.arange(8) == 0, pulses, 1500.0), errors, rates, throttle) is None  # no elevator


def test_a_real_flight_shows_its_ailerons(recordings: Path) -> None:
    """The ALFA aircraft has ailerons on 5 and 6; no parameter is in the file."""
    news = read(recordings / "real/alfa_20180718_155331_1_engine_failure.tlog")[0]
    (t, pulses), (t_a, attitude), (t_c, command), (t_v, air) = (
        rows(news, name) for name in ("servo", "attitude", "command", "air")
    )

    def at(source_t: np.ndarray, columns: np.ndarray) -> np.ndarray:
        return np.column_stack([np.interp(t, source_t, column) for column in columns.T])

    state = at(t_a, attitude)
    errors = at(t_c, command[:, :2]) - state[:, :2]
    learnt = learn_servo_map(pulses, errors, state[:, 3:5], at(t_v, air)[:, 1])
    assert learnt is not None
    assert learnt.sentence.endswith("2 elevator, 3 throttle, 4 rudder, 5 aileron, 6 aileron")
    assert learnt.gain_up[4, 0] > 0 and learnt.gain_up[5, 0] > 0 and learnt.gain_up[1, 1] < 0


def test_surfaces_on_outputs_9_to_16_are_learnt() -> None:
    learnt = learn_servo_map(*outputs(16, s9="+a", s10="-e", s16="+t"))
    assert learnt is not None
    assert learnt.sentence == "servo map learnt from flight: 9 aileron, 10 elevator, 16 throttle"
    assert inputs(learnt, s9=1900, s10=1100)[:2] == pytest.approx((1.0, 1.0), abs=0.15)


def test_two_motors_are_learnt_as_one_throttle() -> None:
    learnt = learn_servo_map(*outputs(s1="+a", s2="+e", s3="+t", s5="+t"))
    assert learnt is not None and learnt.sentence.endswith("3 throttle, 5 throttle")
    low, high = (inputs(learnt, s3=1300, s5=pulse)[3] for pulse in (1300, 1700))
    assert high - low == pytest.approx(0.25, abs=0.01)  # half of 400 us of 800


def test_flaperons_are_learnt_as_ailerons() -> None:
    learnt = learn_servo_map(*outputs(s1="+a", s5="+a", s2="+e"))
    assert learnt is not None and "1 aileron, 2 elevator, 5 aileron" in learnt.sentence
