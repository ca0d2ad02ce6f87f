"""Recording thread: queues received bytes without blocking, writes them to disk and cuts files."""

import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple

import numba as nb
import numpy as np

from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from fleet.telemetry.mavlink.parsing.scan import (
    CRC,
    EXTRA,
    STAMP_SIZE,
    V1,
    V2,
    frame_length,
    message_id,
    valid_frame_end,
)
from gateway.links.link import QUEUE_BYTES, Batch
from gateway.record.tape import DiskBudget, TlogWriter

CARRY_BYTES = 300  # the longest frame is 293 [bytes]
FRAMES, NOISE = range(2)  # counters of `cut`: frames, bytes outside frames


@nb.njit(cache=True, nogil=True)
def _complete_length(data, at, end, extras, table):
    """Return the length of the frame at `at` [bytes]; 0: no frame, -1: it extends beyond `end`."""
    length = frame_length(data, at, end)
    if length == 0 or (length < 0 and data[at] != V1 and data[at] != V2):
        return 0
    if length < 0 or at + length > end:
        return -1
    number = message_id(data, at)
    if number < len(extras) and extras[number] >= 0:
        return length if valid_frame_end(data, at, end, extras, table) else 0
    next_byte = at + length  # the checksum of an unknown message cannot be tested: the next byte must begin a frame
    return length if next_byte == end or data[next_byte] == V1 or data[next_byte] == V2 else 0


@nb.njit(cache=True, nogil=True)
def _copy(source, start, length, target, at):
    for k in range(length):
        target[at + k] = source[start + k]


@nb.njit(cache=True, nogil=True)
def _copy_frames(data, end, us, work, counts, extras, table):
    """Copy every frame of `data[:end]` with a time stamp; return the new end of the output and of the consumed data."""
    out, n = work
    at = 0
    while at < end:
        length = _complete_length(data, at, end, extras, table)
        if length < 0:
            break
        if length == 0:
            at += 1
            counts[NOISE] += 1
            continue
        for k in range(STAMP_SIZE):
            out[n + k] = us >> (8 * (STAMP_SIZE - 1 - k)) & 0xFF
        _copy(data, at, length, out, n + STAMP_SIZE)
        n, at = n + STAMP_SIZE + length, at + length
        counts[FRAMES] += 1
    return n, at


@nb.njit(cache=True, nogil=True)
def cut(pieces, us, carry, carried, counts, extras, table):
    """Split pieces into records.

    Args:
        pieces: buf (b,) uint8; start, stop and sender slot of each piece, (n,)
        us: arrival of each piece, (n,) int64 [us since 1970]
        carry, carried: by slot the incomplete frame of earlier pieces, (m * CARRY_BYTES,) uint8, and its size, (m,)
        counts: increased by frames and bytes outside frames, (2,) int64
        extras, table: `EXTRA`, `CRC`
    Returns:
        the records, (k,) uint8
    """
    buf, start, stop, slot = pieces
    max_piece, total = 0, 0
    for i in range(len(start)):
        max_piece, total = max(max_piece, stop[i] - start[i]), total + stop[i] - start[i] + carried[slot[i]]
    out, n = np.empty(2 * total, np.uint8), 0  # no frame is shorter than 8 bytes
    scratch = np.empty(CARRY_BYTES + max_piece, np.uint8)
    for i in range(len(start)):
        owner, size, before = slot[i], stop[i] - start[i], carried[slot[i]]
        _copy(carry, owner * CARRY_BYTES, before, scratch, 0)
        _copy(buf, start[i], size, scratch, before)
        end = before + size
        n, consumed = _copy_frames(scratch, end, us[i], (out, n), counts, extras, table)
        carried[owner] = end - consumed
        _copy(scratch, consumed, end - consumed, carry, owner * CARRY_BYTES)
    return out[:n]


MOST = 64 << 20  # bytes waiting for the disk; beyond, they are dropped and counted
WRITE_S = 0.25  # between two writes: the longest loss at a crash [s]

_log = logging.getLogger(__name__)


class RecordingCounters(NamedTuple):
    """Byte counters of one link: `received` is the sum of the five after it, without the time stamps of the file."""

    received: int = 0  # bytes
    recorded: int = 0  # in frames, on disk
    noise: int = 0  # outside frames, not recorded
    lost: int = 0  # write errors
    dropped: int = 0  # queue overflow
    waiting: int = 0  # in the queue, or in incomplete frames
    frames: int = 0  # recorded or lost
    fault: str = ""


class _LinkRecording:
    """Recording of one link: its file, the incomplete frame of every sender, and counters [bytes]."""

    def __init__(self, writer: TlogWriter, max_senders: int = 4096) -> None:
        self.writer = writer
        self.received = self.recorded = self.lost = self.dropped = 0
        self._counts = np.zeros(2, np.int64)
        self._slots: dict[object, int] = {}
        self._carry, self._carried = np.empty(max_senders * CARRY_BYTES, np.uint8), np.zeros(max_senders, np.int64)

    def write(self, batches: Sequence[ReceivedBytes]) -> None:
        """Write the frames completed by received bytes."""
        before = int(self._counts[FRAMES])
        records = b"".join(map(self._cut, batches))
        size = len(records) - STAMP_SIZE * (int(self._counts[FRAMES]) - before)
        if self.writer.write(records, time.monotonic()):
            self.lost += size
        else:
            self.recorded += size

    def _cut(self, received: ReceivedBytes) -> bytes:
        slots = np.array([self._slot(sender) for sender in received.senders], np.int64)
        pieces = (received.buf, received.start, received.stop, slots[received.sender])
        us = np.round(received.arrival * 1e6).astype(np.int64)
        return cut(pieces, us, self._carry, self._carried, self._counts, EXTRA, CRC).tobytes()

    def _slot(self, sender: object) -> int:
        """Return the slot of a sender; if all are in use, free the oldest one and count its bytes as noise."""
        if sender not in self._slots:
            free = len(self._slots)
            if free == len(self._carried):
                free = self._slots.pop(next(iter(self._slots)))
                self._counts[NOISE] += self._carried[free]
                self._carried[free] = 0
            self._slots[sender] = free
        return self._slots[sender]

    def counters(self) -> RecordingCounters:
        frames, noise = self._counts.tolist()
        accounted = (self.recorded, noise, self.lost, self.dropped)
        return RecordingCounters(self.received, *accounted, self.received - sum(accounted), frames, self.writer.fault)


class LinkRecorder(AbstractContextManager):
    """Record links as `.tlog`.

    Args:
        budget: of the folder
        names: of the links
    """

    def __init__(self, budget: DiskBudget, names: Sequence[str]) -> None:
        self.budget = budget
        self._recordings = [_LinkRecording(TlogWriter(name, budget, len(names))) for name in names]
        self._lock = threading.Lock()
        self._waiting: list[tuple[int, ReceivedBytes]] = []
        self._size = 0  # bytes waiting
        self._logged: set[str] = set()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder")
        self._thread.start()

    def add(self, link: int, received: ReceivedBytes) -> None:
        """Queue pieces of one link; thread-safe, never waits for the disk."""
        size = int((received.stop - received.start).sum())
        with self._lock:
            self._recordings[link].received += size
            if self._size + size > MOST:
                self._recordings[link].dropped += size
            else:
                self._waiting.append((link, received))
                self._size += size

    def counters(self) -> list[RecordingCounters]:
        """Return the byte counters of each link."""
        with self._lock:
            return [recording.counters() for recording in self._recordings]

    def close(self) -> None:
        """Write the queue and close the files."""
        self._stop.set()
        self._thread.join()
        for recording in self._recordings:
            recording.writer.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        stopped = False
        while not stopped:
            stopped = self._stop.wait(WRITE_S)
            self.write()

    def write(self) -> None:
        """Write the queue."""
        with self._lock:
            waiting, self._waiting, self._size = self._waiting, [], 0
        for number, recording in enumerate(self._recordings):
            if batches := [received for link, received in waiting if link == number]:
                recording.write(batches)
            if (fault := recording.writer.fault) and fault not in self._logged:
                self._logged.add(fault)
                _log.warning("%s", fault)


class RecordedQueue(queue.Queue[Batch]):
    """Queue between receiving and decoding; it records every batch, also those that do not fit.

    Args:
        max_batches: capacity
        max_bytes: received bytes of one link in the queue
    """

    def __init__(self, max_batches: int, recorder: LinkRecorder | None, max_bytes: int = QUEUE_BYTES) -> None:
        super().__init__(max_batches)
        self._recorder, self._max_bytes = recorder, max_bytes
        self._sizes: Counter[int] = Counter()  # queued bytes, by link

    def put(self, item: Batch, block: bool = True, timeout: float | None = None) -> None:
        """Record a batch, then queue it.

        Raises:
            queue.Full: when there is no space.
        """
        if self._recorder is not None and item.received is not None:
            self._recorder.add(item.link, item.received)
        waiting = self._sizes[item.link]
        if item.size and waiting and waiting + item.size > self._max_bytes:  # a single batch always fits
            raise queue.Full
        super().put(item, block, timeout)

    def _put(self, item: Batch) -> None:
        self._sizes[item.link] += item.size
        super()._put(item)

    def _get(self) -> Batch:
        item = super()._get()
        self._sizes[item.link] -= item.size
        return item
