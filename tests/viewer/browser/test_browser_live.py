"""The page of twins that run: a recorded flight in real time, with the schedule of `twin_worker` without `--pace`."""

import time
from collections import defaultdict
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from fleet.contract import FleetState, Message, Prediction
from fleet.telemetry.recording.recordings import replay_messages
from tests.support.memory_bus import MemoryBus
from tests.support.pretend_feed import STAMP
from tests.viewer.test_browser_sizes import compare_places, page_of
from twin_worker.twin.state.budget import LIVE_SCHEDULE
from twin_worker.twin.step import Twin, advance, fleet_row

pytestmark = pytest.mark.browser
FLIGHT, AHEAD_S = "sitl/s10_multi3_nominal.tlog.xz", 100.0  # recording, and part of it flown before the page opens [s]


class RunningTwins:
    """Twins of a recording on a bus: `advance(t)` publishes its messages and their results up to a time."""

    def __init__(self, bus: MemoryBus, flight: str) -> None:
        self._bus, self._second = bus, 0
        self.predictions: list[Prediction] = []
        self._twins: dict[int, Twin] = {}
        self._messages = replay_messages(flight)
        self._next: Message = next(self._messages)
        self._offset_s = self._next.t
        self._until(self._next.t + AHEAD_S)
        self._offset_s = self._next.t - time.time()  # recorded time at the real one

    def advance(self, t: float) -> None:
        self._until(t + self._offset_s)

    def _until(self, end: float) -> None:
        while self._next.t <= end:
            message = self._next
            self._bus.publish(message)
            twin = self._twins.setdefault(message.uav, Twin.of(message.uav, schedule=LIVE_SCHEDULE))
            for result in advance(twin, (message,)):
                self._bus.publish(result, STAMP)
                self.predictions += [result] if isinstance(result, Prediction) else []
            self._next = next(self._messages)
        if int(end) > self._second:
            self._second = int(end)
            self._bus.publish(FleetState(t=end, rows=tuple(fleet_row(one, end) for one in self._twins.values())), STAMP)


@pytest.fixture(scope="module")
def live(chromium: str, recordings) -> Iterator[SimpleNamespace]:
    """The page of three aircraft that fly."""
    with page_of(chromium, lambda bus: RunningTwins(bus, str(recordings / FLIGHT))) as site:
        yield site


def test_all_places_show_what_twins_publish_with_the_schedule_of_a_worker(live: SimpleNamespace) -> None:
    """Rollouts are renewed every second and made anew after 10 s: horizons become shorter than a prediction is old."""
    by_uav = defaultdict(list)
    for one in list(live.predictions):
        by_uav[one.uav].append(one.rollout_age_s)
    for uav in sorted(by_uav):
        compare_places(live, uav)
    ages = [age for values in by_uav.values() for age in values]
    assert len(by_uav) == 3 and max(ages) > 1.0 and ages.count(0.0) < 0.7 * len(ages) and live.errors == []
