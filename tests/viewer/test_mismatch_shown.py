"""The whole way live: a fault concealed in flight is flagged, located, named in the viewer, and predicted with."""

import copy

import numpy as np
import pytest

from fleet.contract import DiagnosisOutcome, Message, Mismatch, Prediction, Sample
from tests.bench.mismatch.flown import Inline, errors
from tests.bench.mismatch.world import FAULT, ONSET_S, baseline, messages
from tests.support.memory_bus import MemoryBus
from twin_worker.mismatch.coordinator import ALL_UAVS, Coordinator
from twin_worker.service.worker import OwnedTwin, Worker
from viewer.panels.detail import status_html
from viewer.store.store import FleetStore
from viewer.theme.palette import DARK

UAV, SEED, END_S = 1, 6, 215
WITHIN_S = 60.0  # of the fault, named and shown
AFTER_S = 30.0  # of predictions that are compared
AHEAD_S = 30


class Station:
    """A worker and, on the same bus, a viewer and whoever keeps what is said."""

    def __init__(self, diagnosis: Coordinator | None) -> None:
        self.bus, self.said = MemoryBus(), []
        self.worker = Worker(self.bus, range(UAV, UAV + 1), omega=0.0, diagnosis=diagnosis)
        self.worker.connect()
        self.feed = FleetStore(self.bus)
        for kind in (Mismatch, Prediction):
            self.bus.subscribe(kind, lambda message, _: self.said.append(message))

    def hear(self, message: Message) -> None:
        self.bus.publish(message)
        self.worker.sweep()

    def first(self, *outcomes: DiagnosisOutcome) -> Mismatch | None:
        return next((m for m in self.said if isinstance(m, Mismatch) and m.outcome in outcomes), None)


@pytest.fixture(scope="module")
def shown(tmp_path_factory) -> tuple[Station, Station, np.ndarray]:
    """A station that diagnoses, one beside it from the name on that does not, and the positions reported."""
    folder = tmp_path_factory.mktemp("shown")
    hand = Inline()
    live, beside = Station(Coordinator(hand, {ALL_UAVS: baseline(SEED, folder)})), Station(None)
    heard = messages(FAULT, SEED, END_S, folder)
    for message in heard:
        hand.now = message.t if isinstance(message, Sample) else hand.now
        if live.first(DiagnosisOutcome.NAMED) is not None:
            beside.hear(message)
        elif hand.due:
            beside.worker._owned[UAV] = OwnedTwin(copy.deepcopy(live.worker._owned[UAV].twin), epoch=1)
        live.hear(message)
    rows = [m.position for m in heard if isinstance(m, Sample) and m.position is not None]
    return live, beside, np.concatenate([np.column_stack([row.t.numpy(), row.x.numpy().astype(float)]) for row in rows])


def test_it_is_flagged_located_and_named_within_a_minute(shown):
    live, _, truth = shown
    onset = truth[0, 0] + ONSET_S
    flagged = live.first(DiagnosisOutcome.SUSPECTED, DiagnosisOutcome.UNKNOWN, DiagnosisOutcome.NAMED)
    named = live.first(DiagnosisOutcome.NAMED)
    assert onset < flagged.t <= named.t < onset + WITHIN_S
    assert FAULT.split(",")[0] in (named.causes[0].name, *named.causes[0].confusable_with)
    assert named.onset == pytest.approx(onset, abs=5.0)
    assert named.fit_after < named.fit_before


def test_the_viewer_says_it(shown):
    live, beside, _ = shown
    told = live.first(DiagnosisOutcome.NAMED)
    page = status_html(live.feed.get(UAV), DARK, live.feed._clock())
    assert "mismatch named" in page and told.causes[0].name in page and "included in the prediction model" in page
    assert "mismatch" not in status_html(beside.feed.get(UAV), DARK, beside.feed._clock())


def test_predictions_are_nearer_than_before_and_than_beside(shown):
    live, beside, truth = shown
    onset, named = truth[0, 0] + ONSET_S, live.first(DiagnosisOutcome.NAMED)
    assert named.adapted and "defect" not in live.worker.state().sentence  # what it says of its pace is of the machine
    before = errors(live.said, truth, onset, named.t)[AHEAD_S]
    after, plain = (errors(one.said, truth, named.t, named.t + AFTER_S)[AHEAD_S] for one in (live, beside))
    assert after < 0.7 * before and after < 0.7 * plain
