"""A long telemetry log: read in bounded memory, with progress, and interrupted at once."""

import os
import re
import signal
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
from conftest import ROOT

from fleet.commands.offline import inspect
from fleet.contract import Sample
from fleet.telemetry.inspection.thinned import DecimatedRows
from fleet.telemetry.recording import recordings
from fleet.telemetry.recording.recordings import Recording
from tests.support import long_tlog
from tests.support.talker import T0, of

PATIENCE_S = 60.0
FILES = 12  # so many that a terminal that is read late on a busy machine is still read before the last
PEAK = """
import sys
from pathlib import Path
from fleet.commands.offline.inspect import inspect_file
from tests.bench.peak_memory import peak_mb
file, _, _ = inspect_file(Path(sys.argv[1]))
(told,) = file.aircraft
print(round(told.seconds), round(peak_mb()))
"""


def peak(path) -> tuple[int, int]:
    """Inspect a recording in a process of its own; give the seconds in it and the most memory it took [MB]."""
    command = [sys.executable, "-c", PEAK, str(path)]
    done = subprocess.run(command, cwd=ROOT, env=env(), capture_output=True, text=True, timeout=600, check=True)
    seconds, megabytes = done.stdout.split()
    return int(seconds), int(megabytes)


def env() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT)}


def test_what_is_made_up_is_a_sound_flight(tmp_path):
    path = tmp_path / "flight.tlog"
    seconds = long_tlog.write(path, 1)
    recording = Recording(path)
    news = [message for _, step in recording.steps() for message in step]
    rows = sum(len(m.attitude.t.numpy()) for m in of(Sample, news) if m.attitude)
    assert recording.skipped == [] and rows == pytest.approx(50 * seconds, abs=2)
    assert news[-1].t - news[0].t == pytest.approx(seconds, abs=4)
    assert max(m.clock_jumps + m.rejected for m in news if hasattr(m, "rejected")) == 0


def test_ten_times_the_length_takes_no_more_memory(tmp_path):
    short, long = tmp_path / "short.tlog", tmp_path / "long.tlog"
    lasts = [long_tlog.write(short, 3), long_tlog.write(long, 30)]
    found = [peak(path) for path in (short, long)]
    assert [seconds for seconds, _ in found] == pytest.approx(lasts, abs=2)
    # of 27 MB more in the file and 160 MB more of rows: buffers of fixed size fill; 600 MB take no more than 60 MB do
    assert found[1][1] - found[0][1] < 60


def test_progress_rises_to_the_end(tmp_path, monkeypatch):
    path, shares = tmp_path / "flight.tlog", []
    long_tlog.write(path, 5)

    class Watched(Recording):
        def steps(self):
            for step in super().steps():
                shares.append(self.share)
                yield step

    monkeypatch.setattr(recordings, "Recording", Watched)
    assert inspect.inspect_file(path)[0].sentences == ()
    assert shares == sorted(shares) and len(set(shares)) >= 4 and shares[-1] == 1.0


def test_ctrl_c_ends_an_inspection_at_once(tmp_path):
    path = tmp_path / "flight.tlog"
    long_tlog.write(path, 60)
    primary, secondary = os.openpty()
    command = [sys.executable, "-m", "fleet.cli", "inspect", *FILES * [str(path)]]
    with subprocess.Popen(command, cwd=ROOT, env=env(), stdout=secondary, stderr=secondary) as child:
        os.close(secondary)
        shown, told = b"", False
        try:
            while read := _read_terminal(primary):  # to the end: who is not read, cannot write its last words
                shown += read
                if not told and re.search(rb"flight\.tlog[^\r\n]*%[^\r\n]*reading", shown):
                    child.send_signal(signal.SIGINT)
                    told = True
            assert told and child.wait(timeout=PATIENCE_S) == 130
        finally:
            child.kill()
    os.close(primary)
    assert b"Traceback" not in shown and shown.count(b"diagnose") < FILES


def _read_terminal(primary: int) -> bytes:
    try:
        return os.read(primary, 4096)
    except OSError:  # nobody holds its other side any more
        return b""


def test_rows_that_are_let_go_free_their_memory():
    tracemalloc.start()
    try:
        kept = DecimatedRows(1.0, 1_000)
        for k in range(400):
            t = T0 + 0.01 * np.arange(5_000 * k, 5_000 * (k + 1))
            kept.add(t, np.ones((len(t), 6)))
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept.count == 2_000_000 and len(kept.rows()[0]) <= 1_000
    assert held < 1_000_000  # bytes; a view of every block would hold 60 million
