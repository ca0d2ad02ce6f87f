"""What gives way where a core cannot keep up: pace, quota, what is said of it; and predictions renewed in between."""

import argparse
import os
import subprocess
import sys
import threading
import time
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from conftest import ROOT

from fleet.contract import Prediction, Sample
from tests.support import flights as f
from tests.support.memory_bus import MemoryBus
from twin_worker.__main__ import NICE_INCREMENTS, run_at_low_priority
from twin_worker.confidence.tube_and_horizon import AHEAD
from twin_worker.service.busy_fallback import is_superseded, publish_fallbacks
from twin_worker.service.identification_thread import MIN_SHARE, CpuShareLimiter
from twin_worker.service.work_rates import RATE_WINDOW_S, CpuTimes, WorkRates
from twin_worker.service.worker import OwnedTwin, Worker, _advance_all
from twin_worker.twin import step as loop
from twin_worker.twin.state import budget as clocked
from twin_worker.twin.state.budget import (
    LATE_CPU_FRACTION,
    LATE_WORK_S,
    LIVE_SCHEDULE,
    MIN_WORK_S,
    WORK_PER_SWEEP_S,
    ComputeBudget,
    Schedule,
    Work,
    parse_schedule,
)
from twin_worker.twin.step import Twin, advance


def test_a_pace_is_read_and_refused_in_a_sentence() -> None:
    assert parse_schedule("identify=5,renew=0.1") == replace(LIVE_SCHEDULE, identify=5.0, renew=0.1)
    assert parse_schedule("members=50,span=60") == replace(LIVE_SCHEDULE, members=50, span=60.0)
    assert parse_schedule("departure=0,information=0") == Schedule(ensemble=20.0, renew=1.0)
    for odd in (
        "",
        "identify",
        "identify=0",
        "identify=x",
        "identify=nan",
        "speed=5",
        "predict=1e9",
        "span=200",
        "departure=-1",
    ):
        with pytest.raises(argparse.ArgumentTypeError, match=r"found .*, expected one of predict, identify"):
            parse_schedule(odd)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr(clocked.time, "thread_time", lambda: now[0])
    return now


def test_ensembles_give_way_before_flights_ahead_and_time_of_others_does_not_count(clock: list[float]) -> None:
    quota = ComputeBudget(limit=1.0)
    quota.begin_sweep()
    assert quota.try_acquire(Work.ENSEMBLE)
    clock[0] += 0.55
    quota.end_work()
    clock[0] += 5.0  # telemetry
    assert not quota.try_acquire(Work.ENSEMBLE) and quota.try_acquire(Work.IDENTIFY)
    clock[0] += 0.2
    assert not quota.try_acquire(Work.IDENTIFY) and quota.try_acquire(Work.PREDICT)
    clock[0] += 0.3
    assert not quota.try_acquire(Work.PREDICT)
    quota.begin_sweep()
    assert quota.try_acquire(Work.PREDICT)
    assert quota.refused == {Work.ENSEMBLE: 1, Work.IDENTIFY: 1, Work.PREDICT: 1}


def test_who_has_no_prediction_yet_comes_first_and_without_a_limit_nobody_waits(clock: list[float]) -> None:
    limited, free = ComputeBudget(limit=1.0), ComputeBudget()
    for quota in (limited, free):
        quota.begin_sweep(rollouts_only=True)
        assert quota.try_acquire(Work.PREDICT)
    assert not limited.try_acquire(Work.IDENTIFY) and free.try_acquire(Work.IDENTIFY)
    clock[0] += 1e6
    assert free.try_acquire(Work.ENSEMBLE)
    free.offloaded = frozenset({Work.IDENTIFY})
    assert not free.try_acquire(Work.IDENTIFY)


def test_what_is_old_already_is_not_foreseen_where_telemetry_waits(clock: list[float]) -> None:
    limited, free = ComputeBudget(limit=1.0, backlog=True), ComputeBudget(backlog=True)
    assert not limited.try_acquire(Work.PREDICT) and not limited.try_acquire(Work.RENEW)
    assert free.try_acquire(Work.PREDICT) and free.try_acquire(Work.RENEW)  # a recording sheds nothing
    limited.backlog = False
    assert limited.try_acquire(Work.RENEW) and limited.try_acquire(Work.PREDICT)
    clock[0] += 2.0
    assert limited.try_acquire(Work.RENEW) and not limited.try_acquire(Work.PREDICT)


def test_heavy_work_earns_a_share_of_the_cpu_time_while_telemetry_is_late_and_comes_back(clock: list[float]) -> None:
    quota, limits = ComputeBudget(), []
    for late, used in ((False, 0.0), (True, 0.02), (True, 0.01), (True, 0.0), (True, 9.0), *[(False, 0.01)] * 40):
        clock[0] += used
        quota.yield_to_telemetry(late)
        limits.append(quota.limit)
    assert limits[:5] == pytest.approx(
        [WORK_PER_SWEEP_S, LATE_CPU_FRACTION * 0.02, LATE_CPU_FRACTION * 0.01, MIN_WORK_S, LATE_WORK_S]
    )
    assert limits[-1] == WORK_PER_SWEEP_S


@pytest.mark.parametrize("piece_s", [0.002, 0.007, 0.03])
def test_heavy_work_falls_in_proportion_to_the_cpu_time_that_is_granted(clock: list[float], piece_s: float) -> None:
    """A tenth of a core makes every sweep late by the wall clock, whatever is done in it."""

    def done_per_cpu_s(granted: float, late_s: float = 0.12, telemetry_s: float = 0.008) -> float:
        quota, pieces, swept, begun = ComputeBudget(limit=WORK_PER_SWEEP_S), 0, clock[0], clock[0]
        while clock[0] < begun + 20.0:
            late, swept = (clock[0] - swept) / granted > late_s, clock[0]
            quota.yield_to_telemetry(late)
            quota.begin_sweep()
            clock[0] += telemetry_s
            while quota.try_acquire(Work.PREDICT):
                clock[0] += piece_s
                pieces += 1
        return pieces * piece_s / (clock[0] - begun)

    usual, starved = done_per_cpu_s(1.0), done_per_cpu_s(0.1)
    assert usual > 0.7 and 0.4 < starved < 0.8


def test_in_late_sweeps_no_ensemble_is_begun_while_flights_ahead_wait(clock: list[float]) -> None:
    quota, granted = ComputeBudget(limit=0.01), []
    for late, wanted in ((True, 9), (True, 9), (False, 9), (True, 9), (True, 1), (True, 1)):
        quota.yield_to_telemetry(late)
        quota.begin_sweep()
        granted.append(quota.try_acquire(Work.ENSEMBLE))
        clock[0] += 0.001
        for _ in range(wanted):
            quota.try_acquire(Work.PREDICT)
            clock[0] += 0.005 if wanted > 1 else 0.0001
    assert granted == [True, False, True, False, False, True]


def test_what_one_piece_of_work_took_too_much_is_missing_in_the_next_sweeps(clock: list[float]) -> None:
    quota, granted = ComputeBudget(limit=2.0**-7), []
    for _ in range(12):
        quota.begin_sweep()
        granted.append(quota.try_acquire(Work.PREDICT))
        clock[0] += 2.0**-5 if granted[-1] else 0.0
        quota.end_work()
    assert granted == [True, False, False, False] * 3


def test_work_beside_the_sweep_rests_until_the_others_had_their_cpu_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now = dict.fromkeys(("wall", "mine", "all"), 0.0)
    names = {"monotonic": "wall", "thread_time": "mine", "process_time": "all"}
    for name, clock in names.items():
        monkeypatch.setattr(f"twin_worker.service.identification_thread.time.{name}", lambda clock=clock: now[clock])
    beside, granted = CpuShareLimiter(), 0.0

    class Stop:
        def wait(self, seconds: float) -> bool:
            now["wall"] += seconds
            now["all"] += granted * seconds
            return False

    def work() -> None:
        now["mine"] += 0.2
        now["all"] += 0.2
        now["wall"] += 2.0

    def rested() -> float:
        before = now["wall"]
        beside.run(work, Stop())  # type: ignore[arg-type]
        return now["wall"] - before - 2.0

    assert rested() == 0.0
    for _ in range(9):
        beside.yield_to_telemetry(late=True)
    assert beside.share == MIN_SHARE
    granted = 0.1
    share = 1.2 * MIN_SHARE
    assert rested() == pytest.approx(0.2 * (1 / share - 1) / granted, abs=0.06), "CPU time of the others"
    granted = 0.0
    assert rested() == pytest.approx(2.0 * (1 / (1.2 * share) - 1), abs=0.06), "idle, they do not want any"


def test_a_flight_ahead_that_waits_for_cpu_time_is_replaced_by_renewals(
    heard: tuple, twin: Twin, monkeypatch: pytest.MonkeyPatch
) -> None:
    twin.config = msgspec.structs.replace(twin.config, schedule=Schedule(predict=1.0, identify=1000.0))
    twin.budget = ComputeBudget(limit=1.0)
    twin.identification.timer.restart(twin.telemetry.data_t)
    monkeypatch.setattr(twin.budget, "try_acquire", lambda work: work is Work.RENEW)
    twin.prediction.last_rollout, begun = twin.prediction.latest, twin.prediction.latest.t
    rest = f.shifted([m for m in heard if isinstance(m, Sample) and m.t > heard[-1].t - 40.0], 40.0, 1e9)
    made = [m for message in rest for m in advance(twin, (message,)) if isinstance(m, Prediction)]
    times = [begun, *(one.t for one in made)]
    assert max(np.diff(times)) < 1.5 and times[-1] > begun + 35.0 and twin.prediction.last_rollout.t == begun


def test_what_has_waited_is_taken_in_at_once_and_the_loop_turns_once_a_second(
    heard: tuple, twin: Twin, monkeypatch: pytest.MonkeyPatch
) -> None:
    turned: list[float] = []
    monkeypatch.setattr(loop, "_step", lambda twin, now: turned.append(now) or twin.telemetry.step(now) or [])
    rest = f.shifted([m for m in heard if isinstance(m, Sample) and m.t > heard[-1].t - 12.0], 12.0, 1e9)
    worker = Worker(MemoryBus(), range(4), omega=0.0)
    worker.quota.limit, twin.budget = 0.05, worker.quota
    held = OwnedTwin(twin, 1)
    held.inbox.extend(rest)
    list(_advance_all(held, len(rest), worker.traffic))
    assert not held.inbox and twin.telemetry.history.newest == pytest.approx(rest[-1].t, abs=0.2)
    assert 10 <= len(turned) <= 15 < len(rest) and max(np.diff(turned)) < 1.3


def test_who_is_not_reached_in_time_is_renewed_from_the_position_received_last(heard: tuple, twin: Twin) -> None:
    twin.prediction.last_rollout, told = twin.prediction.latest, []
    held = OwnedTwin(twin, 1)
    for message in f.shifted([m for m in heard if isinstance(m, Sample) and m.t > heard[-1].t - 31.0], 31.0, 1e9):
        held.last_position = message.position or held.last_position
        held.published_at = time.monotonic() - (2.0 if message.t > twin.prediction.latest.t + 30.0 else 0.0)
        publish_fallbacks([held], lambda made, _: told.append(made))
    times = np.array([made.t for made in told])
    assert len(times) and times[0] > twin.prediction.latest.t + 29.5 and (np.diff(times) > 0.8).all()
    late = msgspec.structs.replace(twin.prediction.latest, t=times[0] - 20.0)
    assert is_superseded(late, held) and not is_superseded(msgspec.structs.replace(late, t=times[-1] + 1.0), held)
    held.last_position = f.rows([times[0] - 25.0], [[0.0, 0.0, 0.0]])
    assert not is_superseded(late, held), "the clock was set back"


def test_who_waits_longest_is_renewed_first(twin: Twin, monkeypatch: pytest.MonkeyPatch) -> None:
    held, told = [OwnedTwin(twin, k) for k in range(4)], []
    monkeypatch.setattr("twin_worker.service.busy_fallback.fallback_prediction", lambda owned: owned.epoch)
    for one, waited in zip(held, (3.0, 0.1, 9.0, 5.0), strict=True):
        one.published_at = time.monotonic() - waited
    publish_fallbacks(held, lambda made, _: told.append(made))
    assert told == [2, 3, 0]


def test_what_is_shed_is_said() -> None:
    rates, pace = WorkRates(lambda: None), Schedule(predict=1.0, identify=5.0)
    for k in range(61):
        rates.record(Work.PREDICT, float(k), 10)
        if k % 3 == 0:
            rates.record(Work.IDENTIFY, float(k))
    assert rates.overload_messages(pace, 10, 60.0) == [
        "too many UAVs for this worker: identify every 27.3 s instead of 5.0 s"
    ]
    assert rates.overload_messages(pace, 2, 60.0) == []
    assert rates.overload_messages(replace(pace, information=0.1), 4, 60.0) == []  # an identification may be put off
    assert WorkRates().overload_messages(pace, 10, 60.0) == [] and rates.period(
        Work.IDENTIFY, 10, 60.0 + 2 * RATE_WINDOW_S
    ) == float("inf")


@pytest.mark.parametrize(
    ("own_cores", "told"),
    [(1.9, "too many UAVs for this worker: "), (0.4, "other programs use 75% of this machine's CPU: ")],
)
def test_late_work_is_put_down_to_whoever_uses_the_cpu(own_cores: float, told: str) -> None:
    """Two cores, 95 % used, by this worker or by others; nothing was identified at all."""
    t, pace = 0.0, Schedule(predict=1.0, identify=5.0)
    rates = WorkRates(lambda: CpuTimes(own_cores * t, 1.9 * t, 2.0 * t))
    for k in range(61):
        t = float(k)
        rates.record(Work.PREDICT, t, 10)
        (*_, last) = [[], *rates.overload_messages(pace, 10, t)]
    assert last.startswith(told) and "no identify for 30 s instead of every 5.0 s" in last and "inf" not in last


def test_predictions_come_ten_times_a_second_where_that_is_asked_for(heard: tuple, twin: Twin) -> None:
    twin.config = msgspec.structs.replace(twin.config, schedule=Schedule(predict=5.0, identify=1000.0, renew=0.1))
    twin.identification.timer.restart(twin.telemetry.data_t)
    rest = f.shifted([m for m in heard if isinstance(m, Sample) and m.t > heard[-1].t - 12.0], 12.0, 1e9)
    made = [m for message in rest for m in advance(twin, (message,)) if isinstance(m, Prediction)]
    per_s = len(made) / (made[-1].t - made[0].t)
    assert 7.0 < per_s < 11.0


@pytest.mark.parametrize("change", [{"coast_s": 2.0}, {"t": f.T0 - 100.0}])
def test_a_path_that_cannot_be_renewed_is_flown_anew_before_long(heard: tuple, twin: Twin, change: dict) -> None:
    twin.config = msgspec.structs.replace(twin.config, schedule=Schedule(predict=60.0, identify=1000.0, renew=0.1))
    twin.identification.timer.restart(twin.telemetry.data_t)
    twin.prediction.last_rollout = msgspec.structs.replace(twin.prediction.latest, **change)
    rest = f.shifted([m for m in heard if isinstance(m, Sample) and m.t > heard[-1].t - 3.0], 3.0, 1e9)
    made = [m for message in rest for m in advance(twin, (message,)) if isinstance(m, Prediction)]
    assert made and made[0].t < heard[-1].t + 1.5 and twin.prediction.last_rollout.coast_s == 0.0


def test_an_ensemble_that_had_to_wait_is_flown_before_the_next_flight_and_keeps_the_beat(
    heard: tuple, twin: Twin, monkeypatch: pytest.MonkeyPatch
) -> None:
    twin.config = msgspec.structs.replace(
        twin.config, schedule=Schedule(predict=2.0, identify=1000.0, ensemble=2.0, members=16, span=60.0)
    )
    twin.identification.timer.restart(twin.telemetry.data_t)
    asked: list[Work] = []
    flown: list[float] = []
    twin.budget = ComputeBudget()

    def grants(work: Work) -> bool:
        asked.extend([work] if work is Work.ENSEMBLE else [])
        return work is not Work.ENSEMBLE or len(asked) % 4 == 0  # three times in four others are preferred

    monkeypatch.setattr(twin.budget, "try_acquire", grants)
    rest = f.shifted([m for m in heard if isinstance(m, Sample) and m.t > heard[-1].t - 12.0], 12.0, 1e9)
    for message in rest:
        advance(twin, (message,))
        if not flown or flown[-1] != twin.prediction.ensemble_timer.last:
            flown.append(twin.prediction.ensemble_timer.last)
    assert (
        twin.prediction.ensemble_spread is not None
        and np.diff(flown[1:]) == pytest.approx(2.0, abs=0.3)
        and len(flown) > 5
    )
    beyond = AHEAD > 60.0
    assert (
        np.diff(twin.prediction.ensemble_spread[beyond], axis=0) > 0
    ).all() and twin.prediction.ensemble_spread.shape == (len(AHEAD), 3)


def test_who_renews_often_does_less_heavy_work_in_one_sweep() -> None:
    paces = [Schedule(renew=renew) for renew in (1e-3, 0.1, 0.15, 9.0)]
    most = [Worker(MemoryBus(), range(1), omega=0.0, schedule=pace).quota.max_limit for pace in paces]
    assert most == pytest.approx([0.03, 0.03, 0.045, WORK_PER_SWEEP_S])
    assert Worker(MemoryBus(), range(1), omega=0.0).quota.max_limit == WORK_PER_SWEEP_S


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere threads have no priority of their own")
def test_who_gets_ready_gives_way_to_those_that_hold_aircraft(monkeypatch: pytest.MonkeyPatch) -> None:
    """On threads of their own: nobody gets a priority back that was given away."""
    nice, before, now = [], os.getpriority(os.PRIO_PROCESS, threading.get_native_id()), [100.0]
    monkeypatch.setattr("twin_worker.__main__.time.monotonic", lambda: now[0])

    def step() -> None:
        nice.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) - before)
        now[0] += 10.0

    low, later = (min(before + increment, 19) - before for increment in NICE_INCREMENTS)
    for limit_s, found in ((1e6, [low] * 4), (15.0, [low, low, later, later]), (0.0, [later] * 4)):
        nice.clear()
        reported: list[float] = []
        run_at_low_priority(iter([step] * 4), limit_s, reported.append)
        assert nice == found and reported, "it ends on a busy machine as well"
    step()
    assert nice[-1] == 0


def test_what_gets_ready_at_low_priority_is_all_that_a_worker_imports() -> None:
    code = (
        "import sys; from twin_worker import __main__ as main\n"
        "for step in main._preparation(): step()\n"
        "before = set(sys.modules)\n"
        "from twin_worker.mismatch.process import DiagnosisProcess\n"
        "from twin_worker.service.work_rates import counters\n"
        "from twin_worker.service.worker import Worker\n"
        "print(sorted(set(sys.modules) - before))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, "[]"), done.stderr[-2000:]


def test_who_could_not_even_be_renewed_is_the_first_to_be_flown_ahead() -> None:
    worker, now = Worker(MemoryBus(), range(4), omega=0.0), time.monotonic()
    for uav in range(4):
        worker._twins.acquire(uav, 1, None)
        held = worker._owned[uav]
        held.ready, held.published_at = True, now - (60.0 if uav == 2 else 0.0)
    found = []
    for turn in range(4):  # the budget of each sweep is enough for the first two, and each aircraft has its own clock
        for uav, held in worker._owned.items():
            held.twin.telemetry.step(1e9 / (uav + 1) + turn)
        found.append([held.twin.config.uav for held in worker._sweep_order()])
        for uav in found[-1][:2]:
            twin = worker._owned[uav].twin
            twin.prediction.predict_timer.restart(twin.telemetry.last_step_t)
    assert [order[0] for order in found] == [2] * 4
    assert [order[1] for order in found] == [0, 1, 3, 0]  # then whoever waits longest
