"""Progress of what is played: bars on a terminal, lines elsewhere; and the pace itself."""

import io
import math
import threading

import pytest
from rich.console import Console

from fleet.report import progress
from fleet.report.progress import show_progress
from fleet.telemetry.recording import opening as pace
from fleet.telemetry.recording.opening import ReplayPace, read_speed


class Half:
    """Something half done."""

    name, share = "flight.tlog", 0.5

    def __init__(self):
        self.asked = threading.Event()

    def progress_text(self):
        self.asked.set()
        return "01:05 recorded, 4.0 times real time"


def test_a_terminal_sees_share_time_and_speed(monkeypatch):
    monkeypatch.setattr(progress, "REFRESH_S", 0.01)
    out, half = io.StringIO(), Half()
    with show_progress([half], pytest.fail, Console(file=out, force_terminal=True, width=120)):
        assert half.asked.wait(30)
    for words in ("flight.tlog", "50%", "01:05 recorded, 4.0 times real time"):
        assert words in out.getvalue()


def test_elsewhere_a_line_is_said_now_and_then(monkeypatch):
    monkeypatch.setattr(progress, "PLAIN_S", 0.01)
    said, came = [], threading.Event()

    def say(line):
        said.append(line)
        came.set()

    with show_progress([Half()], say, Console(file=io.StringIO())):
        assert came.wait(30)
    assert said[0] == "flight.tlog: 50%, 01:05 recorded, 4.0 times real time"


def test_nothing_to_show_starts_nothing():
    before = threading.active_count()
    with show_progress([], pytest.fail):
        assert threading.active_count() == before


def test_pace_keeps_recorded_time_and_tells_the_speed_reached(monkeypatch):
    now, waited, stop = [100.0], [], threading.Event()
    monkeypatch.setattr(pace.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(stop, "wait", lambda s: waited.append(s) or now.__setitem__(0, now[0] + s) or False)
    half = ReplayPace(4.0)
    assert math.isnan(half.speed_reached) and half.progress_text() == "00:00 recorded"
    for t in (5000.0, 5004.0, 5008.0):
        assert not half.wait(t, stop)
    assert waited == [1.0, 1.0] and half.speed_reached == 4.0
    now[0] += 2.0  # something took long
    assert not half.wait(5012.0, stop) and len(waited) == 2
    assert half.progress_text() == "00:12 recorded, 3.0 times real time"
    assert not half.wait(8612.0, stop) and half.progress_text().startswith("1:00:12")


def test_as_fast_as_possible_never_waits():
    fast, stop = ReplayPace(math.inf), threading.Event()
    assert not any(fast.wait(1e9 + t, stop) for t in range(1000))
    stop.set()
    assert fast.wait(2e9, stop)


@pytest.mark.parametrize("text", ["0", "-1", "nan", "fast", ""])
def test_what_is_no_speed_is_said(text):
    with pytest.raises(ValueError, match=r"speed: found .*, expected a number above 0 or max"):
        read_speed(text)
