"""Conflicts through the drivers: the worker hears what others predict, offline judges all; status shows it."""

import io
import json

import msgspec
import numpy as np
import pytest
from rich.console import Console

from fleet.bus.codec import Stamp
from fleet.commands.live.status import fleet_rows, fleet_table
from fleet.contract import Alert, AlertKind, FleetRow, FleetState, Message, Prediction, Status, TwinState
from fleet.frames import to_geodetic
from tests.support import flights as f
from tests.support.memory_bus import MemoryBus
from tests.support.predicted import T, straight
from twin_worker.__main__ import main
from twin_worker.alerts.conflict_probability import Separation
from twin_worker.evaluation import replay as offline
from twin_worker.service import worker as live
from twin_worker.service.worker import Worker


def levelled(uav: int, east: float, heading: float, seconds: float = 30.0) -> list[Message]:
    """A level straight flight that is `east` m beside HERE at the start."""
    laid = f.turn(seconds, rate=0.0, psi=heading, bank=0.0)
    t, place = laid["position"]
    place = place + (to_geodetic(f.HERE, np.array([0.0, east, 0.0])) - np.array(f.HERE))
    return f.messages(laid | {"position": (t, place)}, uav=uav)


def opposite(gap: float = 1400.0) -> list[Message]:
    """Two that fly at each other, each heard in turn; nothing is known of a route."""
    both = levelled(1, 0.0, np.pi / 2) + levelled(2, gap, -np.pi / 2)
    return sorted(both, key=lambda message: message.t)


def conflicts(results) -> list[Alert]:
    return [m for m in results if isinstance(m, Alert) and m.kind is AlertKind.CONFLICT]


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    now = [1000.0]
    monkeypatch.setattr(live.time, "monotonic", lambda: now[0])
    return now


def test_offline_judges_every_pair() -> None:
    alerts = conflicts(offline.run_offline(opposite(), {}))
    assert alerts and (alerts[0].uav, alerts[0].other, alerts[0].active) == (1, 2, True)
    assert alerts[0].predicted_t == pytest.approx(f.T0 + 35.0, abs=6.0)
    assert alerts[0].t < alerts[0].predicted_t - 5.0  # a turn rate alone sees no farther


def test_a_worker_of_both_says_it_once_and_shows_it(clock) -> None:
    bus, told = MemoryBus(), []
    bus.subscribe(Alert, lambda message, stamp: told.append((message, stamp)))
    worker = Worker(bus, range(1, 3), omega=0.0)
    worker.connect()
    for message in opposite():
        bus.publish(message)
        worker.sweep()
    (raised,) = conflicts(m for m, _ in told if m.active)
    assert {stamp.writer for _, stamp in told} == {bus.writer}
    ((asked, stamp),) = bus.get(Alert)
    assert asked == raised and stamp.writer == bus.writer
    rows = {row.uav: row.alerts for row in worker.state().rows}
    assert rows == {1: (raised.sentence,), 2: ()}


@pytest.mark.parametrize(("held", "says"), [(range(1, 2), True), (range(2, 3), False)])
def test_of_two_workers_the_lower_id_s_owner_judges(clock, held: range, says: bool) -> None:
    """The other aircraft's prediction comes from elsewhere."""
    mine = held.start
    other = 3 - mine
    flown = [m for m in offline.run_offline(opposite(), {}) if isinstance(m, Prediction) and m.uav == other]
    heard = [m for m in opposite() if m.uav == mine]
    bus, told = MemoryBus(), []
    bus.subscribe(Alert, lambda message, _: told.append(message))
    worker = Worker(bus, held, omega=0.0)
    worker.connect()
    for message in sorted([*flown, *heard], key=lambda message: message.t):
        bus.publish(message, Stamp(5, 77) if isinstance(message, Prediction) else None)
        worker.sweep()
    assert [a.active for a in conflicts(told)][:1] == ([True] if says else [])


def test_of_two_writers_the_higher_epoch_is_believed(clock) -> None:
    worker = Worker(MemoryBus(), range(1, 2), omega=0.0)
    worker.connect()
    new, old = straight(2), straight(2, (0.0, 9e3, 0.0))
    worker.bus.publish(new, Stamp(9, 1))
    worker.bus.publish(old, Stamp(8, 2))
    worker.traffic.picture.update_slots()
    assert worker.traffic.picture.slot_of(2)[1].prediction.path == new.path


def test_a_separation_of_one_s_own_is_used() -> None:
    worker = Worker(MemoryBus(), range(1, 2), omega=0.0, separation=Separation(9.0, 4.0))
    assert worker.traffic.separation == (9.0, 4.0)


@pytest.mark.parametrize("text", ["50", "50,20,3", "a,b", "0,20", "-5,5", "nan,20", "inf,20"])
def test_an_absurd_separation_is_refused_in_a_sentence(text: str, capsys) -> None:
    with pytest.raises(SystemExit) as left:
        main([f"--separation={text}"])
    assert left.value.code == 2 and "expected two distances in m" in capsys.readouterr().err


def test_fleet_status_shows_alerts_as_written() -> None:
    bus = MemoryBus()
    row = FleetRow(uav=3, state=TwinState.PREDICTING, verdict="all is [well]", alerts=("uav-3: near [b]uav-4[/b]",))
    bus.declare_queryable(FleetState, lambda *_: [(FleetState(t=T, rows=(row,)), None)])
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(fleet_table(fleet_rows(bus)))
    text = console.export_text()
    assert "! uav-3: near [b]uav-4[/b]" in text and "all is [well]" in text


def test_fleet_status_colours_what_is_verified_and_what_is_only_plausible() -> None:
    states = (TwinState.VERIFIED, TwinState.PLAUSIBLE, TwinState.WAITING)
    table = fleet_table([FleetRow(uav=k, state=state, verdict="") for k, state in enumerate(states)])
    cells = list(table.columns[1].cells)
    assert [(str(cell), cell.style) for cell in cells] == [  # type: ignore[union-attr]
        ("verified", "green"),
        ("plausible", "yellow"),
        ("waiting", ""),
    ]


def test_alerts_are_strict_json() -> None:
    """A foreign tool may put them into JSON: no nan."""
    alerts = conflicts(offline.run_offline(opposite(), {}))
    assert all(json.loads(json.dumps(msgspec.to_builtins(a), allow_nan=False)) for a in alerts)


def test_without_any_worker_the_reason_is_its_first_start_and_with_one_its_range() -> None:
    bus = MemoryBus()
    status = Status(uav=7, t=1.0, mode="AUTO", armed=True, autopilot="ardupilot", vehicle="fixed_wing")
    bus.declare_queryable(Status, lambda *_: iter([(status, None)]))
    (row,) = fleet_rows(bus)
    assert row.state is TwinState.UNCLAIMED and "first start compiles" in row.verdict
    bus.declare_queryable(FleetState, lambda *_: iter([(FleetState(t=1.0), None)]))
    (row,) = fleet_rows(bus)
    assert row.state is TwinState.UNCLAIMED and "wider --uavs" in row.verdict
