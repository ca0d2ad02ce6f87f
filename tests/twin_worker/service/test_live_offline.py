"""Live equals offline: one recording gives the same answers however its messages are grouped."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from fleet.contract import Alert, Event, Message, Model, Prediction, Sample
from fleet.telemetry.recording.recordings import replay_messages
from tests.support import hover
from tests.support.memory_bus import MemoryBus
from twin_worker.evaluation.replay import run_offline
from twin_worker.service import worker as live
from twin_worker.service.worker import Worker
from twin_worker.twin.state.budget import LIVE_SCHEDULE, Schedule
from twin_worker.twin.step import Twin

KINDS = (Model, Prediction, Alert)


@pytest.fixture(autouse=True)
def clock(monkeypatch) -> list[float]:
    """The wall clock, which stands still until a test moves it."""
    now = [1000.0]
    monkeypatch.setattr(live.time, "monotonic", lambda: now[0])
    return now


def lived(heard: Iterable[Message], seed: int, most: int = 40, schedule: Schedule | None = None) -> list[Message]:
    """What a worker publishes that hears the messages in bursts of any size."""
    rng, bus, told = np.random.default_rng(seed), MemoryBus(), []
    for kind in KINDS:
        bus.subscribe(kind, lambda message, _: told.append(message))
    worker = Worker(bus, range(1, 256), omega=0.0, schedule=schedule)
    worker.connect()
    left = 0
    for message in heard:
        if not left:
            worker.sweep()
            left = int(rng.integers(1, most))
        bus.publish(message)
        left -= 1
    worker.sweep()
    assert worker.state().sentence == ""
    return told


def matrices(model: Model) -> list[np.ndarray]:
    axes = [axis for axis in (model.longitudinal, model.lateral) if axis is not None]
    return [a.numpy() for axis in axes for a in (axis.A, axis.B, axis.x_trim, axis.u_trim)]


def same(one: list[Message], other: list[Message], uav: int) -> tuple[int, int]:
    """Compare everything said of one aircraft; give how many models and predictions that was."""
    pairs = [[[m for m in said if m.uav == uav and isinstance(m, kind)] for said in (one, other)] for kind in KINDS]
    for said in pairs:
        assert len(said[0]) == len(said[1])
    models, made, alerts = (list(zip(*said, strict=True)) for said in pairs)
    assert all(a == b for a, b in alerts)
    for a, b in models:
        assert (a.t, a.verdict.outcome, a.verdict.sentence) == (b.t, b.verdict.outcome, b.verdict.sentence)
        assert len(matrices(a)) == len(matrices(b))
        assert all(np.allclose(x, y, rtol=0, atol=1e-9) for x, y in zip(matrices(a), matrices(b), strict=True))
    for a, b in made:
        assert (a.t, a.method, a.state, a.sentence, a.seq) == (b.t, b.method, b.state, b.sentence, b.seq)
        assert np.abs(a.path.numpy() - b.path.numpy()).max() < 1e-3
        assert np.abs(a.prediction_region_half_axes.numpy() - b.prediction_region_half_axes.numpy()).max() < 1e-3
    return len(models), len(made)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_pretend_flight_in_bursts_is_answered_as_one_by_one(heard, flown, seed):
    n_models, n_made = same(lived(heard, seed), flown[1], 1)
    assert n_models > 5 and n_made > 60


def test_work_that_is_put_off_is_put_off_alike_in_bursts(heard: tuple) -> None:
    twins = {1: Twin.of(1, omega=0.0, schedule=LIVE_SCHEDULE)}
    n_models, n_made = same(lived(heard[:900], 3, schedule=LIVE_SCHEDULE), list(run_offline(heard[:900], twins)), 1)
    assert n_models and n_made > 40


def test_a_multirotor_in_bursts_is_answered_as_one_by_one():
    flown = hover.fly(3).messages[:500]
    _, n_made = same(lived(flown, 4), list(run_offline(flown, {})), 7)
    assert n_made > 60


def test_a_recorded_flight_in_bursts_is_answered_as_one_by_one(recordings: Path):
    start, stretch = None, []
    for message in replay_messages(recordings / "sitl" / "s02_nominal_light_wind.tlog.xz"):
        start = message.t if start is None else start
        if message.t > start + 110.0:
            break
        if message.t > start + 30.0 or not isinstance(message, Sample):
            stretch.append(message)
    n_models, n_made = same(lived(stretch, 5), list(run_offline(stretch, {})), stretch[0].uav)
    assert n_models > 3 and n_made > 40


def test_a_silence_in_the_data_is_met_on_the_same_beat(heard, sighted):
    start = heard[0].t
    gap = [m for m in heard if m.t < start + 40.0 or m.t > start + 52.0][:700]
    offline = list(run_offline(gap, {}))
    _, made = same(lived(gap, 7), offline, 1)
    coasting = [m for m in offline if isinstance(m, Prediction) and m.coast_s]
    assert made and int(sighted) - 5 <= len(coasting) <= int(sighted) + 1
    assert [m.active for m in offline if isinstance(m, Alert)] == [True, False]


def test_a_worker_whose_data_fall_silent_coasts_and_finds_its_beat_again(heard, clock):
    """The wall clock may run ahead of late data: what is said of the data after it is the same."""
    start = heard[0].t
    bus, told = MemoryBus(), []
    bus.subscribe(Prediction, lambda message, _: told.append(message))
    worker = Worker(bus, range(1, 2), omega=0.0)
    worker.connect()
    for message in heard:
        if message.t > start + 15.0:
            break
        if clock[0] == 1000.0 and message.t > start + 8.0:
            worker.sweep()
            for _ in range(20):
                clock[0] += 1.0
                worker.sweep()
        bus.publish(message)
    worker.sweep()
    (over,) = [p for p in told if p.event is Event.COASTING_EXPIRED]
    assert over.coast_s > 3.0 and over.horizon_s == 0.0
    late = [p for p in told if not p.coast_s and p.t > start + 9.0]
    assert len(late) >= 5 and all("link lost" not in p.sentence for p in late)
