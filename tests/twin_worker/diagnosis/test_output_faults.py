"""Outputs that no longer answer the controller: synthetic laws, and real flights with and without failures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from twin_worker.diagnosis.baseline.own_past import OwnPast, find_output_faults
from twin_worker.diagnosis.data.card import UNKNOWN
from twin_worker.diagnosis.data.flight import read_flights
from twin_worker.diagnosis.data.outputs import ServoOutputs
from twin_worker.diagnosis.inference.output_faults import FrozenOutput, find_frozen_outputs, with_frozen_outputs
from twin_worker.diagnosis.inference.report import OUTPUT_CHANNEL, FigureSeries, Report, ReportOutcome

TRUSTED_S, FAULT_S, END_S, STEP_S = 60.0, 90.0, 120.0, 0.25
PARAMS = {f"SERVO{n}_FUNCTION": float(function) for n, function in ((1, 4), (2, 19), (3, 70), (4, 21))}
FAILURES = {  # recording -> surface and onset after the first frame [s]
    "alfa_07-18-15-53-31_1_engine_failure": ("throttle", 116.3),
    "alfa_07-18-16-22-01_engine_failure_with_emr_traj": ("throttle", 116.6),
    "alfa_07-30-17-10-45_engine_failure_with_emr_traj": ("throttle", 117.2),
    "alfa_09-11-11-56-30_engine_failure": ("throttle", 103.6),
    "alfa_10-05-15-52-12_3_engine_failure_with_emr_traj": ("throttle", 49.2),
    "alfa_07-18-15-53-31_2_engine_failure": ("throttle", 73.5),
    "alfa_09-11-15-05-11_1_elevator_failure": ("elevator", 63.5),
    "alfa_09-11-15-06-34_3_rudder_left_failure": ("rudder", 60.2),
    "alfa_10-05-14-37-22_3_left_aileron_failure": ("aileron", 72.4),
}
NO_MISMATCH = Report(
    *("flight", ReportOutcome.NONE, "", (), {}, {}, np.nan, np.nan, np.nan, np.nan, np.nan, np.nan, ("", ()), {}),
    *((), (), FigureSeries(*(np.zeros(0),) * 9)),
)
HEALTHY = (  # the quadplane changes to hover, the last one lands
    *("alfa_07-30-16-39-00_3_no_failure.tlog.xz", "alfa_10-05-15-52-12_1_no_failure.tlog.xz"),
    *("../sitl/s09_quadplane_nominal.tlog.xz", "px4_proto_flt09.ulg.xz"),
)


def flown(seed: int, busy: float = 1.0) -> ServoOutputs:
    """Return the outputs of proportional laws in gusts; `busy` scales all control errors."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, END_S, STEP_S)

    def signal(size: float, period_s: float) -> np.ndarray:
        phase = rng.uniform(0.0, 2 * np.pi, 3)
        waves = [np.sin(2 * np.pi * t / (period_s * k) + p) for k, p in zip((1.0, 1.7, 2.9), phase, strict=True)]
        return busy * size * (np.sum(waves, axis=0) + 0.2 * rng.standard_normal(len(t)))

    roll, pitch, energy = signal(0.1, 5.0), signal(0.05, 4.0), signal(4.0, 15.0)
    p, q, climb = signal(0.1, 3.0), signal(0.05, 2.0), signal(0.5, 9.0)
    noise = rng.standard_normal((len(t), 4))
    pulses = np.zeros((len(t), 8))
    pulses[:, 0] = 1500 + 900 * roll - 200 * p + noise[:, 0]
    pulses[:, 1] = 1500 + 900 * pitch - 200 * q + noise[:, 1]
    pulses[:, 2] = 1500 + 30 * energy + 20 * climb + noise[:, 2]
    pulses[:, 3] = 1500 + 0.5 * (pulses[:, 0] - 1500) + noise[:, 3]
    zero = np.zeros(len(t))
    signals = (
        np.column_stack([roll, p, zero, zero, zero]),
        np.column_stack([pitch, q, zero, zero, zero]),
        np.column_stack([energy, climb, zero, zero, zero]),
    )
    errors = np.column_stack([roll, pitch, energy])
    return ServoOutputs(t, np.rint(pulses), errors, signals, zero + np.nan, np.ones(len(t), bool), PARAMS)


def frozen_at(outputs: ServoOutputs, column: int, pulse: float | None = None) -> ServoOutputs:
    """Return outputs of which one is constant from the fault on."""
    pulses = outputs.pulses.copy()
    after = outputs.t >= FAULT_S
    pulses[after, column] = pulses[np.argmax(after), column] if pulse is None else pulse
    return replace(outputs, pulses=pulses)


@pytest.mark.parametrize("busy", [0.02, 0.2, 1.0, 3.0])
@pytest.mark.parametrize("seed", range(5))
def test_a_healthy_flight_has_no_frozen_output(seed: int, busy: float) -> None:
    assert find_frozen_outputs(flown(seed, busy), TRUSTED_S) == []


@pytest.mark.parametrize(("column", "surface"), list(enumerate(("aileron", "elevator", "throttle", "rudder"))))
@pytest.mark.parametrize("pulse", [None, 1450.0])
def test_a_frozen_output_is_found_with_its_surface_and_onset(column: int, surface: str, pulse: float | None) -> None:
    (found,) = find_frozen_outputs(frozen_at(flown(1), column, pulse), TRUSTED_S)
    assert (found.number, found.surface) == (column + 1, surface)
    assert found.since == pytest.approx(FAULT_S, abs=1.0) and found.until == pytest.approx(END_S, abs=1.0)
    assert found.error_before > 2.0


def test_an_output_saturated_by_its_control_error_is_no_fault_and_a_stuck_one_at_the_same_limit_is() -> None:
    outputs = flown(2)
    after = outputs.t >= FAULT_S
    limit = outputs.pulses[outputs.t < TRUSTED_S, 1].max()
    stuck = frozen_at(outputs, 1, limit)
    assert [one.surface for one in find_frozen_outputs(stuck, TRUSTED_S)] == ["elevator"]
    errors = stuck.errors.copy()
    errors[after, 1] = 0.3 + 0.1 * np.abs(errors[after, 1])
    signals = (stuck.signals[0], np.column_stack([errors[:, 1], stuck.signals[1][:, 1:]]), stuck.signals[2])
    assert find_frozen_outputs(replace(stuck, errors=errors, signals=signals), TRUSTED_S) == []


def test_an_output_that_reaches_its_limit_where_the_law_had_failed_before_is_saturated() -> None:
    """An autopilot far from its calibrated flight demands more than the regression predicts, up to the limit."""
    outputs = flown(2)
    pulses = outputs.pulses.copy()
    after = outputs.t >= FAULT_S
    offset = 60.0 * (outputs.t[after] - FAULT_S)
    pulses[after, 0] = np.minimum(pulses[after, 0] + offset, 2000.0)
    assert (pulses[:, 0] == 2000.0).sum() > 10
    assert find_frozen_outputs(replace(outputs, pulses=pulses), TRUSTED_S) == []
    assert [one.number for one in find_frozen_outputs(frozen_at(outputs, 0, 2000.0), TRUSTED_S)] == [1]


def test_a_throttle_at_idle_is_cut_unless_its_law_brings_it_there() -> None:
    outputs = frozen_at(flown(3), 2, 1000.0)
    (found,) = find_frozen_outputs(outputs, TRUSTED_S)
    assert found.surface == "throttle" and found.pulse == 1000.0 and found.since == pytest.approx(FAULT_S, abs=0.5)
    report = with_frozen_outputs(NO_MISMATCH, [found])
    assert report.outcome is ReportOutcome.NAMED and report.sentence.startswith("thrust_loss: throttle output 3 is cut")
    energy = outputs.errors[:, 2].copy()
    energy[outputs.t >= FAULT_S] -= 30.0  # a descent is commanded
    signals = (*outputs.signals[:2], np.column_stack([energy, outputs.signals[2][:, 1:]]))
    errors = np.column_stack([outputs.errors[:, :2], energy])
    assert find_frozen_outputs(replace(outputs, errors=errors, signals=signals), TRUSTED_S) == []


def test_a_throttle_at_full_power_is_frozen_unless_its_law_brings_it_there() -> None:
    outputs = frozen_at(flown(4), 2, 2000.0)
    found = find_frozen_outputs(outputs, TRUSTED_S)
    assert [one.surface for one in found] == ["throttle"]
    report = with_frozen_outputs(NO_MISMATCH, found)  # no thrust is lost
    assert report.outcome is ReportOutcome.UNKNOWN and "mismatch in throttle output 3 (90-120 s)" in report.sentence
    energy = outputs.errors[:, 2].copy()
    energy[outputs.t >= FAULT_S] += 30.0
    signals = (*outputs.signals[:2], np.column_stack([energy, outputs.signals[2][:, 1:]]))
    assert find_frozen_outputs(replace(outputs, signals=signals), TRUSTED_S) == []


def test_a_throttle_whose_law_has_just_failed_is_not_judged_at_a_limit() -> None:
    """In the seconds before, the output jumped by hundreds of microseconds that its law does not predict."""
    outputs = frozen_at(flown(4), 2, 2000.0)
    assert find_frozen_outputs(outputs, TRUSTED_S) != []
    pulses, before = outputs.pulses.copy(), (outputs.t > FAULT_S - 6.0) & (outputs.t < FAULT_S)
    pulses[before, 2] += 400.0 * np.sign(np.sin(2 * np.pi * outputs.t[before] / 6.0))
    noise = np.random.default_rng(6).integers(1, 99, before.sum())
    pulses[before, 2] = np.clip(pulses[before, 2], 1000.0 + noise, 2000.0 - noise)
    assert find_frozen_outputs(replace(outputs, pulses=pulses), TRUSTED_S) == []


def test_a_demand_far_beyond_what_the_trusted_flight_excited_is_no_evidence() -> None:
    """Where the energy hardly changed, its coefficient is uncertain, and the prediction with it."""
    outputs = flown(5)
    calm, after = outputs.t < 0.5 * TRUSTED_S, outputs.t >= FAULT_S
    energy, climb = outputs.errors[:, 2].copy(), outputs.signals[2][:, 1]
    energy[calm] *= 0.01
    energy[after] -= 40.0
    pulses = outputs.pulses.copy()
    pulses[:, 2] = np.rint(1500 + 30 * energy + 20 * climb + np.random.default_rng(5).standard_normal(len(energy)))
    pulses[after, 2] = 1700.0  # frozen, or not linear in the energy
    signals = (*outputs.signals[:2], np.column_stack([energy, outputs.signals[2][:, 1:]]))
    changed = replace(outputs, pulses=pulses, signals=signals)
    assert [one.surface for one in find_frozen_outputs(changed, TRUSTED_S)] == ["throttle"]
    assert find_frozen_outputs(changed, 0.5 * TRUSTED_S) == []


def test_an_output_that_the_law_does_not_explain_is_not_judged() -> None:
    outputs = frozen_at(flown(4), 0)
    pulses = outputs.pulses.copy()
    rows = outputs.t < FAULT_S
    pulses[rows, 0] = 1500 + np.rint(50 * np.random.default_rng(1).standard_normal(rows.sum()))
    found = find_frozen_outputs(replace(outputs, pulses=pulses), TRUSTED_S)
    assert "aileron" not in [one.surface for one in found]


def test_without_enough_trusted_flight_nothing_is_judged() -> None:
    assert find_frozen_outputs(frozen_at(flown(1), 0), 5.0) == []


# --- real flights ----------------------------------------------------------------------------------------------------


def found_in(path: Path, until: float) -> list[FrozenOutput]:
    (flight,) = read_flights(path, UNKNOWN)
    assert flight.outputs is not None
    return find_frozen_outputs(flight.outputs, until)


@pytest.mark.recordings
@pytest.mark.parametrize("name", FAILURES)
def test_a_failed_output_of_a_real_flight_is_named(name: str, recordings: Path) -> None:
    surface, onset = FAILURES[name]
    (found,) = found_in(recordings / "real" / f"{name}.tlog.xz", 46.0)
    assert found.surface == surface and found.since == pytest.approx(onset, abs=1.0)


@pytest.mark.recordings
@pytest.mark.parametrize("name", HEALTHY)
def test_a_healthy_real_flight_has_none(name: str, recordings: Path) -> None:
    assert find_output_faults(read_flights(recordings / "real" / name, UNKNOWN)[0]) == []
    assert found_in(recordings / "real" / name, 55.0) == []


@pytest.mark.recordings
@pytest.mark.parametrize("name", ["sitl/s04_wind_step", "sitl/s08_airspeed_ratio", "sitl-more/f08"])
def test_changes_of_the_airframe_and_of_the_weather_freeze_no_output(name: str, recordings: Path) -> None:
    assert found_in(recordings / f"{name}.tlog.xz", 100.0) == []


@pytest.mark.recordings
def test_the_report_names_side_surface_and_time(recordings: Path) -> None:
    (flight,) = read_flights(recordings / "real" / "alfa_09-11-15-05-11_1_elevator_failure.tlog.xz", UNKNOWN)
    report = OwnPast(58.0, UNKNOWN).diagnose(flight)
    assert report.outcome is ReportOutcome.NAMED
    assert [f.channel for f in report.findings] == [OUTPUT_CHANNEL]
    assert report.sentence.startswith("actuator_stuck: elevator output 2 is frozen at 1500 us since 63 s"), (
        report.sentence
    )
    concealed = OwnPast(58.0, UNKNOWN).diagnose(flight, conceal=("elevator",))
    assert all(f.channel != OUTPUT_CHANNEL for f in concealed.findings)
