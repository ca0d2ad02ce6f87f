"""Mismatch live: when a worker looks, what it says and when, and that nothing of it can stop the predictions."""

from contextlib import nullcontext
from dataclasses import replace

import flights as f
import msgspec
import numpy as np
import pytest
from diagnosed import made

from fleet.codec import Stamp
from fleet.contract import Found, Mismatch, Prediction
from twin_worker.diagnose.baseline import Baseline
from twin_worker.diagnose.card import UNKNOWN
from twin_worker.diagnose.report import Outcome, Report
from twin_worker.mismatch.background import Background
from twin_worker.mismatch.job import Answer, Job, rows_of, work
from twin_worker.mismatch.live import ALL, Live
from twin_worker.mismatch.told import message, since, word
from twin_worker.mismatch.watch import LOOK_S, Watch

BASE = Baseline(UNKNOWN, {}, 20.0)


class Hand:
    """Works nothing out: hands over the answers it was given."""

    def __init__(self) -> None:
        self.free, self.jobs, self.answers = True, [], []

    def give(self, job: Job) -> None:
        self.jobs.append(job)
        self.free = False

    def answer(self) -> Answer | None:
        return self.answers.pop(0) if self.answers else None

    def say(self, report: Report | None, **more) -> None:
        """Answer the newest job."""
        t = self.jobs[-1].rows["attitude"][0]
        self.answers.append(Answer(self.jobs[-1].uav, float(t[0]), float(t[-1]), report=report, **more))
        self.free = True


def answered(watch: Watch, end: float, report: Report) -> Mismatch | None:
    return watch.take(Answer(1, end - 120.0, end, report=report))


@pytest.fixture
def looking(twin) -> tuple[Live, Hand, object]:
    """Diagnoses of one aircraft that has flown for a while, against a model."""
    hand = Hand()
    live = Live(hand, {ALL: BASE})
    return live, hand, twin


def turned(live: Live, twin: object) -> list[Mismatch]:
    return list(live.turn([(twin, nullcontext())]))


def test_a_look_is_due_after_some_flight_and_then_every_few_seconds(looking):
    live, hand, twin = looking
    assert turned(live, twin) == [] and len(hand.jobs) == 1
    assert hand.jobs[0].base is BASE and len(hand.jobs[0].rows["attitude"][0]) > 500
    hand.say(None)
    assert turned(live, twin) == [] and len(hand.jobs) == 1  # too soon
    live.watch(1).next_t -= LOOK_S
    turned(live, twin)
    assert len(hand.jobs) == 2


def test_one_job_at_a_time(looking):
    live, hand, twin = looking
    turned(live, twin)
    live.watch(1).next_t = -np.inf
    turned(live, twin)
    assert len(hand.jobs) == 1


def test_who_is_lost_landed_or_has_no_wings_is_left_alone(looking):
    live, hand, twin = looking
    for name, value in (("lost", True), ("status", msgspec.structs.replace(twin.status, vehicle="multirotor"))):
        kept = getattr(twin, name)
        setattr(twin, name, value)
        turned(live, twin)
        setattr(twin, name, kept)
    assert not hand.jobs


def test_without_a_model_the_own_past_must_be_long_enough(twin):
    hand = Hand()
    live = Live(hand)
    turned(live, twin)
    assert not hand.jobs and live.watch(1).past is None


def test_a_name_is_told_when_a_second_look_says_the_same():
    watch = Watch(base=BASE)
    watch.begun = 1000.0
    first = answered(watch, 1200.0, made())
    assert first.outcome is Found.SUSPECTED
    assert watch.next_t == pytest.approx(1205.0)  # look again soon
    second = answered(watch, 1210.0, _later(made(), -10.0))
    assert second.outcome is Found.NAMED and second.causes[0].name == "actuator_lag"
    assert second.causes[0].segments[0][0] == pytest.approx(1210.0 - 120.0 + 73.0)


def test_what_is_seen_once_says_so_and_where():
    watch = Watch(base=BASE)
    watch.begun = 1000.0
    unknown = made(outcome=Outcome.UNKNOWN)
    first = answered(watch, 1200.0, unknown)
    assert first.outcome is Found.SUSPECTED and first.causes[0].channel == "pitch"
    assert first.sentence.startswith("seen once, not confirmed: a mismatch no effect") and word(first) == "suspected"
    assert answered(watch, 1210.0, unknown).outcome is Found.UNKNOWN


def test_by_its_own_past_nothing_is_named_that_began_in_it(twin, monkeypatch):
    for name, gives in {"calibrate_past": BASE, "growth": 1.0, "diagnose": made(), "pushes": None}.items():
        monkeypatch.setattr(f"twin_worker.mismatch.job.{name}", lambda *_, gives=gives: gives)
    rows = rows_of(twin.history, -np.inf)
    begin = rows["attitude"][0][0]
    named, suspected = (work(Job(1, rows, {}, UNKNOWN, None, begin + until, whole=True)) for until in (60.0, 100.0))
    assert named.report.outcome is Outcome.NAMED
    assert suspected.report.outcome is Outcome.SUSPECTED  # its onset is at 83 s


def test_who_waits_to_be_confirmed_goes_first(twin):
    calm, waiting = Watch(base=BASE), Watch(base=BASE)
    answered(waiting, twin.history.newest - 10.0, made())
    calm.whole_t = waiting.whole_t - 30.0  # and has waited longer
    assert waiting.wants(twin) > calm.wants(twin)


def test_another_name_or_onset_at_a_second_look_is_no_confirmation():
    watch = Watch(base=BASE)
    watch.begun = 1000.0
    answered(watch, 1200.0, made())
    assert answered(watch, 1260.0, made()).outcome is Found.SUSPECTED  # 60 s later: another onset


def test_one_look_that_sees_less_takes_nothing_back_two_do():
    watch = Watch(base=BASE)
    watch.begun = 1000.0
    answered(watch, 1200.0, made())
    assert answered(watch, 1200.0, made()).outcome is Found.NAMED
    nothing = made(outcome=Outcome.NONE)
    assert answered(watch, 1220.0, nothing) is None and watch.told.outcome is Found.NAMED
    over = answered(watch, 1240.0, nothing)
    assert over.outcome is Found.NONE and over.causes == ()


def test_a_refusal_is_kept_and_tried_again_later():
    watch = Watch(base=BASE)
    assert watch.take(Answer(1, 0.0, 1200.0, refused="found 3 s, expected 25 s")) is None
    assert watch.why.startswith("found 3 s") and watch.next_t == 1230.0


def test_the_message_tells_where_what_and_how_well():
    told = message(7, made(), 5000.0, 5200.0)
    (cause,) = told.causes
    assert (cause.channel, cause.surface, cause.rivals[0]) == ("actuator", "elevator", "actuator_delay")
    assert cause.segments == ((5083.0, 5200.0),) and told.onset == 5083.0
    assert cause.parameters["tau_s"] == pytest.approx(0.253) and cause.sigma["tau_s"] == pytest.approx(0.0061)
    assert (told.fit_before, told.fit_after) == (1.94, 1.07) and told.stray_after == 2.2
    assert word(told) == "named actuator_lag of the elevator"


def test_unknown_says_where_and_nothing_says_nothing():
    told = message(7, made(outcome=Outcome.UNKNOWN), 5000.0, 5200.0)
    assert told.causes[0].name == "unknown" and told.causes[0].channel == "pitch"
    assert told.causes[0].segments[0] == (5083.0, 5118.0) and word(told) == "unknown, in pitch"
    nothing = message(7, made(outcome=Outcome.NONE), 5000.0, 5200.0)
    assert nothing.causes == () and word(nothing) == "" and nothing.onset is None
    assert nothing.fit_before is None  # nan is no number on the wire


def test_the_sentence_counts_from_when_the_aircraft_was_first_heard():
    assert "after 203 s" in since(made(), 120.0).sentence


def test_a_flight_that_cannot_be_is_refused_in_a_sentence(twin):
    rows = rows_of(twin.history, twin.history.newest - 5.0)
    answer = work(Job(1, rows, {}, UNKNOWN, BASE))
    assert "expected 25 s" in answer.refused and answer.report is None
    nothing = {kind: (np.empty(0), np.empty((0, x.shape[1]))) for kind, (_, x) in rows.items()}
    assert work(Job(1, nothing, {}, UNKNOWN, BASE)).refused


def test_kept_past_and_newest_flight_are_joined_without_doubles(twin):
    newest = twin.history.newest
    past = rows_of(twin.history, newest - 60.0)
    joined = rows_of(twin.history, newest - 30.0, past)
    assert (np.diff(joined["attitude"][0]) > 0).all()
    assert len(joined["attitude"][0]) == len(past["attitude"][0])


def test_the_worker_publishes_answers_and_shows_what_was_found(holder, monkeypatch):
    hand = Hand()
    holder.diagnosis = Live(hand, {ALL: BASE}, adapt=False)
    told: list = []
    holder.bus.subscribe(Mismatch, lambda m, stamp: told.append((m, stamp)))
    holder.turn()
    for _ in range(2):
        holder.turn()
        hand.say(made())
        holder.turn()
        holder.diagnosis.watch(1).next_t = -np.inf
    assert [m.outcome for m, _ in told] == [Found.SUSPECTED, Found.NAMED]
    assert {stamp for _, stamp in told} == {Stamp(9, holder.bus.writer)}
    assert [m for m, _ in holder.bus.ask(Mismatch)] == [told[-1][0]]
    (row,) = holder.state().rows
    assert row.mismatch == "named actuator_lag of the elevator"


def test_a_defect_of_the_diagnosis_leaves_the_predictions(holder):
    class Broken(Hand):
        def answer(self) -> Answer | None:
            raise RuntimeError("broken")

    holder.diagnosis = Live(Broken(), {ALL: BASE})
    made_: list = []
    holder.bus.subscribe(Prediction, lambda m, _: made_.append(m))
    for m in f.messages(f.turn(6.0), uav=2):
        holder.bus.publish(m)
    holder.turn()
    assert made_ and holder.diagnosis is None and "diagnosis met a defect" in holder.state().sentence


def test_without_a_diagnosis_nothing_is_answered(holder):
    assert holder.bus.ask(Mismatch) == [] and holder.state().rows[0].mismatch == ""


def test_the_background_process_answers_keeps_its_budget_and_ends(twin):
    hand = Background(share=1e-6)
    try:
        hand.give(Job(1, rows_of(twin.history, twin.history.newest - 5.0), {}, UNKNOWN, BASE))
        assert not hand.free
        assert hand._pipe.poll(60.0)
        answer = hand.answer()
        assert answer.uav == 1 and "expected 25 s" in answer.refused
        assert not hand.free  # the little time it took is a millionth of a core only after a while
        assert hand.answer() is None
    finally:
        hand.close()
    assert hand._process is None


def test_a_background_process_that_dies_is_started_again(twin):
    job = Job(1, rows_of(twin.history, twin.history.newest - 5.0), {}, UNKNOWN, BASE)
    hand = Background(share=1.0)
    try:
        hand.give(job)
        hand._process.kill()
        hand._process.join(10.0)
        while hand.answer() is None and hand._busy:
            pass
        hand._free_at = 0.0
        assert hand.free
        hand.give(job)
        assert hand._pipe.poll(60.0) and hand.answer() is not None
    finally:
        hand.close()


def _later(report: Report, seconds: float) -> Report:
    """The same flight seen by a window that begins later."""
    findings = tuple(
        replace(one, segments=tuple((a + seconds, b + seconds) for a, b in one.segments)) for one in report.findings
    )
    return replace(report, findings=findings)
