"""Diagnosis of multirotors: effects concealed in RotorPy's parameters, loss of control, refusals, model file."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fleet.frames import Origin
from fleet.simulator.conceal.multirotor.exam import draw_rotor_jobs
from fleet.simulator.conceal.multirotor.faults import HIDDEN, FaultyMultirotor
from fleet.simulator.faults.physics import Fault
from fleet.simulator.multirotor.tuning import motor_inputs
from twin_worker.diagnosis.inference.report import Report, ReportOutcome, with_sentence
from twin_worker.diagnosis.multirotor.baseline import (
    FORMAT,
    RotorBaseline,
    block_limits,
    calibrate_rotors,
    load_rotors,
    save_rotors,
)
from twin_worker.diagnosis.multirotor.control_loss import find_control_loss, unjudged
from twin_worker.diagnosis.multirotor.diagnose import diagnose_rotors
from twin_worker.diagnosis.multirotor.flight import DT, RotorFlight
from twin_worker.diagnosis.multirotor.model import PARAMETERS
from twin_worker.diagnosis.multirotor.recordings import RotorRecording, before, diagnose_recording
from twin_worker.diagnosis.multirotor.search import nominal_gains
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.telemetry.motors import FRAMES, rotor_frame

HOME = Origin(536_500_000, 80_500_000, 5_000)
BEGIN_S, ONSET_S, END_S, LOSS = 12.0, 60.0, 85.0, 0.2
FlightAndUav = tuple[RotorFlight, FaultyMultirotor]


@pytest.fixture(scope="module")
def flown() -> FlightAndUav:
    """One flight on RotorPy whose motor 2 loses thrust, at the rate of an onboard log."""
    uav = FaultyMultirotor(0, 31_000, wind=2.0, origin=HOME, flight_seed=31_001)
    uav.attach((Fault("motor_thrust_loss", "motor2", {"loss": LOSS}, ONSET_S),))
    uav.silent, rows = True, []
    uav.step(BEGIN_S)
    while uav.tick < round(END_S * 100):
        uav.step((uav.tick + 2) / 100)
        e = uav.estimate
        rows.append(np.concatenate([motor_inputs(uav.pulses, uav.params), e.force, e.rates, e.v, e.euler, e.p]))
    x = np.array(rows)
    attitude = np.unwrap(x[:, 13:16], axis=0)
    t, ok = np.arange(len(x)) * DT, np.ones(len(x), bool)
    ok[:100] = ok[-50:] = False
    parts = (x[:, :4], x[:, 4:7], x[:, 7:10], x[:, 10:13], attitude)
    position = x[:, 16:] * (1, 1, -1)
    return RotorFlight("quad", FRAMES[1, 1], t, 0.0, *parts, np.full(len(x), np.nan), position, ok), uav


@pytest.fixture(scope="module")
def baseline(flown: FlightAndUav) -> RotorBaseline:
    return calibrate_rotors([before(flown[0], ONSET_S - BEGIN_S - 2.0)], lambda _: None, nominal_gains)


@pytest.fixture(scope="module")
def report(flown: FlightAndUav, baseline: RotorBaseline) -> Report:
    return diagnose_rotors(flown[0], baseline)


def test_the_weak_motor_is_named_with_place_time_and_size(report: Report) -> None:
    assert report.outcome is ReportOutcome.NAMED, report.sentence
    (finding,) = report.findings
    assert (finding.hypothesis.effect.name, finding.surface) == ("motor_thrust_loss", "motor2")
    assert finding.reported["loss"] == pytest.approx(LOSS, rel=0.1)
    assert finding.segments[0][0] == pytest.approx(ONSET_S - BEGIN_S, abs=1.0)
    assert finding.probability > 0.95
    assert "the residual falls from" in report.sentence and "held-out" not in report.sentence  # all rows are fitted


def test_the_healthy_part_is_not_named(flown: FlightAndUav, baseline: RotorBaseline) -> None:
    healthy = diagnose_rotors(before(flown[0], ONSET_S - BEGIN_S - 1.0), baseline)
    assert healthy.outcome is ReportOutcome.NONE, healthy.sentence


def test_thrust_and_lag_are_those_of_the_physics(flown: FlightAndUav, baseline: RotorBaseline) -> None:
    kind, speeds = flown[1].healthy
    p = dict(zip(PARAMETERS, baseline.parameters.tolist(), strict=True))
    hover = 0.45  # motor input at which the curves are compared [-]
    thrust = p["k"] * ((1 - p["expo"]) * hover + p["expo"] * hover**2)
    true = kind.k_eta * kind.top_speed**2 * np.mean(speeds**2) / kind.mass
    assert thrust == pytest.approx(true * ((1 - kind.expo) * hover + kind.expo * hover**2), rel=0.05)
    assert p["tau"] == pytest.approx(kind.tau_m, abs=0.025)  # with the delay of the sampled outputs


def test_few_blocks_of_nominal_flights_widen_the_limit_of_unusual_noise() -> None:
    rng = np.random.default_rng(1)
    many, few = (block_limits([np.exp(0.1 * rng.standard_normal((n, 13))) for _ in range(3)]) for n in (30, 2))
    assert (many > 1.3).all() and (many < 2.0).all() and few.mean() > 1.2 * many.mean()
    another = np.exp(0.1 * rng.standard_normal((500, 30, 13)))
    assert 0.0 < (another > many).any(axis=(1, 2)).mean() < 0.05  # of nominal flights
    one = block_limits([np.ones((1, 13))])
    assert (one > 100.0).all()  # nothing is known of the spread


def test_an_effect_without_force_is_stated_by_the_residual(report: Report) -> None:
    unseen = with_sentence(replace(report, fit_before=1.2, fit_after=1.15, force_before=0.1, force_after=float("nan")))
    assert "the residual falls from 1.20 to 1.15 (4%)" in unseen.sentence and "nan" not in unseen.sentence


def test_a_model_file_is_read_again(baseline: RotorBaseline, tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    save_rotors(path, baseline)
    document = json.loads(path.read_text())
    assert document["format"] == FORMAT
    assert np.array_equal(load_rotors(path, document).spread, baseline.spread)
    document["parameters"] = document["parameters"][1:]
    with pytest.raises(ValueError, match=r"model\.json: found .* expected a complete model"):
        load_rotors(path, document)


def test_another_number_of_motors_is_refused(flown: FlightAndUav, baseline: RotorBaseline) -> None:
    with pytest.raises(ValueError, match="found 4 motors, expected 6"):
        diagnose_rotors(flown[0], replace(baseline, motors=6))


def test_the_jobs_of_a_seed_hide_every_effect() -> None:
    jobs = draw_rotor_jobs(3, 60)
    single = {job.effects[0] for job in jobs if job.role == "single"}
    assert single == set(HIDDEN)
    assert sum(job.role == "control" for job in jobs) >= 20
    assert [job.name for job in jobs] == [job.name for job in draw_rotor_jobs(3, 60)]


# --- loss of control -------------------------------------------------------------------------------------------------

PARAMS = {"FRAME": 1.0}
LOST_S = 40.0


def tumbling(lost: int | None, rate_hz: float = 50.0) -> TelemetryHistory:
    """Return attitude and outputs of a quadrotor X whose motor `lost` stops; the others answer."""
    rng = np.random.default_rng(5)
    dt, mixer = 1 / rate_hz, FRAMES[1, 1].mixer[:, :2]
    t = np.arange(0.0, LOST_S + 1.5, dt)
    angles, rates, wanted = np.zeros(2), np.zeros(2), np.zeros(2)
    attitude, pulses = [], []
    for now in t:
        wanted = 0.9 * wanted + 0.02 * rng.standard_normal(2)
        torque = np.clip(2.0 * (wanted - angles) - 0.4 * rates, -0.25, 0.25)
        u = np.clip(0.5 + mixer @ torque, 0.05, 1.0)
        working = np.arange(4) != (lost if lost is not None and now > LOST_S else -1)
        rates = rates + dt * 60.0 * (u * working) @ mixer
        angles = angles + dt * rates
        attitude.append([*angles, 0.0, *rates, 0.0])
        pulses.append([*(1000 + 1000 * u), 0, 0, 0, 0])
    history = TelemetryHistory(keep_s=np.inf)
    history.replace_rows("attitude", 1e9 + t, np.array(attitude))
    history.replace_rows("servo", 1e9 + t, np.array(pulses))
    return history


@pytest.mark.parametrize("motor", range(4))
def test_a_dead_motor_is_found_by_its_side(motor: int) -> None:
    loss = find_control_loss(tumbling(motor), PARAMS)
    assert loss is not None and motor in loss.motors, loss
    assert loss.t == pytest.approx(LOST_S, abs=0.5)
    assert FRAMES[1, 1].sides[motor] in loss.sentence


def test_control_that_is_kept_is_no_loss() -> None:
    assert find_control_loss(tumbling(None), PARAMS) is None


def test_slow_outputs_are_not_judged() -> None:
    history = tumbling(0, rate_hz=4.0)
    assert "4.0 Hz" in unjudged(history, PARAMS)
    assert find_control_loss(history, PARAMS) is None
    with pytest.raises(ValueError, match=r"expected 20 Hz .*control is not judged either"):
        recording = RotorRecording("slow", history, dict(PARAMS))
        for kind in ("velocity", "imu"):
            history.replace_rows(kind, history.rows("attitude")[0], np.zeros((len(history.rows("attitude")[0]), 6)))
        diagnose_recording(recording, 20.0, lambda _: None)


def test_frames_by_their_parameters() -> None:
    assert rotor_frame({"FRAME_CLASS": 1.0, "FRAME_TYPE": 1.0}) is FRAMES[1, 1]
    assert rotor_frame({"FRAME": 0.0}) is FRAMES[1, 0]
    assert rotor_frame({"FRAME_CLASS": 9.0}) is None
    assert FRAMES[1, 1].sides == ("front right", "rear left", "front left", "rear right")


@pytest.mark.recordings
@pytest.mark.parametrize(
    ("name", "outcome", "text"),
    [
        ("ardupilot_mechanical_fail_quad.log", ReportOutcome.NAMED, "since 90.9 s: it turns left"),
        ("dronekit_copter_log171_crash.bin", ReportOutcome.UNKNOWN, "impact at 227.7 s"),
        ("beast_sample_quad.bin.xz", ReportOutcome.NONE, "no loss of control"),
    ],
)
def test_real_quadrotors(name: str, outcome: ReportOutcome, text: str, recordings: Path) -> None:
    from twin_worker.diagnosis.multirotor.recordings import read_rotorcraft

    (one,) = read_rotorcraft(recordings / "real" / name)
    report = diagnose_recording(one, 60.0, lambda _: None)
    assert (report.outcome, text in report.sentence) == (outcome, True), report.sentence
