"""Wind between workers: any twin contributes, one worker estimates, the next takes over, bad messages are rejected."""

import time

import numpy as np
import pytest
from msgspec.structs import replace

from fleet.bus.codec import Stamp
from fleet.commands.live.status import wind_text
from fleet.contract import FleetRow, FleetState, TwinState, WindField
from tests.support.examples import EXAMPLES
from tests.support.memory_bus import MemoryBus
from tests.twin_worker.estimation.test_wind_field import T, estimate
from twin_worker.service import wind_sharing
from twin_worker.service.wind_sharing import WindSharing
from twin_worker.service.worker import Worker


def worker(bus: MemoryBus, name: int) -> Worker:
    bus.writer = name  # the id is taken when the worker is made
    one = Worker(bus, range(100), omega=2.0)  # type: ignore[arg-type]
    one.wind_sharing.connect()
    return one


def table(uavs: range, t: float) -> FleetState:
    places = {uav: np.array([100.0 * uav, -50.0 * uav, -100.0]) for uav in uavs}
    rows = [
        FleetRow(uav=uav, state=TwinState.PREDICTING, verdict="", wind=estimate(t, p, np.array([4.0, -2.0])))
        for uav, p in places.items()
    ]
    return FleetState(t=t, rows=tuple(rows))


def contribute(bus: MemoryBus) -> None:
    """Publish tables of two workers."""
    for t in np.arange(T, T + 60.0, 5.0).tolist():
        bus.publish(table(range(3), t))
        bus.publish(table(range(3, 6), t))


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> tuple[MemoryBus, list[WindSharing], list[tuple[WindField, Stamp]]]:
    """Two workers on one bus that see each other, and the fields they publish."""
    bus, published = MemoryBus(), []
    workers = [worker(bus, name) for name in (0xA, 0xB)]
    for one, other in (workers, workers[::-1]):
        one.ownership.state.on_join(other.ownership.worker_id, range(100), 1)
        one.ownership.state.tick(time.monotonic(), True)
    bus.subscribe(WindField, lambda message, stamp: published.append((message, stamp)))
    monkeypatch.setattr(wind_sharing, "_PERIOD_S", 0.0)
    contribute(bus)
    return bus, [one.wind_sharing for one in workers], published


def test_one_worker_estimates_from_the_aircraft_of_all(seen) -> None:
    _, sharing, published = seen
    assert sum(one.is_assigned() for one in sharing) == 1
    for one in sharing:
        one.step()
    assert len(published) == 1
    wind_field = published[0][0]
    assert wind_field.uavs == tuple(range(6))
    np.testing.assert_allclose(wind_field.wind, (4.0, -2.0), atol=0.3)
    assert [one.latest for one in sharing] == [wind_field, wind_field]


def test_the_other_takes_over_at_once_with_a_higher_epoch(seen) -> None:
    _, sharing, published = seen
    first, second = sorted(sharing, key=lambda one: not one.is_assigned())
    first.step()
    gone = first._ownership.state
    second._ownership.state.on_leave(gone.worker_id, 1)
    second.step()
    first.step()  # not yet aware of it: its field is outdated
    assert len(published) == 3 and published[1][1].epoch > published[0][1].epoch
    assert second.latest is published[1][0] or second.latest == published[1][0]
    assert second._stamp == published[1][1] and first._stamp == published[1][1]


def test_an_estimate_waits_while_aircraft_change_hands(seen) -> None:
    _, sharing, published = seen
    (estimator,) = [one for one in sharing if one.is_assigned()]
    estimator._ownership._count_transfer()
    estimator.step()
    assert not published
    estimator._ownership._transferred_t = float("-inf")
    estimator.step()
    assert len(published) == 1


def test_bad_messages_are_counted_and_change_nothing(seen, caplog: pytest.LogCaptureFixture) -> None:
    bus, sharing, _ = seen
    for one in sharing:
        one.step()
    before, stamp = sharing[0].latest, Stamp(time.time_ns() // 1_000_000 + 1, 0xF)
    bad = replace(EXAMPLES[WindField], sigma=-1.0)
    bus.publish(bad, stamp)
    bus.publish(EXAMPLES[WindField])  # without a stamp
    bus.publish(EXAMPLES[WindField], Stamp(2**63, 0xF))  # of an implausible epoch
    bus.publish(EXAMPLES[WindField], Stamp(1, 0xF))  # of an old one
    row = table(range(1), T + 60.0).rows[0]
    assert row.wind is not None
    hostile = replace(row, wind=replace(row.wind, wind=(1e9, 0.0)))
    bus.publish(FleetState(t=T, rows=(hostile,)))
    assert [one.latest for one in sharing] == [before, before]
    assert [one.rejected for one in sharing] == [4, 4]
    assert "expected positive ones" in caplog.text and "uav-0, wind estimate: found a wind" in caplog.text


def test_a_field_that_is_not_renewed_is_forgotten(seen) -> None:
    bus, sharing, _ = seen
    for one in sharing:
        one.step()
    owned = type("Owned", (), {"twin": Worker(bus, range(9), omega=2.0)._create_twin(3)})()
    sharing[0].apply(owned)
    assert owned.twin.environment.wind_field is sharing[0].latest is not None
    sharing[0]._received_t -= 61.0
    sharing[0].apply(owned)
    assert owned.twin.environment.wind_field is None and sharing[0].latest is None


def test_fleet_status_states_the_wind_and_its_aircraft(seen) -> None:
    bus, sharing, _ = seen
    assert wind_text(bus) == ""
    for one in sharing:
        one.step()
    assert wind_text(bus).startswith("wind field: 4.") and wind_text(bus).endswith("estimated from 6 aircraft")
    assert "m/s from 15" in wind_text(bus)  # it blows to (4, -2)
