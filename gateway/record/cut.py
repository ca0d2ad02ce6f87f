"""Compiled split of the bytes of many senders into `.tlog` records: 8 bytes of big-endian us since 1970, one frame."""

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
    out, scratch, n = (
        np.empty(2 * total, np.uint8),
        np.empty(CARRY_BYTES + max_piece, np.uint8),
        0,
    )  # no frame is shorter than 8 bytes
    for i in range(len(start)):
        owner, size = slot[i], stop[i] - start[i]
        carried_bytes = carried[owner]
        _copy(carry, owner * CARRY_BYTES, carried_bytes, scratch, 0)
        _copy(buf, start[i], size, scratch, carried_bytes)
        end = carried_bytes + size
        n, consumed = _copy_frames(scratch, end, us[i], (out, n), counts, extras, table)
        carried[owner] = end - consumed
        _copy(scratch, consumed, end - consumed, carry, owner * CARRY_BYTES)
    return out[:n]


class FrameCutter:
    """Split of the bytes of one link; stores the incomplete frame of every sender."""

    def __init__(self, max_senders: int = 4096) -> None:
        self.counts = np.zeros(2, np.int64)
        self._slots: dict[object, int] = {}
        self._carry, self._carried = np.empty(max_senders * CARRY_BYTES, np.uint8), np.zeros(max_senders, np.int64)

    @property
    def carried_bytes(self) -> int:
        """Return the number of bytes of incomplete frames."""
        return int(self._carried.sum())

    def feed(self, received: ReceivedBytes) -> bytes:
        """Return the records completed by these pieces."""
        slots = np.array([self._slot(sender) for sender in received.senders], np.int64)
        pieces = (received.buf, received.start, received.stop, slots[received.sender])
        us = np.round(received.arrival * 1e6).astype(np.int64)
        return cut(pieces, us, self._carry, self._carried, self.counts, EXTRA, CRC).tobytes()

    def _slot(self, sender: object) -> int:
        """Return the slot of a sender; if all are in use, free the oldest one and count its bytes as noise."""
        if sender not in self._slots:
            free = len(self._slots)
            if free == len(self._carried):
                free = self._slots.pop(next(iter(self._slots)))
                self.counts[NOISE] += self._carried[free]
                self._carried[free] = 0
            self._slots[sender] = free
        return self._slots[sender]
