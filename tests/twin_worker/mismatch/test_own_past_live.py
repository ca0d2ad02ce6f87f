"""Live diagnosis against the own past: a simulated aircraft with a fast accelerometer, in two jobs after the past."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.contract import DiagnosisOutcome, Params, Sample
from fleet.effects import catalogue
from fleet.simulator.faults.kinds import parse_fault
from fleet.simulator.flight.drive import to_tlog
from fleet.simulator.flight.uav import SimulatedUav
from fleet.telemetry.recording.recordings import replay_messages
from tests.support.diagnosed import made
from twin_worker.diagnosis.data.card import UNKNOWN, OnsetProfile
from twin_worker.diagnosis.inference.diagnose import uncovered_axes
from twin_worker.diagnosis.inference.report import Report, ReportOutcome
from twin_worker.mismatch import job
from twin_worker.mismatch.coordinator import BASELINE_S, DiagnosisState
from twin_worker.mismatch.job import (
    FLIGHT_S,
    DiagnosisJob,
    DiagnosisResult,
    ObservedOnsets,
    move_past,
    run_job,
    telemetry_rows,
    with_observed_onsets,
)
from twin_worker.telemetry.history import TelemetryHistory

SEED, TAKEOFF_S, ONSET_S = 202, 60.0, 300.0
FAULT = parse_fault(f"thrust_loss,fraction=0.3,at={ONSET_S:.0f}", "small")


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[TelemetryHistory, dict[str, float]]:
    """Telemetry and parameters of an aircraft whose engine loses 30 % of its thrust after 300 s."""
    path = tmp_path_factory.mktemp("own") / "flight.tlog"
    to_tlog(path, [SimulatedUav(0, SEED, faults=(FAULT,))], seconds=350, loss=0.02, seed=SEED)
    history, params = TelemetryHistory(keep_s=np.inf), {}
    for message in replay_messages(path):
        if isinstance(message, Sample):
            history.add(message)
        elif isinstance(message, Params):
            params.update(message.values)
    return history, params


def job_at(flight: tuple[TelemetryHistory, dict[str, float]], now: float) -> DiagnosisJob:
    """Return the job that a coordinator gives `now` seconds after the first attitude."""
    history, params = flight
    begin = float(history.rows("attitude")[0][0])
    received = {
        kind: (t[t <= begin + now], x[t <= begin + now]) for kind, (t, x) in telemetry_rows(history, 0.0).items()
    }
    past_end = begin + TAKEOFF_S + BASELINE_S
    past = {kind: (t[(t > begin + TAKEOFF_S) & (t < past_end)],) for kind, (t, _) in received.items()}
    past = {kind: (*t, received[kind][1][np.isin(received[kind][0], t[0])]) for kind, t in past.items()}
    start = begin + now - FLIGHT_S
    moved, moved_end = move_past(past, past_end, start)
    rows = {}
    for kind, (t, x) in received.items():
        recent = t > start
        rows[kind] = np.concatenate([moved[kind][0], t[recent]]), np.concatenate([moved[kind][1], x[recent]])
    return DiagnosisJob(1, rows, params, UNKNOWN, None, moved_end, None, start)


@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_loss_of_thrust_is_named_and_nothing_before_it(
    flight: tuple[TelemetryHistory, dict[str, float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    healthy = run_job(replace(job_at(flight, ONSET_S - 5.0), full=True))
    assert not healthy.refusal and healthy.report.outcome is not ReportOutcome.NAMED
    monkeypatch.setattr(job, "calibrate_past", None)  # the past is calibrated once
    result = run_job(replace(job_at(flight, ONSET_S + 40.0), past_model=healthy.past_model))
    assert not result.refusal and result.past_model is healthy.past_model
    assert result.check > 1.0  # so that it is diagnosed
    (found,) = result.report.findings
    assert result.report.outcome is ReportOutcome.NAMED
    assert "thrust_loss" in {found.hypothesis.effect.name, *found.rivals}
    begin = float(flight[0].rows("attitude")[0][0])
    assert result.begin + found.segments[0][0] == pytest.approx(begin + ONSET_S, abs=3.0)


def test_surfaces_that_move_together_are_not_told_apart(flight: tuple[TelemetryHistory, dict[str, float]]) -> None:
    """The rudder of the simulated aircraft is mixed with its aileron."""
    past_model = run_job(job_at(flight, ONSET_S - 5.0)).past_model
    assert past_model.base.undetermined == ("aileron", "rudder")
    assert any(line.startswith("aileron and rudder not covered: ") for line in uncovered_axes(past_model.base))


def with_onset(report: Report, onset: float) -> Report:
    """Return a report whose only effect begins at `onset`."""
    (finding,) = report.findings
    moved = replace(finding.hypothesis, onset=OnsetProfile(finding.hypothesis.onset.kind, onset))
    return replace(report, findings=(replace(finding, hypothesis=moved, segments=((onset, 110.0),)),))


def test_an_onset_before_the_newest_flight_is_the_one_that_was_observed() -> None:
    observed: ObservedOnsets = {}
    first, unobserved = with_observed_onsets(with_onset(made(), 83.0), observed, 1000.0, 1020.0)
    assert first.findings[0].segments[0][0] == 83.0 and not unobserved
    later, unobserved = with_observed_onsets(with_onset(made(), 5.0), observed, 1200.0, 1220.0)
    (finding,) = later.findings
    assert finding.segments == ((-117.0, 110.0),) and finding.hypothesis.onset.t0 == -117.0 and not unobserved
    again, _ = with_observed_onsets(with_onset(made(), 60.0), observed, 1200.0, 1220.0)  # begins anew
    assert again.findings[0].segments[0][0] == 60.0


def test_effects_that_are_not_separable_share_the_observed_onset() -> None:
    (lag,) = made().findings
    assert "actuator_delay" in lag.rivals
    observed: ObservedOnsets = {}
    with_observed_onsets(with_onset(made(), 83.0), observed, 1000.0, 1020.0)
    delay = replace(lag.hypothesis, effect=catalogue()["actuator_delay"])
    renamed = replace(made(), findings=(replace(lag, hypothesis=delay, rivals=()),))
    report, unobserved = with_observed_onsets(with_onset(renamed, 5.0), observed, 1200.0, 1220.0)
    assert report.findings[0].segments[0][0] == -117.0 and not unobserved


def test_an_effect_that_no_diagnosis_saw_begin_is_suspected() -> None:
    state = DiagnosisState()
    state.first_t = 1000.0

    def answer(end: float, onset: float) -> DiagnosisOutcome:
        """Diagnose the 120 s before `end`; the onset counts from their start."""
        report = with_onset(made(), onset)
        mismatch = state.handle_result(DiagnosisResult(1, end - 120.0, end, end - 120.0, report=report))
        assert mismatch is not None
        return mismatch.outcome

    assert answer(1200.0, 5.0) is DiagnosisOutcome.SUSPECTED and answer(1208.0, 5.0) is DiagnosisOutcome.SUSPECTED
    assert "without an observed onset" in state.published.sentence  # type: ignore[union-attr]
    assert not state.is_unconfirmed
    answer(1216.0, 83.0)
    assert answer(1224.0, 75.0) is DiagnosisOutcome.NAMED
    assert answer(1424.0, 5.0) is DiagnosisOutcome.NAMED  # observed before
    state.published, cleared = None, made(outcome=ReportOutcome.NONE)
    for end in (1432.0, 1440.0):
        state.handle_result(DiagnosisResult(1, end - 120.0, end, end - 120.0, report=cleared))
    assert answer(1448.0, 5.0) is DiagnosisOutcome.SUSPECTED
