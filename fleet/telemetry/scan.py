"""The compiled search for MAVLink frames, versions 1 and 2, in any bytes; nothing is raised, nothing good is lost.

After a false start the search goes on one byte later, so that a good frame inside garbage is still found.
Source: MAVLink serialization guide; checksum CRC-16/MCRF4XX over everything but the magic, plus CRC_EXTRA.
"""

import numba as nb
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

V1, V2 = 0xFE, 0xFD
SIGNED = 0x01  # incompatibility flag of MAVLink 2
LONGEST = 280  # bytes of the longest frame, signature included
STAMP = 8  # bytes of time before a frame in a .tlog
START, STOP, PAYLOAD, SIZE, ID, SYSTEM, COMPONENT, SEQ, COLUMNS = range(9)  # columns of what `scan` finds
_EARLIEST, _LATEST = 3e14, 4e15  # believable stamps [us since 1970]
_LONGEST_GAP = 86_400e6  # between two stamps [us]


def _crc_table() -> np.ndarray:
    table = np.arange(256, dtype=np.uint16)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint16(0x8408), table >> 1).astype(np.uint16)
    return table


def _extra_table() -> np.ndarray:
    extra = np.full(max(dialect.mavlink_map) + 1, -1, np.int16)
    for number, kind in dialect.mavlink_map.items():
        extra[number] = kind.crc_extra
    return extra


CRC = _crc_table()
EXTRA = _extra_table()
"""CRC_EXTRA by message id; -1: no such message here."""


@nb.njit(cache=True)
def frame_length(buf, at, end):
    """Give the length a frame starting at `at` claims [bytes]; 0: no frame, -1: header not complete yet."""
    if end < at + 3:
        return -1
    if buf[at] == V1:
        return buf[at + 1] + 8
    if buf[at] != V2 or buf[at + 2] & ~SIGNED:
        return 0
    return buf[at + 1] + 12 + (13 if buf[at + 2] & SIGNED else 0)


@nb.njit(cache=True)
def _message_id(buf, at):
    if buf[at] == V1:
        return nb.int64(buf[at + 5])
    return nb.int64(buf[at + 7]) | nb.int64(buf[at + 8]) << 8 | nb.int64(buf[at + 9]) << 16


@nb.njit(cache=True)
def _sound(buf, at, head, size, extra, table):
    crc = 0xFFFF
    for i in range(at + 1, at + head + size):
        crc = crc >> 8 ^ table[(crc ^ buf[i]) & 0xFF]
    crc = crc >> 8 ^ table[(crc ^ extra) & 0xFF]
    return crc == buf[at + head + size] | buf[at + head + size + 1] << 8


@nb.njit(cache=True)
def _stamp(buf, at):
    t = 0.0
    for i in range(STAMP):
        t = t * 256.0 + buf[at + i]
    return t


@nb.njit(cache=True)
def _timely(t, last):
    return abs(t - last) < _LONGEST_GAP if last == last else _EARLIEST < t < _LATEST


@nb.njit(cache=True)
def _known(buf, at, end, extras, table):
    """Tell whether a whole, sound frame of a message known here starts at `at`."""
    length = frame_length(buf, at, end)
    if length <= 0 or at + length > end:
        return False
    number = _message_id(buf, at)
    extra = extras[number] if number < len(extras) else -1
    return extra >= 0 and _sound(buf, at, 6 if buf[at] == V1 else 10, nb.int64(buf[at + 1]), extra, table)


@nb.njit(cache=True)
def scan(buf, parts, prefix, last_t, found, times, counts, extras, table):
    """Find every sound frame of a message known here.

    Args:
        buf: bytes of one or more senders, one after the other, (n,) uint8
        parts: where each sender's bytes begin and end, (k, 2); replaced by where its search must go on, and the end
        prefix: 0, or `STAMP` in a .tlog
        last_t: newest stamp so far [us]; nan before any
        found: filled with `COLUMNS` numbers a frame, (m, 8) int64
        times: filled with the stamps [us], (m,)
        counts: raised: messages, bad bytes, bad frames, (3,) int64
        extras, table: `EXTRA`, `CRC`
    Returns:
        how many were found, newest stamp [us]
    """
    n = 0
    for part in range(len(parts)):
        at, end = parts[part, 0], parts[part, 1]
        while at + prefix < end:
            magic = at + prefix
            length = frame_length(buf, magic, end)
            t = 0.0
            if length > 0 and prefix:
                t = _stamp(buf, at)
                length = length if _timely(t, last_t) else 0
            if length == 0:
                at += 1
                counts[1] += 1
                continue
            if (length < 0 and (buf[magic] == V1 or buf[magic] == V2)) or magic + length > end:
                break
            if length < 0:
                at += 1
                counts[1] += 1
                continue
            head = 6 if buf[magic] == V1 else 10
            size, number = nb.int64(buf[magic + 1]), _message_id(buf, magic)
            if _known(buf, magic, end, extras, table):
                found[n, START], found[n, STOP] = magic, magic + length
                found[n, PAYLOAD], found[n, SIZE], found[n, ID] = magic + head, size, number
                found[n, SYSTEM] = buf[magic + (3 if head == 6 else 5)]
                found[n, COMPONENT] = buf[magic + (4 if head == 6 else 6)]
                found[n, SEQ] = buf[magic + (2 if head == 6 else 4)]
                times[n] = t
                if prefix:
                    last_t = t
                n += 1
                at = magic + length
                continue
            counts[2] += 1
            after = magic + length
            if prefix:
                whole = _known(buf, after + prefix, end, extras, table) and _timely(_stamp(buf, after), t)
            else:
                whole = at == parts[part, 0] and after == end
            if whole and (number >= len(extras) or extras[number] < 0):
                at = after  # a message unknown here, sound for all one can tell
            else:
                at += 1
                counts[1] += 1
        parts[part, 0] = at
    counts[0] += n
    return n, last_t


@nb.njit(cache=True)
def gather(buf, starts, sizes, width):
    """Lay payloads under each other, zeros where the sender cut them off, (n, width) uint8."""
    out = np.zeros((len(starts), width), np.uint8)
    for i in range(len(starts)):
        for k in range(min(sizes[i], width)):
            out[i, k] = buf[starts[i] + k]
    return out
