"""Damaged and hostile DataFlash logs: what is good is read, the rest is said, nothing raises or grows."""

import io
import lzma
import random
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fleet.telemetry.onboard_logs.dataflash.reader import DataflashLog
from fleet.telemetry.onboard_logs.dataflash.records import MAX_DAMAGE_KINDS, MAX_PLACES, Damage
from tests.support.dataflash_writer import Writer, log_of, read


@pytest.fixture(scope="module")
def s02(recordings: Path) -> bytes:
    with lzma.open(recordings / "sitl" / "s02_nominal_light_wind.BIN.xz") as stream:
        return stream.read()


@pytest.mark.parametrize("seed", range(3))
def test_a_hundred_flipped_bits_cost_few_messages(s02: bytes, seed: int) -> None:
    chance = random.Random(seed)
    data = bytearray(s02)
    for _ in range(100):
        data[chance.randrange(20_000, len(data))] ^= 1 << chance.randrange(8)
    whole, _, counts = read(log_of(s02))
    log = log_of(bytes(data))
    rows, _, found = read(log)
    assert sum(counts.values()) - sum(found.values()) < 60
    assert all(len(rows[f][0]) > 0.98 * len(whole[f][0]) for f in whole if f != "leg")
    assert log.epoch_s == pytest.approx(log_of(s02).epoch_s, abs=0.01)
    assert (
        any("damaged bytes" in s and "first at byte" in s for s in log.skipped)
        and len(log.skipped) < MAX_DAMAGE_KINDS + 3
    )


def test_a_message_goes_when_its_own_header_breaks_and_no_other() -> None:
    writer = Writer().fmt("ATT", "Qfff", "TimeUS,Roll,Pitch,Yaw").fmt("EV", "QB", "TimeUS,Id")
    for i in range(100):
        writer.say("ATT", 1_000_000 + 10_000 * i, 1.0, 2.0, 3.0).say("EV", 1_000_000 + 10_000 * i, 1)
    start = 2 * 89 + 40 * (23 + 12)
    for at in range(3):
        data = bytearray(writer.data)
        data[start + at] ^= 1 << (0 if at < 2 else 1)  # ATT 1 becomes 3, unknown
        log = log_of(bytes(data))
        _, _, counts = read(log)
        assert (counts["ATT"], counts["EV"]) == (99, 100)
        assert str(start) in log.skipped[0]
    data = bytearray(writer.data)
    data[start + 2] = 2  # ATT becomes the shorter EV
    assert read(log_of(bytes(data)))[2] == {"FMT": 2, "ATT": 99, "EV": 100}
    data = bytearray(writer.data)
    data[start + 23 + 2] = 1  # EV becomes the longer ATT
    assert read(log_of(bytes(data)))[2] == {"FMT": 2, "ATT": 100, "EV": 99}


def test_times_that_leap_are_skipped_and_not_the_rest() -> None:
    writer = Writer().fmt("IMU", "Qffffff", "TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    for i in range(200):
        t = {0: 10**12, 50: 10**18, 60: 0, 70: 3_600_000_000, 199: 10**9}.get(i, 10_000_000 + 10_000 * i)
        writer.say("IMU", t, 0.0, 0.0, 0.0, 0.0, 0.0, -9.8)
    log = writer.log()
    t, _ = read(log)[0]["imu"]
    assert len(t) == 195 and t[-1] == pytest.approx(11.98)
    assert any("time leaps: 5" in s for s in log.skipped)


def test_a_second_start_in_one_file_is_left_out_and_said(s02: bytes) -> None:
    log = log_of(s02 + s02)
    rows, _, _ = read(log)
    assert len(rows["attitude"][0]) == 2015
    assert any("another start" in s for s in log.skipped)


@pytest.mark.parametrize("size", [0, 1, 2, 3, 4, 88, 89, 90, 5000, 100_001])
def test_a_log_may_end_anywhere(s02: bytes, size: int) -> None:
    log = log_of(s02[:size])
    _, _, counts = read(log)
    assert bool(counts) == (size >= 89)
    assert counts or "found no DataFlash message" in log.skipped[0]


def test_a_compressed_log_cut_short_is_read_as_far_as_it_goes(recordings: Path) -> None:
    packed = (recordings / "sitl" / "s02_nominal_light_wind.BIN.xz").read_bytes()[:500_000]
    log = DataflashLog(lambda: lzma.open(io.BytesIO(packed)), "cut.BIN.xz")  # noqa: SIM115
    rows, _, _ = read(log)
    assert len(rows["attitude"][0]) > 500 and any("cannot be read on" in s for s in log.skipped)


def fmt(kind: int, length: int, name: bytes, codes: bytes, columns: bytes) -> bytes:
    return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", kind, length, name, codes, columns)


HOSTILE: dict[str, Callable[[], bytes]] = {
    "zeros": lambda: bytes(3_000_000),
    "noise": lambda: random.Random(1).randbytes(1_000_000),
    "only headers": lambda: b"\xa3\x95" * 300_000,
    "only formats begun": lambda: b"\xa3\x95\x80" * 200_000,
    "length 0": lambda: fmt(1, 0, b"ATT", b"", b"") + b"\xa3\x95\x01" * 50_000,
    "length 2": lambda: fmt(1, 2, b"ATT", b"", b"") + b"\xa3\x95\x01" * 50_000,
    "length 3": lambda: fmt(1, 3, b"ATT", b"", b"") + b"\xa3\x95\x01" * 50_000,
    "wrong length": lambda: fmt(1, 200, b"ATT", b"Q", b"TimeUS") + b"\xa3\x95\x01" * 50_000,
    "same names": lambda: b"".join(fmt(i % 100, 11, b"ATT", b"Q", b"TimeUS") for i in range(2000)),
    "same columns": lambda: fmt(1, 19, b"ATT", b"QQ", b"Roll,Roll") + (b"\xa3\x95\x01" + bytes(16)) * 100,
    "format of the format": lambda: fmt(0x80, 5, b"FMT", b"H", b"A") * 3,
    "no text": lambda: fmt(1, 11, b"\xff\xfe", b"\xff", b"\xff"),
    "infinite": lambda: (
        fmt(1, 23, b"ATT", b"Qfff", b"TimeUS,Roll,Pitch,Yaw")
        + (b"\xa3\x95\x01" + struct.pack("<Qfff", 10**6, np.inf, np.nan, -np.inf)) * 10
    ),
    "text: endless line": lambda: b"FMT, 1, 1, ATT, c, Roll\n" + b"x" * 3_000_000,
    "text: garbage lines": lambda: b"FMT, 1, 1, ATT, c, Roll\n" + b"ab\n" * 200_000 + b"ATT, x\n" * 1000,
    "text: formats": lambda: b"".join(b"FMT, 1, 1, A%d, c, Roll\n" % i for i in range(20_000)),
    "text: noise": lambda: b"FMT, 1, 1, ATT, c, Roll\n" + random.Random(2).randbytes(500_000),
}


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("suffix", [".bin", ".log"])
def test_nothing_hostile_raises_or_grows(name: str, suffix: str) -> None:
    log = log_of(HOSTILE[name](), "hostile" + suffix)
    rows, _, _ = read(log)
    assert not rows and log.epoch_s is None and log.vehicle == "unknown" and log.system == 1
    assert len(log.skipped) <= MAX_DAMAGE_KINDS + 3 and all(len(s) < 300 for s in log.skipped)


def test_a_damaged_text_log_loses_the_lines_that_are_damaged(recordings: Path) -> None:
    data = (recordings / "real" / "ardupilot_mechanical_fail_quad.log").read_bytes()
    lines = data.split(b"\n")
    chosen = [i for i, line in enumerate(lines) if line.startswith(b"ATT")][100:120]
    for n, i in enumerate(chosen):
        lines[i] = (b"ATT, 1", b"\xff\x00\xff", lines[i] + b", 7", lines[i].replace(b".", b"x"))[n % 4]
    log = log_of(b"\n".join(lines), "damaged.log")
    rows, _, _ = read(log)
    assert 1075 <= len(rows["attitude"][0]) <= 1085
    assert any(f"line {chosen[0] + 1}" in s for s in log.skipped)


def test_damage_is_merged_and_bounded() -> None:
    damage = Damage("byte")
    for i in range(1000):
        damage.count("bad bytes", i)
        damage.count(f"kind {i}", i)
    said = damage.messages()
    assert said[0] == "bad bytes: 1000, first at byte 0, 1, 2; skipped" and MAX_PLACES == 3
    assert len(said) == MAX_DAMAGE_KINDS + 1
