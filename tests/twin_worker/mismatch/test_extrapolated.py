"""What changes with the commanded airspeed is suspected; urgent work rests less; confirmations come first."""

from types import SimpleNamespace

import numpy as np
import pytest

from fleet.contract import DiagnosisOutcome
from tests.support.diagnosed import ONSET, made
from twin_worker.diagnosis.baseline.past import CommandedAirspeeds, commanded_airspeed
from twin_worker.diagnosis.data.card import UNKNOWN
from twin_worker.diagnosis.inference.report import ReportOutcome
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.mismatch.coordinator import DIAGNOSIS_PERIOD_S, DiagnosisState
from twin_worker.mismatch.job import DiagnosisJob, DiagnosisResult, extrapolated_effects
from twin_worker.mismatch.process import URGENT_SHARE, DiagnosisProcess

EFFECT = "actuator_lag"
BASE = Baseline(UNKNOWN, {}, 20.0)
AT_23 = CommandedAirspeeds(np.full(101, 23.0), 0.5)
AT_BOTH = CommandedAirspeeds(np.where(np.arange(101) < 50, 23.0, 20.7), 0.5)
MOSTLY_23 = CommandedAirspeeds(np.where(np.arange(101) < 90, 23.0, 20.7), 0.5)


def flight(*changes: float, reported: bool = True) -> SimpleNamespace:
    """A flight at 23 m/s, from each change on at the other of 23 and 20.7 m/s; the flown airspeed follows late."""
    t = np.arange(0.0, 200.0, 0.2)
    setpoint = np.where(np.sum([t >= change for change in (*changes, np.inf)], axis=0) % 2 == 1, 20.7, 23.0)
    flown = np.interp(t - 3.0, t, setpoint)
    readings = {"Va": flown} | ({"slow": setpoint - flown} if reported else {})
    return SimpleNamespace(t=t, ok=np.ones(len(t), bool), readings=readings)


def effects(*changes: float, past: CommandedAirspeeds | None = AT_23, outcome: ReportOutcome = ReportOutcome.NAMED):
    return extrapolated_effects(made(outcome=outcome), flight(*changes), SimpleNamespace(airspeeds=past))


def test_an_effect_that_begins_with_another_airspeed_is_extrapolated() -> None:
    assert effects(ONSET) == {EFFECT} and effects(ONSET - 2.0) == {EFFECT}
    assert effects() == set()  # the same airspeed throughout
    assert effects(20.0) == set()  # it begins a minute after the change
    # at an airspeed that the past does not contain, before and after
    assert effects(ONSET - 40.0, ONSET + 40.0) == set()
    assert effects(20.0, ONSET) == {EFFECT}  # back, but the flight before it was at another airspeed


@pytest.mark.parametrize(("past", "extrapolates"), [(AT_BOTH, False), (MOSTLY_23, True), (None, False)])
def test_an_airspeed_of_the_past_is_no_extrapolation(past: CommandedAirspeeds | None, extrapolates: bool) -> None:
    assert (EFFECT in effects(ONSET, past=past)) is extrapolates


def test_an_unexplained_mismatch_at_another_airspeed_is_extrapolated() -> None:
    assert effects(ONSET, outcome=ReportOutcome.UNKNOWN) == {"unknown"}
    assert effects(outcome=ReportOutcome.UNKNOWN) == set()


def test_the_commanded_airspeed_counts_not_the_flown_one() -> None:
    speed = commanded_airspeed(flight(ONSET))
    assert speed is not None and set(np.round(speed, 6)) == {20.7, 23.0}
    assert commanded_airspeed(flight(ONSET, reported=False)) is None
    pitot = flight()
    pitot.readings["Va"] = np.where(pitot.t > ONSET, 17.0, 23.0)  # reads too little: the setpoint stays
    pitot.readings["slow"] = 23.0 - pitot.readings["Va"]
    assert extrapolated_effects(made(), pitot, SimpleNamespace(airspeeds=AT_23)) == set()
    assert extrapolated_effects(made(), flight(ONSET, reported=False), SimpleNamespace(airspeeds=AT_23)) == set()


def answered(state: DiagnosisState, end: float, outcome: ReportOutcome, extrapolated: set[str]) -> DiagnosisOutcome:
    result = DiagnosisResult(1, 1000.0, end, report=made(outcome=outcome), extrapolated=frozenset(extrapolated))
    mismatch = state.handle_result(result)
    assert mismatch is not None
    return mismatch.outcome


@pytest.mark.parametrize(("outcome", "name"), [(ReportOutcome.NAMED, EFFECT), (ReportOutcome.UNKNOWN, "unknown")])
def test_an_extrapolated_effect_is_suspected_until_other_flight_shows_it(outcome: ReportOutcome, name: str) -> None:
    state = DiagnosisState(baseline=BASE)
    state.first_t = 1000.0
    for end in (1200.0, 1208.0):
        assert answered(state, end, outcome, {name}) is DiagnosisOutcome.SUSPECTED
        assert not state.is_unconfirmed
    assert "airspeed that its own past does not contain" in state.published.sentence  # type: ignore[union-attr]
    assert answered(state, 1216.0, outcome, set()) is DiagnosisOutcome(outcome.value)
    assert state.next_t == 1216.0 + DIAGNOSIS_PERIOD_S  # the others wait
    assert answered(state, 1250.0, outcome, {name}) is DiagnosisOutcome(outcome.value)  # known already


def test_a_confirmation_comes_before_all_that_is_overdue(twin: object) -> None:
    late, waiting = DiagnosisState(baseline=BASE), DiagnosisState(baseline=BASE)
    late.next_t = twin.telemetry.history.newest - 600.0  # type: ignore[attr-defined]
    waiting.is_unconfirmed = True
    assert waiting.urgency(twin) > late.urgency(twin)  # type: ignore[arg-type,operator]
    assert waiting.create_job(twin).is_urgent and not late.create_job(twin).is_urgent  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("urgent", "check", "share"), [(False, 0.5, 0.2), (True, 0.5, URGENT_SHARE), (False, 1.5, 0.8)]
)
def test_the_process_rests_less_after_what_is_urgent(
    urgent: bool, check: float, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin_worker.mismatch.process.time.monotonic", lambda: 100.0)
    process = DiagnosisProcess()
    monkeypatch.setattr(process, "_exchange", lambda job: None)
    process.submit(DiagnosisJob(1, {}, {}, UNKNOWN, BASE, is_urgent=urgent))
    process._result = DiagnosisResult(1, 0.0, 1.0, check=check, cpu_s=2.0)
    assert process.poll() is not None
    assert process._free_at == pytest.approx(100.0 + 2.0 * (1.0 / share - 1.0))
    process.close()
