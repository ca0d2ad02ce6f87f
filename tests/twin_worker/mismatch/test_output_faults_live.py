"""Live diagnosis jobs name a failed servo output of a real flight soon after it failed, and none before."""

from pathlib import Path

import numpy as np
import pytest

from fleet.contract import Params, Sample
from fleet.telemetry.recording.recordings import replay_messages
from twin_worker.diagnosis.data.card import UNKNOWN
from twin_worker.diagnosis.inference.report import OUTPUT_CHANNEL, ReportOutcome
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.mismatch.coordinator import BASELINE_S, DiagnosisState
from twin_worker.mismatch.job import FLIGHT_S, DiagnosisJob, DiagnosisResult, move_past, run_job, telemetry_rows
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.twin.step import Twin

PAST_S, DELAY_S = 48.0, 12.0  # trusted past; from the failure to the job
FAILURES = {  # recording -> effect, surface and onset after the first attitude [s]
    "alfa_07-18-15-53-31_2_engine_failure": ("thrust_loss", "throttle", 73.5),
    "alfa_09-11-15-05-11_1_elevator_failure": ("actuator_stuck", "elevator", 63.5),
    "alfa_10-05-14-37-22_3_left_aileron_failure": ("actuator_stuck", "aileron", 72.4),
}


def diagnosed(path: Path, until: float) -> DiagnosisResult:
    """Return the result of a job on the telemetry up to `until` seconds after the first attitude."""
    history, params = TelemetryHistory(keep_s=np.inf), {}
    for message in replay_messages(path):
        if isinstance(message, Sample):
            history.add(message)
        elif isinstance(message, Params):
            params.update(message.values)
    begin = float(history.rows("attitude")[0][0])
    rows = {
        kind: (t[t <= begin + until], x[t <= begin + until]) for kind, (t, x) in telemetry_rows(history, 0.0).items()
    }
    return run_job(DiagnosisJob(1, rows, params, UNKNOWN, None, begin + PAST_S))


@pytest.mark.recordings
@pytest.mark.parametrize("name", FAILURES)
def test_a_failed_output_is_named_within_seconds_and_not_before(name: str, recordings: Path) -> None:
    effect, surface, onset = FAILURES[name]
    path = next(recordings.rglob(f"{name}.tlog*"))
    result = diagnosed(path, onset + DELAY_S)
    assert not result.refusal and result.report is not None
    first = result.report.findings[0]
    assert result.report.outcome is ReportOutcome.NAMED
    assert (first.hypothesis.effect.name, first.surface, first.channel) == (effect, surface, OUTPUT_CHANNEL)
    assert first.segments[0][0] == pytest.approx(onset, abs=1.5)
    before = diagnosed(path, onset - 1.0).report
    assert before is None or all(one.channel != OUTPUT_CHANNEL for one in before.findings)


def test_beside_a_comparison_model_a_long_mission_shows_the_law(twin: Twin, monkeypatch: pytest.MonkeyPatch) -> None:
    state = DiagnosisState(baseline=Baseline(UNKNOWN, {}, 20.0))
    assert state.urgency(twin) is not None
    assert state.create_job(twin).past_end is None  # the flight is shorter than a past
    monkeypatch.setattr(DiagnosisState, "_mission_flight_s", staticmethod(lambda _: BASELINE_S))
    state.next_t = -np.inf
    assert state.urgency(twin) is not None
    job, newest = state.create_job(twin), twin.telemetry.history.newest
    assert job.past_end == newest and job.recent_start == newest - FLIGHT_S and job.baseline is not None


def test_a_job_hours_after_its_past_is_as_long_as_one_minutes_after_it(twin: Twin) -> None:
    newest = twin.telemetry.history.newest
    start = newest - 30.0
    past = telemetry_rows(twin.telemetry.history, newest - 60.0)
    recent = telemetry_rows(twin.telemetry.history, start)["attitude"]
    lengths = []
    for hours in (0.1, 3.0):
        earlier = {kind: (t - hours * 3600.0, x) for kind, (t, x) in past.items()}
        moved, end = move_past(earlier, newest - hours * 3600.0, start)
        t, x = telemetry_rows(twin.telemetry.history, start, moved)["attitude"]
        assert start - 20.0 < end < start - 5.0 and (np.diff(t) > 0).all()
        assert np.diff(t)[t[:-1] > end - 1.0].max() > 5.0  # a gap, which a diagnosis leaves out
        np.testing.assert_array_equal(t[t >= start], recent[0])
        np.testing.assert_array_equal(x[t >= start], recent[1])
        lengths.append(np.ptp(t))
    assert lengths[1] == pytest.approx(lengths[0], abs=1e-3)
