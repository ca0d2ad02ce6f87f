"""Telemetry that falls behind its arrival: a slow simulator, a paused one, a late one. Silence is judged by arrival."""

import msgspec
import numpy as np
import pytest

from fleet.contract import Alert, AlertKind, Event, Link, Sample, Status, TwinState
from fleet.simulator.flight import drive as simulator
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from tests.support import flights as f
from tests.support.flights import predictions, published
from tests.support.late_arrival import ARRIVALS, Datagram, flight, lived, relayed
from tests.support.memory_bus import MemoryBus
from tests.support.talker import T0, Talker
from twin_worker.evaluation.replay import run_offline
from twin_worker.service import worker as live
from twin_worker.service.worker import Worker
from twin_worker.twin.step import advance

SECONDS = 75.0


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    """The wall clock, which stands still until a test moves it."""
    now = [1000.0]
    monkeypatch.setattr(live.time, "monotonic", lambda: now[0])
    return now


@pytest.fixture(scope="module")
def sent() -> list[Datagram]:
    return flight(SECONDS)


@pytest.mark.parametrize("name", ARRIVALS)
def test_a_link_with_telemetry_is_not_lost_and_predictions_are_back_at_once(sent, clock, name):
    judge = lived(relayed(sent, ARRIVALS[name]), lambda now: clock.__setitem__(0, now))
    found, pauses = judge.found, ARRIVALS[name].pauses
    pauses = [begin for begin, _ in pauses if begin < SECONDS]
    assert not found.false_losses and len(found.losses) == len(pauses)
    assert len(found.recovery_s) == len(pauses) and max(found.recovery_s, default=0.0) <= 2.0
    assert found.gap_s <= 2.0 / min(ARRIVALS[name].speed, 1.0) and found.predictions > 0.5 * SECONDS
    assert judge.made[-1].method != "imm"  # what was learnt before is kept
    assert bool(found.steps) == (name not in {"1", "1.5"})


def test_live_equals_offline_where_telemetry_is_dated_anew(sent, clock):
    ticks = list(relayed(sent[: len(sent) * 2 // 3], ARRIVALS["0.5"]))
    live_made = lived(ticks, lambda now: clock.__setitem__(0, now)).made
    made = predictions(run_offline([message for _, messages in ticks for message in messages], {}))
    assert [(p.t, p.method, p.event) for p in live_made] == [(p.t, p.method, p.event) for p in made]


# --- one twin ---------------------------------------------------------------------------------------------------------


def take(twin, messages) -> list:
    """Let data time follow from the messages alone."""
    return published(result for m in messages for result in advance(twin, (m,)))


def status(twin, t: float, **changes) -> Status:
    return msgspec.structs.replace(twin.onboard.status, t=t, **changes)


def paused(twin, behind: int) -> list:
    """Status messages while telemetry stands still for so many seconds."""
    return take(twin, [status(twin, twin.telemetry.history.newest + k) for k in range(1, behind + 1)])


def late(twin, heard, behind: float, seconds: float) -> list:
    """Telemetry that goes on where it stood still, with status messages that are ahead of it by `behind` [s]."""
    end = twin.telemetry.history.newest
    out, told = [], -np.inf
    for m in f.shifted(heard, end - f.T0, seconds):
        if isinstance(m, Sample):
            out.append(m)
            if m.t >= told + 1.0:
                told = m.t
                out.append(status(twin, m.t + behind))
    return out


def test_status_ahead_of_telemetry_is_no_silence(twin, heard):
    paused(twin, 10)
    assert twin.telemetry.link_lost
    end = twin.telemetry.history.newest
    results = take(twin, late(twin, heard, 10.0, 6.0))
    assert not twin.telemetry.link_lost and twin.prediction.state is not TwinState.LINK_LOST
    assert [r.active for r in results if isinstance(r, Alert) and r.kind is AlertKind.LINK_LOST] == [False]
    times = [end, *(p.t for p in predictions(results))]
    assert len(times) >= 5 and np.diff(times).max() <= 2.0 and not any(p.coast_s for p in predictions(results))
    newest = twin.telemetry.history.newest
    take(twin, [status(twin, newest + 10.0 + k) for k in range(1, 6)])  # now it is silent
    assert twin.telemetry.link_lost and twin.telemetry.history.newest == newest


def test_a_change_of_mode_is_dated_as_telemetry_is(twin, heard):
    paused(twin, 10)
    take(twin, late(twin, heard, 10.0, 3.0))
    newest = twin.telemetry.history.newest
    take(twin, [status(twin, newest + 10.0, mode="LOITER")])
    assert twin.onboard.plan_changed_t == pytest.approx(newest, abs=1.1)


def test_telemetry_dated_anew_keeps_what_was_learnt(twin, heard):
    paused(twin, 10)
    take(twin, late(twin, heard, 10.0, 5.0))
    newest, plant = twin.telemetry.history.newest, twin.models.active_model
    rows = len(twin.telemetry.history.rows("attitude")[0])
    anew = [m for m in f.shifted(heard, newest + 10.0 - f.T0, 8.0) if isinstance(m, Sample)]
    told = status(twin, newest + 10.1, clock_advance_s=10.0)
    results = take(twin, [anew[0], told, *anew[1:]])
    assert not twin.telemetry.link_lost and twin.models.active_model is plant is not None
    t = twin.telemetry.history.rows("attitude")[0]
    assert len(t) > rows and np.diff(t).max() < 1.0  # no gap, and nothing lost
    window = twin.window(30.0)
    assert window is not None and window.ok.mean() > 0.9
    first, *_ = predictions(results)
    assert first.event is Event.CLOCK and "10.0 s behind" in first.event_text
    assert first.t - newest - 10.0 < 2.0 and first.method != "imm"


def test_a_worker_that_stood_still_knows_of_no_silence(heard, clock):
    """What arrived while it stood still is not taken in yet when it looks for the first time."""
    bus, told = MemoryBus(), []
    for kind in (live.Alert, live.Prediction):
        bus.subscribe(kind, lambda message, _: told.append(message))
    worker = Worker(bus, range(1, 2), omega=0.0)
    worker.connect()
    start = heard[0].t
    for message in heard:
        if message.t > start + 12.0:
            break
        clock[0] = max(clock[0], 1000.0 + message.t - start)
        bus.publish(message)
        worker.sweep()
    for stall in (10.0, 0.1, 0.1):
        clock[0] += stall
        worker.sweep()
    assert all(row.state is not TwinState.LINK_LOST for row in worker.state().rows)
    for _ in range(30):
        clock[0] += 0.1
        worker.sweep()
    assert [row.state for row in worker.state().rows] == [TwinState.LINK_LOST]


# --- the gateway ------------------------------------------------------------------------------------------------------


def test_the_gateway_tells_once_that_it_dated_telemetry_anew():
    talker, intake, told = Talker(7), MavlinkReceiver(), []
    intake.receive(T0, talker.heartbeat())
    for k in range(800):
        boot, now = 100.0 + 0.1 * k, T0 + 0.1 * k + (10.0 if k >= 200 else 0.0)
        intake.receive(now, talker.attitude(boot) + (talker.heartbeat() if k % 10 == 0 else b""))
        told += intake.flush(now)
    statuses = [m for m in told if isinstance(m, Status)]
    steps = np.diff([s.clock_advance_s for s in statuses])
    assert np.count_nonzero(steps) == 1 and steps.max() == pytest.approx(10.0, abs=0.1)
    at = int(np.argmax(steps)) + 1
    assert "were re-anchored" in statuses[at].sentence and all(s.link is Link.LIVE for s in statuses)
    assert all(s.clock_jumps == 0 for s in statuses)
    before = told[told.index(statuses[at]) - 1]
    assert isinstance(before, Sample) and before.t - statuses[at].t == pytest.approx(0.0, abs=0.2)  # at once


# --- the simulator ----------------------------------------------------------------------------------------------------


def test_a_simulator_that_is_too_slow_slows_down_evenly_and_tells_its_speed_once():
    said: list[str] = []
    now, times = 50.0, [0.0]
    pace = simulator._SimulationClock(now, said.append)
    for _ in range(400):
        times.append(pace.advance(now))
        now += max(0.01, 1.6 * (times[-1] - times[-2]))  # of real time for each second simulated
    steps = np.diff(times)
    assert (steps >= 0.0).all() and steps.max() <= 0.1 + 1e-9  # no burst
    assert times[-1] / (now - 50.0) == pytest.approx(1 / 1.6, rel=0.05)
    assert len(said) == 1 and "found 0.6" in said[0] and "times real time" in said[0]


def test_a_simulator_that_was_paused_goes_on_from_there():
    said: list[str] = []
    pace, now = simulator._SimulationClock(0.0, said.append), 0.0
    for k in range(1000):
        now += 0.01 + (10.0 if k == 500 else 0.0)
        pace.advance(now)
    assert pace.t == pytest.approx(10.0, abs=0.6) and not said
