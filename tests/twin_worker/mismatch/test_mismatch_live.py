"""Mismatch live: when a worker looks, what it says and when, and that nothing of it can stop the predictions."""

import copy
import os
import signal
import threading
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from fleet.bus.codec import Stamp
from fleet.contract import DiagnosisOutcome, Mismatch, Prediction
from tests.support import flights as f
from tests.support import odd_jobs
from tests.support.diagnosed import made
from twin_worker.diagnosis.data.card import UNKNOWN
from twin_worker.diagnosis.inference.report import Report, ReportOutcome
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.mismatch.coordinator import ALL_UAVS, CHECK_PERIOD_S, Coordinator, DiagnosisState
from twin_worker.mismatch.job import (
    DiagnosisJob,
    DiagnosisResult,
    mismatch_message,
    run_job,
    shift_times,
    summary,
    telemetry_rows,
)
from twin_worker.mismatch.process import DiagnosisProcess

BASE = Baseline(UNKNOWN, {}, 20.0)


class Hand:
    """Works nothing out: hands over the answers it was given."""

    def __init__(self) -> None:
        self.free, self.jobs, self.answers = True, [], []

    def submit(self, job: DiagnosisJob) -> None:
        self.jobs.append(job)
        self.free = False

    def poll(self) -> DiagnosisResult | None:
        return self.answers.pop(0) if self.answers else None

    def say(self, report: Report | None, **more) -> None:
        """Answer the newest job."""
        t = self.jobs[-1].rows["attitude"][0]
        self.answers.append(DiagnosisResult(self.jobs[-1].uav, float(t[0]), float(t[-1]), report=report, **more))
        self.free = True


def answered(watch: DiagnosisState, end: float, report: Report) -> Mismatch | None:
    return watch.handle_result(DiagnosisResult(1, end - 120.0, end, report=report))


@pytest.fixture
def looking(twin) -> tuple[Coordinator, Hand, object]:
    """Diagnoses of one aircraft that has flown for a while, against a model."""
    hand = Hand()
    live = Coordinator(hand, {ALL_UAVS: BASE})
    return live, hand, twin


def turned(live: Coordinator, twin: object) -> list[Mismatch]:
    return list(live.run_once([(twin, nullcontext())]))


def test_a_look_is_due_after_some_flight_and_then_every_few_seconds(looking):
    live, hand, twin = looking
    assert turned(live, twin) == [] and len(hand.jobs) == 1
    assert hand.jobs[0].baseline is BASE and len(hand.jobs[0].rows["attitude"][0]) > 500
    hand.say(None)
    assert turned(live, twin) == [] and len(hand.jobs) == 1  # too soon
    live.state(1).next_t -= CHECK_PERIOD_S
    turned(live, twin)
    assert len(hand.jobs) == 2


def test_one_job_at_a_time(looking):
    live, hand, twin = looking
    turned(live, twin)
    live.state(1).next_t = -np.inf
    turned(live, twin)
    assert len(hand.jobs) == 1


def test_who_is_lost_landed_or_has_no_wings_is_left_alone(looking):
    live, hand, twin = looking
    other = msgspec.structs.replace(twin.onboard.status, vehicle="multirotor")
    for part, name, value in ((twin.telemetry, "link_lost", True), (twin.onboard, "status", other)):
        kept = getattr(part, name)
        setattr(part, name, value)
        turned(live, twin)
        setattr(part, name, kept)
    assert not hand.jobs


def test_without_a_model_the_own_past_must_be_long_enough(twin):
    hand = Hand()
    live = Coordinator(hand)
    turned(live, twin)
    assert not hand.jobs and live.state(1).past is None


def test_a_name_is_told_when_a_second_look_says_the_same():
    watch = DiagnosisState(baseline=BASE)
    watch.first_t = 1000.0
    first = answered(watch, 1200.0, made())
    assert first.outcome is DiagnosisOutcome.SUSPECTED
    assert watch.next_t == pytest.approx(1205.0)  # look again soon
    second = answered(watch, 1210.0, _later(made(), -10.0))
    assert second.outcome is DiagnosisOutcome.NAMED and second.causes[0].name == "actuator_lag"
    assert second.causes[0].segments[0][0] == pytest.approx(1210.0 - 120.0 + 73.0)


def test_what_is_seen_once_says_so_and_where():
    watch = DiagnosisState(baseline=BASE)
    watch.first_t = 1000.0
    unknown = made(outcome=ReportOutcome.UNKNOWN)
    first = answered(watch, 1200.0, unknown)
    assert first.outcome is DiagnosisOutcome.SUSPECTED and first.causes[0].channel == "pitch"
    assert first.sentence.startswith("detected once, not confirmed: mismatch in") and summary(first) == "suspected"
    assert answered(watch, 1210.0, unknown).outcome is DiagnosisOutcome.UNKNOWN


def test_by_its_own_past_nothing_is_named_that_began_in_it(twin, monkeypatch):
    for name, gives in {
        "calibrate_past": SimpleNamespace(baseline=lambda flight: BASE, airspeeds=None),
        "check_residuals": 1.0,
        "diagnose": made(),
        "effect_outputs": None,
    }.items():
        monkeypatch.setattr(f"twin_worker.mismatch.job.{name}", lambda *_, gives=gives, **__: gives)
    rows = telemetry_rows(twin.telemetry.history, -np.inf)
    begin = rows["attitude"][0][0]
    named, suspected = (
        run_job(DiagnosisJob(1, rows, {}, UNKNOWN, None, begin + until, full=True)) for until in (60.0, 100.0)
    )
    assert named.report.outcome is ReportOutcome.NAMED
    assert suspected.report.outcome is ReportOutcome.SUSPECTED  # its onset is at 83 s


def test_who_waits_to_be_confirmed_goes_first(twin):
    calm, waiting = DiagnosisState(baseline=BASE), DiagnosisState(baseline=BASE)
    answered(waiting, twin.telemetry.history.newest - 10.0, made())
    calm.next_t = waiting.next_t - 20.0  # and has waited longer
    assert waiting.urgency(twin) > calm.urgency(twin)


def test_where_others_wait_only_what_is_stated_is_diagnosed_without_a_sign(twin):
    calm, stated = DiagnosisState(baseline=BASE), DiagnosisState(baseline=BASE)
    for _ in range(2):
        answered(stated, twin.telemetry.history.newest - 30.0, made())
    assert stated.published.outcome is DiagnosisOutcome.NAMED and not stated.is_unconfirmed
    assert calm.create_job(twin).full and not calm.create_job(twin, idle=False).full
    assert stated.create_job(twin, idle=False).full  # so that a name can be withdrawn


def test_another_name_or_onset_at_a_second_look_is_no_confirmation():
    watch = DiagnosisState(baseline=BASE)
    watch.first_t = 1000.0
    answered(watch, 1200.0, made())
    assert answered(watch, 1260.0, made()).outcome is DiagnosisOutcome.SUSPECTED  # 60 s later: another onset


def test_one_look_that_sees_less_takes_nothing_back_two_do():
    watch = DiagnosisState(baseline=BASE)
    watch.first_t = 1000.0
    answered(watch, 1200.0, made())
    assert answered(watch, 1200.0, made()).outcome is DiagnosisOutcome.NAMED
    nothing = made(outcome=ReportOutcome.NONE)
    assert answered(watch, 1220.0, nothing) is None and watch.published.outcome is DiagnosisOutcome.NAMED
    over = answered(watch, 1240.0, nothing)
    assert over.outcome is DiagnosisOutcome.NONE and over.causes == ()


def test_a_refusal_is_kept_and_tried_again_later():
    watch = DiagnosisState(baseline=BASE)
    assert watch.handle_result(DiagnosisResult(1, 0.0, 1200.0, refusal="found 3 s, expected 25 s")) is None
    assert watch.reason.startswith("found 3 s") and watch.next_t == 1230.0


def test_the_message_tells_where_what_and_how_well():
    told = mismatch_message(7, made(), 5000.0, 5200.0)
    (cause,) = told.causes
    assert (cause.channel, cause.surface, cause.confusable_with[0]) == ("actuator", "elevator", "actuator_delay")
    assert cause.segments == ((5083.0, 5200.0),) and told.onset == 5083.0
    assert cause.parameters["tau_s"] == pytest.approx(0.253) and cause.sigma["tau_s"] == pytest.approx(0.0061)
    assert (told.fit_before, told.fit_after) == (1.94, 1.07) and told.attitude_error_after == 2.2
    assert summary(told) == "named actuator_lag of the elevator"


def test_unknown_says_where_and_nothing_says_nothing():
    told = mismatch_message(7, made(outcome=ReportOutcome.UNKNOWN), 5000.0, 5200.0)
    assert told.causes[0].name == "unknown" and told.causes[0].channel == "pitch"
    assert told.causes[0].segments[0] == (5083.0, 5118.0) and summary(told) == "unknown, in pitch"
    nothing = mismatch_message(7, made(outcome=ReportOutcome.NONE), 5000.0, 5200.0)
    assert nothing.causes == () and summary(nothing) == "" and nothing.onset is None
    assert nothing.fit_before is None  # nan is no number on the wire


def test_the_sentence_counts_from_when_the_aircraft_was_first_heard():
    assert "after 203 s" in shift_times(made(), 120.0).sentence


def test_a_flight_that_cannot_be_is_refused_in_a_sentence(twin):
    rows = telemetry_rows(twin.telemetry.history, twin.telemetry.history.newest - 5.0)
    answer = run_job(DiagnosisJob(1, rows, {}, UNKNOWN, BASE))
    assert "expected 25 s" in answer.refusal and answer.report is None
    nothing = {kind: (np.empty(0), np.empty((0, x.shape[1]))) for kind, (_, x) in rows.items()}
    assert run_job(DiagnosisJob(1, nothing, {}, UNKNOWN, BASE)).refusal


def test_kept_past_and_newest_flight_are_joined_without_doubles(twin):
    newest = twin.telemetry.history.newest
    past = telemetry_rows(twin.telemetry.history, newest - 60.0)
    joined = telemetry_rows(twin.telemetry.history, newest - 30.0, past)
    assert (np.diff(joined["attitude"][0]) > 0).all()
    assert len(joined["attitude"][0]) == len(past["attitude"][0])


def test_the_worker_publishes_answers_and_shows_what_was_found(holder, monkeypatch):
    hand = Hand()
    holder.diagnosis = Coordinator(hand, {ALL_UAVS: BASE}, adapt=False)
    told: list = []
    holder.bus.subscribe(Mismatch, lambda m, stamp: told.append((m, stamp)))
    holder.sweep()
    for _ in range(2):
        holder.sweep()
        hand.say(made())
        holder.sweep()
        holder.diagnosis.state(1).next_t = -np.inf
    assert [m.outcome for m, _ in told] == [DiagnosisOutcome.SUSPECTED, DiagnosisOutcome.NAMED]
    assert {stamp for _, stamp in told} == {Stamp(9, holder.bus.writer)}
    assert [m for m, _ in holder.bus.get(Mismatch)] == [told[-1][0]]
    (row,) = holder.state().rows
    assert row.mismatch == "named actuator_lag of the elevator"


def test_a_defect_of_the_diagnosis_leaves_the_predictions_and_is_said(holder, monkeypatch):
    class Broken(Hand):
        def poll(self) -> DiagnosisResult | None:
            raise RuntimeError("broken")

    holder.diagnosis = Coordinator(Broken(), {ALL_UAVS: BASE})
    made_: list = []
    holder.bus.subscribe(Prediction, lambda m, _: made_.append(m))
    for m in f.messages(f.turn(6.0), uav=2):
        holder.bus.publish(m)
    holder.sweep()
    assert made_ and "diagnosis failed with an internal error (broken); retried in 60 s" in holder.state().sentence
    holder.diagnosis._executor = hand = Hand()
    holder.sweep()
    assert not hand.jobs  # not yet
    holder._diagnosis_resume_t = -np.inf
    holder.sweep()
    assert hand.jobs and not holder.state().sentence


def test_a_defect_met_by_one_aircraft_leaves_the_diagnosis_of_the_others(looking, twin):
    live, hand, twin = looking
    other = copy.copy(twin)
    other.config = msgspec.structs.replace(other.config, uav=2)
    live.state(1).baseline = None
    live.state(1).past, live.state(1).past_t = {}, None  # what is looked at raises
    held = [(twin, nullcontext()), (other, nullcontext())]
    assert list(live.run_once(held)) == []
    assert [job.uav for job in hand.jobs] == [2]
    (said,) = live.defects([1, 2])
    assert said.startswith("uav-1: diagnosis failed with an internal error (TypeError") and "retried in 60 s" in said


def test_a_defect_in_taking_an_answer_is_that_aircrafts_alone_and_passes(looking, monkeypatch):
    live, hand, twin = looking
    turned(live, twin)
    hand.say(made())
    monkeypatch.setattr("twin_worker.mismatch.coordinator.mismatch_message", None)
    assert turned(live, twin) == [] and "TypeError" in live.defects([1])[0]
    monkeypatch.undo()
    watch = live.state(1)
    watch.next_t = -np.inf
    turned(live, twin)
    assert len(hand.jobs) == 1  # left alone for a while
    watch.off_until = -np.inf
    turned(live, twin)
    hand.say(made())
    assert turned(live, twin) and live.defects([1]) == []


def test_an_answer_waits_for_an_aircraft_that_is_worked_on(looking):
    """And nobody waits for it: the lock is held for as long as an identification takes."""
    live, hand, twin = looking
    turned(live, twin)
    hand.say(made())
    lock = threading.Lock()
    with lock:
        assert list(live.run_once([(twin, lock)])) == []
    (found,) = live.run_once([(twin, lock)])
    assert found.outcome is DiagnosisOutcome.SUSPECTED


def test_a_defect_is_retried_less_and_less_often():
    watch, waits = DiagnosisState(baseline=BASE), []
    for _ in range(9):
        watch.handle_result(DiagnosisResult(1, 0.0, 1000.0, defect="its process was killed by signal 9"))
        waits.append(watch.suspended_until - 1000.0)
    assert waits[:3] == [60.0, 120.0, 240.0] and waits[-1] == 3600.0 and "signal 9" in watch.defect
    watch.handle_result(DiagnosisResult(1, 0.0, 5000.0))
    assert watch.failures == 0 and not watch.defect


def test_without_a_diagnosis_nothing_is_answered(holder):
    assert holder.bus.get(Mismatch) == [] and holder.state().rows[0].mismatch == ""


def worked(hand: DiagnosisProcess, uav: int, rows: dict | None = None) -> DiagnosisResult:
    """Give a job and wait for its answer."""
    empty = {"attitude": (np.array([1.0, 2.0]), np.zeros((2, 6)))}
    hand.submit(DiagnosisJob(uav, rows or empty, {}, UNKNOWN, BASE))
    hand._thread.join(300.0)
    assert not hand._thread.is_alive()
    answer = hand.poll()
    assert answer is not None and answer.uav == uav
    hand._free_at = 0.0
    return answer


def test_the_background_process_answers_keeps_its_budget_and_ends(twin):
    hand = DiagnosisProcess(share=1e-6)
    try:
        hand.submit(
            DiagnosisJob(
                1, telemetry_rows(twin.telemetry.history, twin.telemetry.history.newest - 5.0), {}, UNKNOWN, BASE
            )
        )
        assert not hand.free
        hand._thread.join(300.0)
        answer = hand.poll()
        assert answer.uav == 1 and "expected 25 s" in answer.refusal
        assert not hand.free  # the little time it took is a millionth of a core only after a while
        assert hand.poll() is None
    finally:
        hand.close()
    assert hand._process is None and not hand.free


def test_a_job_that_dies_hangs_or_raises_is_told_and_the_next_is_worked_out():
    hand = DiagnosisProcess(1.0, odd_jobs.odd, limit_cpu_s=2.0, limit_s=300.0)
    try:
        said = {uav: worked(hand, uav) for uav in (odd_jobs.RAISES, odd_jobs.ENDS, odd_jobs.KILLED, odd_jobs.SPINS)}
        assert said[odd_jobs.RAISES].defect == "KeyError: 'nothing of the kind'"
        assert "odd_jobs.py" in said[odd_jobs.RAISES].details
        assert said[odd_jobs.ENDS].defect == "its process ended with exit code 3"
        assert said[odd_jobs.KILLED].defect == "its process was killed by signal 9"
        assert said[odd_jobs.SPINS].defect == "found no result after 2 s of CPU time"
        assert all((one.begin, one.end) == (1.0, 2.0) for one in said.values())
        assert not worked(hand, odd_jobs.FINE).defect
        hand._limit_s = 0.5  # of a process that lives already
        assert worked(hand, odd_jobs.HANGS).defect == "found no result after 0 s"
        hand._limit_s = 300.0
        assert not worked(hand, odd_jobs.FINE).defect
    finally:
        hand.close()


def test_who_gives_a_job_never_waits_for_the_process_to_take_it():
    """A job of 20 MB, and a process that does not run: the pipe holds a fraction of it."""
    hand = DiagnosisProcess(1.0, odd_jobs.deaf, limit_s=300.0)
    rows = {"attitude": (np.arange(500_000.0), np.zeros((500_000, 6)))}
    try:
        worked(hand, odd_jobs.FINE)
        os.kill(hand._process.pid, signal.SIGSTOP)
        hand.submit(DiagnosisJob(7, rows, {}, UNKNOWN, BASE))  # would wait for ever
        assert not hand.free and hand.poll() is None and hand._thread.is_alive()
        os.kill(hand._process.pid, signal.SIGCONT)
        hand._thread.join(300.0)
        assert hand.poll().end == 500_000
    finally:
        hand.close()


def _later(report: Report, seconds: float) -> Report:
    """The same flight seen by a window that begins later."""
    findings = tuple(
        replace(one, segments=tuple((a + seconds, b + seconds) for a, b in one.segments)) for one in report.findings
    )
    return replace(report, findings=findings)
