"""Damaged ULogs: what is good is still read, what is lost is said, and nothing raises or runs away."""

import io
import random
import struct
from collections.abc import Callable

import numpy as np
import pytest

from fleet.telemetry.onboard_logs.ulog import sieve
from fleet.telemetry.onboard_logs.ulog.reader import UlogLog
from fleet.telemetry.tables.ulog import TOPICS
from tests.support.ulog_writer import MAGIC, START_US, TRUTH, flight, message, read, rows, said, ulog

SAMPLE = "real/px4_vtol_cubeorange_6s_reader_test.ulg"

ODD = {
    "empty": b"",
    "garbage": random.Random(1).randbytes(200_000),
    "zeros": bytes(100_000),
    "header only": MAGIC + struct.pack("<Q", 5),
    "half a header": MAGIC,
    "a format that contains itself": MAGIC + bytes(8) + message("F", b"a:a[9] b;") + message("A", b"\0\0\0a"),
    "a subscription without a format": MAGIC + bytes(8) + message("A", b"\0\0\0vehicle_status"),
}


@pytest.mark.parametrize("what", ODD)
def test_a_file_with_nothing_in_it_gives_no_chunks_and_says_so(what):
    log = read(ODD[what])
    assert list(log.chunks()) == []
    assert any("check the file" in sentence for sentence in log.skipped)
    assert len(log.skipped) < 40
    assert (log.system, log.vehicle, log.epoch_s) == (1, "unknown", None)


def test_a_log_cut_anywhere_is_read_up_to_the_cut():
    data = ulog(flight((1, 11), seconds=2.0), params={"A": 1})
    whole = len(rows(read(data))["imu"][0])
    begins = data.index(message("A", b"")[2:3] + b"\0\0\0sensor_combined")
    for share in (0.1, 0.33, 0.5, 0.77, 0.999):
        cut = begins + int(share * (len(data) - begins))
        got = rows(read(data[:cut])).get("imu", ([], []))
        assert abs(len(got[0]) - share * whole) <= 0.05 * whole + 12
    for cut in range(0, begins, 97):
        read(data[:cut])


@pytest.mark.parametrize("seed", range(4))
def test_a_hundred_flipped_bits_cost_little(seed):
    clean = ulog(flight((1, 11), seconds=20.0), params={f"P{i}": i for i in range(50)})
    begins = clean.index(message("D", b"")[2:3], clean.index(b"mission_result", clean.index(b"A\0")))
    dice, data = random.Random(seed), bytearray(clean)
    for _ in range(100):
        at = dice.randrange(begins, len(data))
        data[at] ^= 1 << dice.randrange(8)
    log = read(bytes(data))
    before, after = rows(read(clean)), rows(log)
    for field in before:
        t, values = after[field]
        assert len(t) > 0.85 * len(before[field][0]), field
        assert (np.diff(t) > 0).all()
        right = np.isclose(values[:, : len(TRUTH[field])], TRUTH[field], rtol=1e-5, atol=1e-4).all(axis=1)
        assert right.mean() > 0.9, field
    assert 0 < len(log.skipped) < 40
    assert len(list(log.chunks())) <= 4


@pytest.mark.parametrize("seed", range(3))
def test_bits_flipped_anywhere_raise_nothing(seed, recordings):
    dice, data = random.Random(seed), bytearray((recordings / SAMPLE).read_bytes())
    for _ in range(100):
        data[dice.randrange(len(data))] ^= 1 << dice.randrange(8)
    log = read(bytes(data))
    assert len(rows(log).get("imu", ([], []))[0]) > 1000
    assert len(log.skipped) < 40


def test_a_hole_and_a_run_of_garbage_are_stepped_over_and_their_place_is_said():
    data = ulog(flight((1, 11), seconds=20.0))
    middle = len(data) // 2
    log = read(data[:middle] + random.Random(2).randbytes(30_000) + data[middle + 5000 :])
    t = rows(log)["imu"][0] - START_US * 1e-6
    assert t[-1] > 19.9
    assert len(t) > 0.9 * 2000
    assert any("were skipped" in sentence and f"to {middle + 30_000}"[:6] in sentence for sentence in log.skipped)


def test_data_appended_after_a_crash_are_read():
    data = ulog(flight((1, 11), seconds=4.0), texts=[(START_US + 3_990_000, 3, "late")])
    place = len(data) - 7  # the last message of the flight was cut short
    flags = bytes(8) + b"\1" + bytes(7) + struct.pack("<3Q", place, 0, 0)
    text = message("L", struct.pack("<BQ", ord("3"), START_US + 3_995_000) + b"appended")
    log = read(data[:16] + message("B", flags) + data[16 + 43 : place] + text)
    assert (3, "appended") in said(log, "text")


class Endless(io.RawIOBase):
    """A log that never ends: its last rows again and again, or noise."""

    def __init__(self, head: bytes, tail: bytes) -> None:
        self.head, self.tail, self.given = head, tail, 0

    def read(self, n: int = -1) -> bytes:
        self.given += n
        out, self.head = self.head[:n], self.head[n:]
        return out + (self.tail * (n // len(self.tail) + 1))[: n - len(out)]


@pytest.mark.parametrize("noise", [bytes(1000), random.Random(3).randbytes(4096)])
def test_an_endless_stream_is_read_up_to_a_size_and_that_is_said(noise, monkeypatch):
    monkeypatch.setattr(sieve, "MAX_FILE_BYTES", 3 << 20)
    stream = Endless(ulog(flight((1, 11))), noise)
    log = UlogLog(lambda: stream, "endless.ulg")
    assert stream.given <= 4 << 20
    assert any("longer than 3 MiB" in sentence for sentence in log.skipped)
    assert len(rows(log)["imu"][0]) >= 490


def test_after_much_noise_the_rest_is_left_unread(monkeypatch):
    monkeypatch.setattr(sieve, "MAX_SILENT_BYTES", 3 << 20)
    stream = Endless(ulog(flight((1, 11))), bytes(1000))
    log = UlogLog(lambda: stream, "endless.ulg")
    assert any("the rest was not read" in sentence for sentence in log.skipped)


@pytest.mark.parametrize("error", [OSError("gone"), EOFError("cut")])
def test_a_file_that_breaks_while_it_is_read_keeps_what_came_before(error):
    class Breaks(io.BytesIO):
        def read(self, n: int = -1) -> bytes:
            data = super().read(20_000)
            if not data:
                raise error
            return data

    data = ulog(flight((1, 11)))
    log = UlogLog(lambda: Breaks(data), "x.ulg")
    assert len(rows(log)["imu"][0]) >= 490
    assert any(str(error) in sentence for sentence in log.skipped)


def test_an_opener_that_fails_is_said():
    def opener() -> io.BytesIO:
        raise PermissionError("not yours")

    make: Callable[[], UlogLog] = lambda: UlogLog(opener, "x.ulg")  # noqa: E731
    assert any("not yours" in sentence for sentence in make().skipped)


@pytest.mark.parametrize("bit", [3, 25, 29, 40, 63])
def test_a_damaged_start_stamp_costs_next_to_nothing(bit):
    data = ulog(flight((1, 11), seconds=20.0), params={"A": 1})
    start = struct.pack("<Q", START_US ^ 1 << bit)
    log = read(data[:8] + start + data[16:])
    assert len(rows(log)["imu"][0]) > 1900
    assert len(list(log.chunks())) <= 2
    assert said(log, "param") == [("A", 1.0)]


def test_a_log_whose_clock_leaps_a_century_has_few_chunks():
    topics = flight((1, 11), seconds=20.0)
    for columns in topics.values():
        columns["timestamp"][len(columns["timestamp"]) // 2 :] += np.uint64(3_000_000_000_000_000)
    assert len(list(read(ulog(topics)).chunks())) <= 3


def test_a_jump_of_the_clock_costs_twenty_rows_whatever_is_logged_between():
    """Rows of topics nobody reads came between the rows that jumped, and the rest of the log was dropped."""
    imu = flight((1, 11), seconds=20.0)["sensor_combined"]
    imu["timestamp"] = imu["timestamp"] + (imu["timestamp"] > START_US + 10_000_000) * np.uint64(90_000_000)
    between = {"unwanted": {"timestamp": imu["timestamp"] + np.uint64(1), "x": np.zeros(len(imu["timestamp"]), "f4")}}
    assert not set(between) & TOPICS
    log = read(ulog({"sensor_combined": imu} | between))
    assert "20 rows of sensor_combined with an implausible stamp skipped" in log.skipped
    assert len(rows(log)["imu"][0]) == len(imu["timestamp"]) - sieve.MIN_AGREEING
