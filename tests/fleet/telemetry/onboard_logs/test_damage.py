"""Whatever a file has suffered, whatever its kind: what is good is read, what was skipped is said, nothing raises."""

import bz2
import gzip
import lzma
import os
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from fleet.bus.codec import encode, encoding
from fleet.contract import COLUMNS, Sample
from fleet.telemetry.recording.fleet_log import BusRecord
from fleet.telemetry.recording.opening import RecordingFile
from fleet.telemetry.recording.recordings import Recording
from tests.bench.peak_memory import peak_mb, reset_peak

FILES = {
    "tlog": "sitl/s02_nominal_light_wind.tlog.xz",
    "bin": "real/dronekit_copter_log171_crash.bin",
    "log": "real/ardupilot_mechanical_fail_quad.log",
    "ulg": "real/px4_vtol_cubeorange_6s_reader_test.ulg",
    "parauav": "sitl/s02_nominal_light_wind.tlog.xz",  # as the bus hears it
}
SEEDS = range(10)
MOST = 1_000_000  # bytes of each file used
LONGEST = 96 << 20  # of an endless one


class Good(NamedTuple):
    """The start of an undamaged recording, and what is read of it."""

    kind: str
    data: bytes
    rows: int
    skipped: list[str]


def read(path) -> tuple[int, list[str]]:
    """Rows and sentences of a recording; a sentence alone where it is none."""
    recording, rows = Recording(path), 0
    try:
        for _, news in recording.steps():
            for sample in news:
                if isinstance(sample, Sample):
                    rows += sum(len(getattr(sample, f).t.numpy()) for f in COLUMNS if getattr(sample, f) is not None)
    except ValueError as error:
        assert not rows
        return 0, [str(error)]
    return rows, recording.skipped


@pytest.fixture(scope="module", params=list(FILES))
def good(request, recordings, tmp_path_factory) -> Good:
    kind, path = request.param, recordings / FILES[request.param]
    if kind == "parauav":
        data = said(path)
    else:
        with RecordingFile(path).open() as stream:
            data = stream.read(MOST)
    path = tmp_path_factory.mktemp("good") / f"flight.{kind}"
    path.write_bytes(data)
    return Good(kind, data, *read(path))


def said(path: Path) -> bytes:
    """What the gateway says of a recording, as `fleet record` would write it."""
    out = bytearray()
    for now, news in Recording(path).steps():
        for message in news:
            out += BusRecord(now, encoding(type(message)), encode(message)).pack()
        if len(out) > MOST:
            break
    return bytes(out)


def test_flipped_bits_cost_what_they_hit(good, tmp_path):
    kind, data, whole, before = good
    path = tmp_path / f"flight.{kind}"
    assert whole > 1000
    said, kept = [], []
    for seed in SEEDS:
        rng, damaged = np.random.default_rng(seed), bytearray(data)
        for at in rng.integers(0, len(data), 100):
            damaged[at] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        rows, skipped = read(path)
        kept.append(rows / whole)
        said += [sentence for sentence in skipped if sentence not in before]
    assert np.median(kept) > 0.9, kept
    assert min(kept) > 0.3, kept
    assert len(said) >= len(SEEDS) // 2
    assert any(re.search(r"(byte|line)s? \d+", sentence) for sentence in said), said[:5]


def test_a_file_cut_anywhere_keeps_what_came_before(good, tmp_path):
    kind, data, whole, _ = good
    path = tmp_path / f"flight.{kind}"
    found = []
    for share in (0.0003, 0.02, 0.3, 0.77, 0.9999):
        path.write_bytes(data[: int(share * len(data))])
        found.append(read(path)[0])
    assert found == sorted(found)
    assert whole * 0.9 < found[-1] <= whole
    assert found[3] > 0.5 * whole


def test_another_suffix_changes_nothing(good, tmp_path):
    kind, data, rows, _ = good
    other = {"tlog": "bin", "bin": "log", "log": "ulg", "ulg": "parauav", "parauav": "tlog"}[kind]
    for suffix in (other, "dat"):
        (tmp_path / f"flight.{suffix}").write_bytes(data)
    (same, said), (again, _) = (read(tmp_path / f"flight.{suffix}") for suffix in (other, "dat"))
    assert rows == same == again
    assert "by its content" in said[0]


@pytest.fixture(scope="module", params=["zeros", "noise"])
def endless(request, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("endless") / "endless.xz"
    block = bytes(1 << 20) if request.param == "zeros" else np.random.default_rng(1).bytes(1 << 20)
    with lzma.open(path, "wb", preset=0) as file:
        for _ in range(LONGEST // len(block) if request.param == "zeros" else 8):
            file.write(block)
    return path


@pytest.mark.parametrize("kind", list(FILES))
def test_an_endless_file_is_given_up_in_bounded_memory(kind, endless, tmp_path):
    path = tmp_path / f"endless.{kind}.xz"
    path.hardlink_to(endless)
    before = reset_peak()
    rows, said = read(path)
    assert rows == 0
    assert said and f"endless.{kind}.xz" in said[0] and "expected" in said[0]
    assert peak_mb() - before < 100


PACKERS = {
    "": bytes,
    ".xz": lambda data: lzma.compress(data, preset=1),
    ".gz": gzip.compress,
    ".bz2": lambda data: bz2.compress(data, 1),
}  # small blocks


@pytest.mark.parametrize("packed", list(PACKERS))
@pytest.mark.parametrize("kind", list(FILES))
def test_an_empty_file_is_said_to_be_empty(kind, packed, tmp_path):
    path = tmp_path / f"empty.{kind}{packed}"
    for content in (PACKERS[packed](b""), b""):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=rf"^empty\.{kind}.*; expected a recording; check the file$"):
            Recording(path)


@pytest.mark.parametrize("packed", [".xz", ".gz", ".bz2"])
def test_a_damaged_archive_of_any_kind_gives_what_came_before(good, packed, tmp_path):
    kind, data, whole, _ = good
    archive = PACKERS[packed](data)
    path = tmp_path / f"flight.{kind}{packed}"
    rng = np.random.default_rng(3)
    for _ in range(2):
        damaged = bytearray(archive)
        damaged[int(rng.integers(len(archive) // 2, len(archive) - 100))] ^= 0x55
        path.write_bytes(damaged)
        rows, skipped = read(path)
        assert 0 < rows <= whole
        assert rows == whole or any("damaged" in sentence or "expected" in sentence for sentence in skipped)


@pytest.mark.parametrize("kind", list(FILES))
def test_what_cannot_be_opened_is_said_in_one_sentence(kind, tmp_path, monkeypatch):
    path = tmp_path / f"flight.{kind}"
    path.mkdir()
    (tmp_path / f"endless.{kind}").symlink_to("/dev/zero")
    (tmp_path / f"gone.{kind}").symlink_to(tmp_path / "nowhere")
    os.mkfifo(tmp_path / f"pipe.{kind}")
    for name in ("flight", "endless", "gone", "pipe", "none"):
        with pytest.raises(OSError, match=rf"{name}\.{kind}: found (no .*|a folder), expected a recording; "):
            Recording(tmp_path / f"{name}.{kind}")
    locked = tmp_path / f"locked.{kind}"
    locked.write_bytes(b"secret")

    def refuse(*_: object) -> None:  # permissions do not stop root, who may be running this
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(OSError, match=rf"locked\.{kind}: cannot be read \(Permission denied\); check"):
        Recording(locked)


def test_a_good_recording_that_never_ends_is_read_in_bounded_memory(good, tmp_path):
    """Copies of one stretch: what repeats itself may be refused, but neither raises nor piles up."""
    kind, data, *_ = good
    packed = (".xz", ".gz", ".bz2")[list(FILES).index(kind) % 3]  # archives are opened alike, whatever is in them
    path = tmp_path / f"endless.{kind}{packed}"
    stretch = PACKERS[packed](data[:400_000])
    with path.open("wb") as file:
        for _ in range(20):
            file.write(stretch)  # archives joined are an archive
    short = tmp_path / f"short.{kind}{packed}"
    short.write_bytes(stretch * 4)
    read(short)
    before = reset_peak()
    read(path)
    assert peak_mb() - before < 50
