"""A raw MAVLink stream, without time stamps: the same rows as from the telemetry log that it was cut from."""

import lzma
from pathlib import Path

import numpy as np
import pytest

from fleet.contract import Sample
from fleet.telemetry.recording.recordings import Recording
from tests.support.talker import of

_BYTES = 600_000


def stripped(tlog: bytes) -> bytes:
    """Remove the stamps of a telemetry log."""
    out, at = [], 0
    while at + 18 < len(tlog):
        size = tlog[at + 9]
        size += 8 if tlog[at + 8] == 0xFE else 12 + (13 if tlog[at + 10] & 1 else 0)
        out.append(tlog[at + 8 : at + 8 + size])
        at += 8 + size
    return b"".join(out)


@pytest.fixture(scope="module")
def both(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("stream")
    with lzma.open(recordings / "sitl/s01_nominal_calm.tlog.xz") as file:
        data = file.read(_BYTES)
    log, stream = folder / "flight.tlog", folder / "capture.dat"
    log.write_bytes(data)
    stream.write_bytes(stripped(data))
    return log, stream


def rows(path: Path, field: str) -> tuple[np.ndarray, np.ndarray, Recording]:
    recording = Recording(path)
    news = [n for _, step in recording.steps() for n in step]
    parts = [getattr(s, field) for s in of(Sample, news) if getattr(s, field) is not None]
    t, x = (np.concatenate([getattr(part, k).numpy() for part in parts]) for k in "tx")
    return t, x, recording


def test_a_stream_has_the_rows_of_its_log(both: tuple[Path, Path]) -> None:
    t_log, x_log, _ = rows(both[0], "attitude")
    t, x, recording = rows(both[1], "attitude")
    assert recording.kind == "MAVLink stream"
    assert abs(len(x) - len(x_log)) <= 2
    n = min(len(x), len(x_log))
    np.testing.assert_array_equal(x[-n:], x_log[-n:])
    assert np.diff(t[-n:]) == pytest.approx(np.diff(t_log[-n:]), abs=0.02)
    assert any("boot time of the aircraft is used" in sentence for sentence in recording.skipped)


def test_a_stream_is_dated_by_the_aircraft(both: tuple[Path, Path]) -> None:
    t, _, recording = rows(both[1], "position")
    t_log, _, _ = rows(both[0], "position")
    dated = any("dated by SYSTEM_TIME" in sentence for sentence in recording.skipped)
    assert (np.diff(t) > 0).all()
    assert not dated or t[0] > 1.2e9
    assert np.ptp(t) == pytest.approx(np.ptp(t_log), rel=0.02)


def test_damage_costs_a_frame(both: tuple[Path, Path], tmp_path: Path) -> None:
    data = bytearray(both[1].read_bytes())
    data[1000:1100] = b"\x55" * 100
    path = tmp_path / "damaged.raw"
    path.write_bytes(bytes(data[7:]))  # captured from the middle of a frame
    _, x, recording = rows(path, "attitude")
    assert len(x) >= len(rows(both[1], "attitude")[1]) - 3
    assert any("damaged bytes skipped" in sentence for sentence in recording.skipped)
