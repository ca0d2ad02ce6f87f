"""The live driver on a bus in memory: its range, its answers, its table, and peace between the aircraft."""

from collections import deque
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from fleet.bus.codec import Stamp, decode, encode
from fleet.contract import (
    Array,
    FleetState,
    Message,
    Mission,
    Model,
    Params,
    Prediction,
    Predictions,
    Sample,
    Status,
    TwinState,
)
from tests.support import flights as f
from tests.support.flights import item
from tests.support.memory_bus import MemoryBus
from twin_worker.ownership.twin_store import INBOX_SIZE
from twin_worker.service import worker as live
from twin_worker.service.busy_fallback import take_backlog
from twin_worker.service.queries import latest_prediction as told_of
from twin_worker.service.worker import Worker
from twin_worker.twin.state import budget
from twin_worker.whatif import read_grid, resample

NAN = float("nan")


class Bus(MemoryBus):
    """A bus in memory that also carries what a query asks for."""

    def query(self, kind: type, uav: int | None = None, **asked: str) -> list:
        found = (answer for reply in self._query_handlers[kind] for answer in reply(uav, asked, b""))
        return [(decode(kind, encode(message)), stamp) for message, stamp in found]


@pytest.fixture
def bus() -> Bus:
    return Bus()


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    """The wall clock, which stands still until a test moves it."""
    now = [1000.0]
    monkeypatch.setattr(live.time, "monotonic", lambda: now[0])
    return now


@pytest.fixture
def worker(bus, clock) -> Worker:
    made = Worker(bus, range(2, 5), omega=0.0)
    made.connect()
    return made


@pytest.fixture(scope="session")
def heard(tmp_path_factory) -> tuple[Message, ...]:
    return f.pretend(tmp_path_factory.getbasetemp())


def told(bus: Bus, kind: type) -> list:
    """Collect what is published from now on: (message, stamp)."""
    found: list = []
    bus.subscribe(kind, lambda message, stamp: found.append((message, stamp)))
    return found


def fly(bus: Bus, uav: int, seconds: float = 6.0) -> None:
    """Let an aircraft circle."""
    for message in f.messages(f.turn(seconds), uav=uav):
        bus.publish(message)


def test_it_holds_its_range_and_nothing_else(bus, worker):
    for uav in (1, 2, 4, 5, 900):
        fly(bus, uav, 3.0)
    worker.sweep()
    assert [held.twin.config.uav for held in worker.owned_twins()] == [2, 4]
    assert [row.uav for row in worker.state().rows] == [2, 4]


def test_a_recorded_flight_is_learnt_live(bus, worker, heard):
    models, made = told(bus, Model), told(bus, Prediction)
    for message in heard:
        bus.publish(msgspec.structs.replace(message, uav=3))
    assert worker.sweep() == len(heard)
    assert any(m.verdict.outcome.is_accepted for m, _ in models)
    assert {"dynamics", "hybrid", "both"} & {p.method for p, _ in made}
    (row,) = worker.state().rows
    assert (row.uav, row.state) == (3, TwinState.PREDICTING)
    assert row.worker == f"{bus.writer:016x}" and row.epoch > 1.6e12
    assert row.fit and row.verdict.startswith("uav-3: ")
    assert row.sample_age_s == pytest.approx(0.0)


def test_the_paper_s_method_may_be_asked_for(bus, clock, heard):
    models = told(bus, Model)
    worker = Worker(bus, range(1, 2), omega=0.0, method="paper")
    worker.connect()
    for message in heard:
        bus.publish(message)
    worker.sweep()
    assert models and {m.method for m, _ in models} == {"paper"}
    assert all(m.derivatives is None for m, _ in models)
    assert any(m.longitudinal is not None for m, _ in models)


def test_results_carry_the_claim(bus, worker):
    made = told(bus, Prediction)
    fly(bus, 2)
    worker.sweep()
    (held,) = worker.owned_twins()
    assert made and {stamp for _, stamp in made} == {Stamp(held.epoch, bus.writer)}


def test_wildcard_queries_are_answered_with_stamps(bus, worker):
    assert bus.get(Prediction) == []
    for uav in (2, 3, 4):
        fly(bus, uav)
    worker.sweep()
    found = bus.get(Prediction)
    assert [p.uav for p, _ in found] == [2, 3, 4]
    assert all(stamp is not None and stamp.writer == bus.writer for _, stamp in found)
    assert [p.uav for p, _ in bus.get(Prediction, 3)] == [3]
    assert bus.get(Prediction, 9) == []
    ((table, _),) = bus.get(FleetState)
    assert [row.uav for row in table.rows] == [2, 3, 4]


def test_one_answer_has_them_all(bus, worker):
    assert [one.predictions for one, _ in bus.get(Predictions)] == [()]
    for uav in (2, 3):
        fly(bus, uav)
    worker.sweep()
    each = bus.get(Prediction)
    ((batch, _),) = bus.get(Predictions)
    assert [decode(Prediction, bytes(raw)) for raw in batch.predictions] == [made for made, _ in each]
    assert list(batch.epochs) == [stamp.epoch for _, stamp in each]


def test_an_answer_is_packed_once_and_anew_when_there_is_another_prediction(bus, worker):
    fly(bus, 2)
    worker.sweep()
    (held,) = worker.owned_twins()
    first = told_of(held)
    assert told_of(held) is first and first.message().controller == held.twin.prediction.controller.to_message()
    held.twin.prediction.latest = msgspec.structs.replace(
        held.twin.prediction.latest, t=held.twin.prediction.latest.t + 1.0
    )
    assert told_of(held).message().t == first.message().t + 1.0


def test_a_query_chooses_horizon_and_step(bus, worker):
    fly(bus, 2)
    worker.sweep()
    ((whole, _),) = bus.query(Prediction)
    ((asked, _),) = bus.query(Prediction, horizon="30", step="0.5")
    assert np.array_equal(asked.ahead.numpy(), np.arange(0, 30.25, 0.5))
    assert asked.path.shape == asked.prediction_region_half_axes.shape == (61, 3)
    assert np.allclose(asked.path.numpy()[::2], whole.path.numpy()[:31])
    assert np.allclose(asked.path.numpy()[1], whole.path.numpy()[:2].mean(axis=0), atol=1.0)
    assert (asked.t, asked.horizon_s) == (whole.t, whole.horizon_s)


def test_a_query_cuts_no_corner_where_look_aheads_are_far_apart(bus, worker):
    fly(bus, 2)
    worker.sweep()
    ((whole, _),) = bus.query(Prediction)
    t = whole.ahead.numpy().astype(float)
    path = 80.0 * np.column_stack([np.cos(t / 4), np.sin(t / 4), 0 * t])
    circle = msgspec.structs.replace(whole, path=Array.of(path))
    asked = resample(circle, read_grid({"horizon": "180"}))
    assert len(asked.path.numpy()) == 181
    assert np.allclose(np.linalg.norm(asked.path.numpy(), axis=1), 80.0, atol=2.0)  # a chord lies 10 m inside
    cut = {
        name: Array.of(getattr(whole, name).numpy()[:70]) for name in ("ahead", "path", "prediction_region_half_axes")
    }
    short = resample(msgspec.structs.replace(whole, **cut), read_grid({"horizon": "180"}))
    assert short.ahead.numpy()[-1] == 96.0  # no further than it was flown


@pytest.mark.parametrize(
    "asked",
    [
        {"horizon": "soon"},
        {"horizon": "nan"},
        {"horizon": "inf"},
        {"horizon": "-1"},
        {"horizon": "0"},
        {"horizon": "181"},
        {"step": "0"},
        {"step": "-0.5"},
        {"step": "nan"},
        {"step": "inf"},
        {"step": "1e-9"},
        {"step": "1e-320"},
        {"step": ""},
    ],
)
def test_absurd_queries_are_refused_with_a_sentence(bus, worker, asked):
    with pytest.raises(ValueError, match=r"query: found .*;"):
        bus.query(Prediction, **asked)


def test_what_a_query_may_ask():
    assert read_grid({}) is None and read_grid({"colour": "red"}) is None
    assert read_grid({"horizon": "2"}).tolist() == [0.0, 1.0, 2.0]
    assert len(read_grid({"step": "0.18"})) == 1001
    assert read_grid({"horizon": "180", "step": "60"}).tolist() == [0.0, 60.0, 120.0, 180.0]
    assert len(read_grid({"horizon": "60", "step": "60"})) == 2


def test_resampling_nothing_gives_the_whole(bus, worker):
    fly(bus, 2)
    worker.sweep()
    ((whole, _),) = bus.query(Prediction)
    assert resample(whole, None) is whole


def test_it_asks_for_what_was_said_before_it_came(bus):
    mission = Mission(uav=3, t=f.T0, items=(item(0), item(1, north=100.0)), complete=True)
    for message in (mission, Params(uav=3, t=f.T0, values={"A": 1.0}), Status(uav=3, t=f.T0, mode="AUTO")):
        bus.declare_queryable(type(message), lambda uav, asked, payload, message=message: [(message, None)])
    worker = Worker(bus, range(2, 5), omega=0.0)
    worker.connect()
    worker.sweep()
    (held,) = worker.owned_twins()
    assert (
        held.twin.onboard.mission == mission
        and held.twin.onboard.params.values == {"A": 1.0}
        and held.twin.onboard.status.mode == "AUTO"
    )


GARBAGE = (
    Sample(uav=2, t=f.T0, position=f.rows([f.T0], [[NAN, NAN, NAN]])),
    Sample(uav=2, t=f.T0, position=f.rows([f.T0], [[1.0, 2.0]])),
    Sample(uav=2, t=f.T0, position=f.rows(np.empty(0), np.empty((0, 3)))),
    Sample(uav=2, t=NAN, attitude=f.rows([NAN], [[NAN] * 6])),
    Sample(uav=2, t=1e300, air=f.rows([1e300], [[1e300] * 3])),
    Params(uav=2, t=NAN, values={"SERVO1_FUNCTION": NAN, "SERVO2_MIN": float("inf"), "NAVL1_PERIOD": NAN}),
    Mission(uav=2, t=NAN, items=(item(0), item(1, 177, param1=NAN, param2=NAN), item(1, alt_m=NAN)), seq=-7),
    Status(uav=2, t=NAN, mode="\0", clock_jumps=-1, rates_hz={"": NAN}),
)


def test_garbage_of_one_does_not_stop_the_others(bus, worker):
    made = told(bus, Prediction)
    for message in GARBAGE:
        bus.publish(message)
        fly(bus, 3, 3.0)
        worker.sweep()
        fly(bus, 2, 3.0)
        worker.sweep()
    assert 3 in {p.uav for p, _ in made}
    assert [row.uav for row in worker.state().rows] == [2, 3]
    assert worker.state().sentence == ""  # nothing even failed


def test_a_failure_of_one_is_counted_said_and_stays_its_own(bus, worker, monkeypatch):
    advance = live.advance

    def fragile(twin, *told):
        if twin.config.uav == 2:
            raise RuntimeError("a defect")
        return advance(twin, *told)

    monkeypatch.setattr(live, "advance", fragile)
    made = told(bus, Prediction)
    for uav in (2, 3):
        fly(bus, uav)
    worker.sweep()
    assert {p.uav for p, _ in made} == {3}
    assert "uav-2" in worker.state().sentence and "a defect" in worker.state().sentence
    monkeypatch.setattr(live, "advance", advance)
    fly(bus, 2, 8.0)
    worker.sweep()
    assert {p.uav for p, _ in made} == {2, 3}  # and it goes on with the next message


def test_a_flood_sheds_the_oldest_and_says_so(bus, worker):
    status = Status(uav=2, t=f.T0)
    for _ in range(INBOX_SIZE + 7):
        bus.publish(status)
    assert worker.sweep() == INBOX_SIZE
    assert "7 messages dropped" in worker.state().sentence


def test_an_overloaded_worker_takes_the_newest_telemetry_of_each_and_counts_the_rest(bus, worker):
    """Else the queue holds minutes, and so do the predictions, although the newest seconds would have sufficed."""
    made = told(bus, Prediction)
    fly(bus, 2)
    worker.sweep()
    bus.publish(Params(uav=2, t=f.T0 + 6.0, values={"TECS_SPDWEIGHT": 1.5}))
    fly(bus, 2, 60.0)
    waiting = sum(len(owned.inbox) for owned in worker.owned_twins())
    worker.quota.limit, worker.quota.overloaded = 1.0, True
    assert worker.sweep() == waiting
    owned = next(owned for owned in worker.owned_twins() if owned.twin.config.uav == 2)
    assert not owned.inbox and owned.dropped == worker.state().dropped_messages
    assert waiting - 45 < owned.dropped < waiting - 15  # two seconds at ten samples a second, and what is no sample
    assert made[-1][0].t == pytest.approx(f.T0 + 60.0, abs=0.5)
    assert owned.twin.onboard.params is not None and owned.twin.onboard.params.values["TECS_SPDWEIGHT"] == 1.5


def test_an_overloaded_worker_takes_what_arrived_last_also_where_a_clock_was_set_back():
    ahead, behind = (Sample(uav=2, t=t) for t in (f.T0 + 500.0, f.T0))
    owned = SimpleNamespace(inbox=deque([ahead, behind]), dropped=0)
    assert behind in take_backlog(owned, 2, overloaded=True)
    owned = SimpleNamespace(inbox=deque([behind, ahead]), dropped=0)
    assert take_backlog(owned, 2, overloaded=True) == [ahead] and owned.dropped == 1


def test_a_worker_is_overloaded_where_its_own_cpu_time_of_a_sweep_is_long(monkeypatch):
    used = [0.0]
    monkeypatch.setattr(budget.time, "thread_time", lambda: used[0])
    quota = budget.ComputeBudget(max_limit=0.05)
    for seconds, late, overloaded in ((0.0, True, False), (0.6, True, False), (2.0, True, True), (2.0, False, False)):
        used[0] += seconds
        quota.yield_to_telemetry(late)
        assert quota.overloaded is overloaded


def test_a_silent_aircraft_ages_by_the_wall_clock(bus, worker, clock):
    made = told(bus, Prediction)
    fly(bus, 2)
    worker.sweep()
    for _ in range(4):
        clock[0] += 1.0
        worker.sweep()
    assert made[-1][0].state is TwinState.LINK_LOST and made[-1][0].coast_s == pytest.approx(4.0, abs=0.5)
    (row,) = worker.state().rows
    assert row.sample_age_s == pytest.approx(4.0, abs=0.5) and row.state is TwinState.LINK_LOST


def test_samples_of_a_predicting_aircraft_are_collected_and_nothing_else_waits(bus, worker, clock, heard):
    own = [msgspec.structs.replace(message, uav=3) for message in heard]
    for message in own:
        bus.publish(message)
    worker.sweep()
    owned = worker.owned_twins()[0]
    assert owned.twin.prediction.latest is not None
    worker._collecting_s = 0.25
    rest = f.shifted([m for m in own if isinstance(m, Sample)][-9:], 1.0, 1e9)
    taken = []
    for sample in rest:
        clock[0] += 0.1
        bus.publish(sample)
        taken.append(worker.sweep())
    assert taken == [0, 0, 3] * 3
    bus.publish(next(m for m in own if isinstance(m, Status)))
    assert worker.sweep() == 1, "a status is processed at once"
    owned.twin.prediction.latest = None
    bus.publish(rest[0])
    assert worker.sweep() == 1, "before the first prediction nothing is collected"


def test_garbled_bytes_on_the_bus_are_counted(bus, worker):
    bus.deliver(Sample, b"\xc1 no msgpack", "application/msgpack;parauav.sample.1")
    bus.deliver(Sample, b"\x80", "application/msgpack;parauav.sample.99")
    assert bus.bad == 2 and worker.sweep() == 0


def test_who_has_no_news_is_left_alone_until_it_falls_silent(bus, worker, clock, monkeypatch):
    fly(bus, 2)
    fly(bus, 3)
    worker.sweep()
    turned, really = [], live._advance_all
    monkeypatch.setattr(
        live, "_advance_all", lambda held, *more: turned.append(held.twin.config.uav) or really(held, *more)
    )
    assert worker.sweep() == 0 and turned == []
    bus.publish(f.messages(f.turn(7.0), uav=3)[-1])
    assert worker.sweep() == 1 and turned == [3]
    for _ in range(2):
        clock[0] += 0.75
        worker.sweep()
    assert sorted(turned) == [2, 3, 3]
    with worker.owned_twins()[0].lock:  # it is worked on, which must not be waited for
        bus.publish(f.messages(f.turn(7.0), uav=2)[-1])
        assert worker.sweep() == 1 and turned.count(2) == 1
