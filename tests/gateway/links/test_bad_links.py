"""Predictions over a bad link keep coming, say what happened, and hold in their tubes."""

from pathlib import Path

import numpy as np
import pytest

from fleet.contract import Event, Message
from fleet.telemetry.recording.recordings import replay_messages
from tests.bench.bad_links import Tally, behind, fly, positions
from tests.support import flights as f
from tests.support.bad_radio import RADIOS, Radio, frames, worsen


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """The pretend flight as it was recorded."""
    base = tmp_path_factory.getbasetemp()
    f.pretend(base)
    return base / "flight.tlog"


def through(recorded: Path, folder: Path, radio: Radio) -> list[Message]:
    worsen(recorded, folder / "worse.tlog", radio, seed=5)
    return list(replay_messages(folder / "worse.tlog"))


def test_a_radio_loses_is_silent_and_late_as_told(recorded, tmp_path):
    whole = list(frames(recorded))
    assert worsen(recorded, tmp_path / "same.tlog", Radio(), 1) == len(whole)
    assert (tmp_path / "same.tlog").read_bytes() == recorded.read_bytes()
    worsen(recorded, tmp_path / "worse.tlog", Radio(0.3, 10.0, 60.0, 1.0, 0.2), 1)
    left = list(frames(tmp_path / "worse.tlog"))
    t = np.array([at for at, _ in left])
    assert (np.diff(t) >= 0).all() and t[t > 0].min() >= 1.0
    assert not ((t > 63.0) & (t < 70.5)).any() and ((t > 72.0) & (t < 73.0)).any()
    flying = sum(at > 0 for at, _ in whole)
    assert sum(at > 0 for at, _ in left) == pytest.approx(0.7 * 0.9 * flying, rel=0.03)
    assert [pair for pair in left if pair[0] == 0] == [pair for pair in whole if pair[0] == 0]  # what was asked for


def test_a_late_radio_sets_the_clock_back_by_as_much(recorded, tmp_path):
    truth = positions(list(replay_messages(recorded)))
    late = positions(through(recorded, tmp_path, RADIOS["1 s late"]))
    assert 1.0 < behind(late, truth) < 2.0
    assert behind(truth, truth) == 0.0


def test_over_a_bad_link_predictions_keep_coming_and_hold(recorded, tmp_path):
    truth, tally = positions(list(replay_messages(recorded))), Tally()
    fly(through(recorded, tmp_path, Radio(0.3, 10.0, 45.0, 1.0, 0.2)), truth, tally, since=25.0)
    found = tally.row()
    assert found["predictions"] > 40 and tally.gap_s < 13.0
    assert tally.events[Event.LINK_LOST.value] >= tally.events[Event.LINK_RESTORED.value] == 1
    assert found["coverage"] >= 0.85
