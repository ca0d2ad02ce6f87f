"""Compiled search for MAVLink frames, versions 1 and 2, in arbitrary bytes; never raises, never loses a valid frame.

After a false start the search continues one byte later, so that valid frames inside garbage are found. The checksum of
a frame with an unknown id cannot be tested. Such a frame is skipped if it fills a piece, or if it follows a frame, is
followed by a valid frame and contains none; otherwise it is a false start.
Source: MAVLink serialization guide; checksum CRC-16/MCRF4XX over everything but the magic, plus CRC_EXTRA.
"""

import numba as nb
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

V1, V2 = 0xFE, 0xFD
SIGNED = 0x01  # incompatibility flag of MAVLink 2
LONGEST = 280  # bytes of the longest frame, signature included
STAMP = 8  # bytes of the time stamp before a frame in a .tlog
START, STOP, PAYLOAD, SIZE, ID, SYSTEM, COMPONENT, SEQ, PART, COLUMNS = range(10)  # columns of a frame header
MESSAGES, BAD_BYTES, BAD_FRAMES, UNKNOWN, COUNTS = range(5)  # counters of `scan`
_EARLIEST, _LATEST = 3e14, 4e15  # plausible stamps [us since 1970]
_LONGEST_GAP = 86_400e6  # between two stamps [us]
_u = nb.uint64


def _crc_table() -> np.ndarray:
    """Return the effect of a byte followed by k zeros on the checksum, (8, 256), for eight bytes at once.

    Source: Kounavis & Berry 2005, "slicing-by-8".
    """
    table = np.tile(np.arange(256, dtype=np.uint16), (8, 1))
    for _ in range(8):
        table[0] = np.where(table[0] & 1, (table[0] >> 1) ^ np.uint16(0x8408), table[0] >> 1)
    for k in range(1, 8):
        table[k] = (table[k - 1] >> 8) ^ table[0][table[k - 1] & 0xFF]
    return table


def _extra_table() -> np.ndarray:
    extra = np.full(max(dialect.mavlink_map) + 1, -1, np.int16)
    for number, kind in dialect.mavlink_map.items():
        extra[number] = kind.crc_extra
    return extra


CRC = _crc_table()
EXTRA = _extra_table()
"""CRC_EXTRA by message id; -1: not in the dialect."""


@nb.njit(cache=True, nogil=True)
def frame_length(buf, at, end):
    """Return the length in the header of a frame at `at` [bytes]; 0: no frame, -1: incomplete header."""
    if end < at + 3:
        return -1
    if buf[at] == V1:
        return buf[at + 1] + 8
    if buf[at] != V2 or buf[at + 2] & ~SIGNED:
        return 0
    return buf[at + 1] + 12 + (13 if buf[at + 2] & SIGNED else 0)


@nb.njit(cache=True, nogil=True)
def message_id(buf, at):
    """Return the message id of the frame at `at`."""
    if buf[at] == V1:
        return nb.int64(buf[at + 5])
    return nb.int64(buf[at + 7]) | nb.int64(buf[at + 8]) << 8 | nb.int64(buf[at + 9]) << 16


@nb.njit(cache=True, nogil=True)
def checksum(told, at, end, extra, table):
    """Return the checksum of bytes `at` to `end` followed by CRC_EXTRA; `table` is `CRC`."""
    crc, i, last, low = _u(0xFFFF), _u(at), _u(end), _u(0xFF)  # unsigned: no check for negative indices
    while i + _u(8) <= last:
        a, b = _u(told[i]) ^ (crc & low), _u(told[i + _u(1)]) ^ (crc >> _u(8))
        early = table[7, a] ^ table[6, b] ^ table[5, told[i + _u(2)]] ^ table[4, told[i + _u(3)]]
        late = table[3, told[i + _u(4)]] ^ table[2, told[i + _u(5)]] ^ table[1, told[i + _u(6)]]
        crc = _u(early ^ late ^ table[0, told[i + _u(7)]])
        i += _u(8)
    while i < last:
        crc = crc >> _u(8) ^ _u(table[0, (crc ^ _u(told[i])) & low])
        i += _u(1)
    return crc >> _u(8) ^ _u(table[0, (crc ^ _u(extra)) & low])


@nb.njit(cache=True, nogil=True)
def _stamp(buf, at):
    t = 0.0
    for i in range(STAMP):
        t = t * 256.0 + buf[at + i]
    return t


@nb.njit(cache=True, nogil=True)
def _timely(t, last):
    return abs(t - last) < _LONGEST_GAP if last == last else _EARLIEST < t < _LATEST


@nb.njit(cache=True, nogil=True)
def sound(buf, at, end, extras, table):
    """Return the end of a complete, valid frame of a dialect message at `at`; 0 if there is none."""
    if at + 8 > end or (buf[at] != V1 and buf[at] != V2):
        return 0
    head, tail, number = 6, 2, nb.int64(buf[at + 5])
    if buf[at] == V2:
        if at + 12 > end or buf[at + 2] & ~SIGNED:
            return 0
        head, tail, number = 10, 15 if buf[at + 2] & SIGNED else 2, message_id(buf, at)
    crc = at + head + nb.int64(buf[at + 1])
    if crc + tail > end:
        return 0
    extra = extras[number] if number < len(extras) else -1
    if extra < 0 or checksum(buf, at + 1, crc, extra, table) != _u(buf[crc]) | _u(buf[crc + 1]) << _u(8):
        return 0
    return crc + tail


@nb.njit(cache=True, nogil=True)
def _leads_on(buf, at, end, extras, table):
    """Skip frames with unknown ids from `at`; return the start of the next valid frame or the end, or -1."""
    while at < end:
        if sound(buf, at, end, extras, table):
            return at
        length = frame_length(buf, at, end)
        if length <= 0 or at + length > end:
            return -1
        number = message_id(buf, at)
        if number < len(extras) and extras[number] >= 0:
            return -1
        at += length
    return at


@nb.njit(cache=True, nogil=True)
def _hides(buf, at, after, end, extras, table):
    """Return whether a valid frame starts between `at` and `after`."""
    inside = at + 1
    while inside < after and not sound(buf, inside, end, extras, table):
        inside += 1
    return inside < after


@nb.njit(cache=True, nogil=True)
def _note(buf, at, stop, found, n):
    """Store the header of frame `n`: all columns but PIECE."""
    second = buf[at] == V2
    head = 10 if second else 6
    found[n, START], found[n, STOP], found[n, PAYLOAD], found[n, SIZE] = at, stop, at + head, buf[at + 1]
    found[n, ID] = message_id(buf, at)
    found[n, SYSTEM] = buf[at + 5 if second else at + 3]
    found[n, COMPONENT] = buf[at + 6 if second else at + 4]
    found[n, SEQ] = buf[at + 4 if second else at + 2]


@nb.njit(cache=True, nogil=True)
def straight(buf, begin, end, found, extras, table):
    """Find the frames of pieces that contain only valid frames of dialect messages: the common case, optimised.

    Args:
        buf, headers, extras, table: as for `scan`
        begin, end: start and end of each piece, (k,)
    Returns:
        number of frames; -1 if the pieces contain anything else and need `scan`
    """
    n = 0
    for part in range(len(begin)):
        at, last = begin[part], end[part]
        while at < last:
            if at + 12 <= last and buf[at] == V2 and not buf[at + 2] & ~SIGNED:
                head, stop = 10, at + nb.int64(buf[at + 1]) + (25 if buf[at + 2] & SIGNED else 12)
            elif at + 8 <= last and buf[at] == V1:
                head, stop = 6, at + nb.int64(buf[at + 1]) + 8
            else:
                return -1
            number, crc = message_id(buf, at), at + head + nb.int64(buf[at + 1])
            if stop > last or number >= len(extras) or extras[number] < 0:
                return -1
            if checksum(buf, at + 1, crc, extras[number], table) != _u(buf[crc]) | _u(buf[crc + 1]) << _u(8):
                return -1
            _note(buf, at, stop, found, n)
            found[n, PART] = part
            n += 1
            at = stop
    return n


@nb.njit(cache=True, nogil=True)
def scan(buf, parts, prefix, last_t, found, times, counts, extras, table):
    """Find all valid frames of dialect messages.

    Args:
        buf: concatenated bytes of one or more senders, (n,) uint8
        pieces: per piece its start, replaced by the position to continue the search; its end; and 1 if it begins with
            carried bytes, 0 if it begins with a frame, (k, 3)
        prefix: 0, or `STAMP` in a .tlog
        last_t: newest stamp so far [us]; nan before the first
        headers: filled with `COLUMNS` numbers per frame, (m, 9) int64
        times: filled with the stamps in a .tlog [us], (m,)
        counts: incremented, (COUNTER_COUNT,) int64
        extras, table: `EXTRA`, `CRC`
    Returns:
        number of frames, newest stamp [us]
    """
    n = 0
    for part in range(len(parts)):
        begin, end = parts[part, 0], parts[part, 1]
        at = begin
        in_step, sure = parts[part, 2] == 0, at  # aligned to a frame end; unknown frames confirmed up to here
        while at + prefix < end:
            magic = at + prefix
            stop = sound(buf, magic, end, extras, table)
            if stop:
                t = _stamp(buf, at) if prefix else 0.0
                if not prefix or _timely(t, last_t):
                    _note(buf, magic, stop, found, n)
                    found[n, PART] = part
                    if prefix:
                        times[n] = last_t = t
                    n += 1
                    at, in_step = stop, True
                    continue
            length = frame_length(buf, magic, end)
            t = 0.0
            if length > 0 and prefix:
                t = _stamp(buf, at)
                length = length if _timely(t, last_t) else 0
            if (length < 0 and (buf[magic] == V1 or buf[magic] == V2)) or (length > 0 and magic + length > end):
                break
            if length <= 0:
                at += 1
                counts[BAD_BYTES] += 1
                in_step = False
                continue
            number, after = message_id(buf, magic), magic + length
            strange = number >= len(extras) or extras[number] < 0
            if strange and prefix:
                strange = sound(buf, after + prefix, end, extras, table) > 0 and _timely(_stamp(buf, after), t)
            elif strange and in_step and not (at == begin and after == end):
                if at >= sure:
                    sure = _leads_on(buf, after, end, extras, table)
                strange = sure >= 0 and not _hides(buf, at, after, end, extras, table)
            elif strange:
                strange = in_step
            if strange:
                counts[UNKNOWN] += 1
                at = after
            else:
                counts[BAD_FRAMES] += 1
                counts[BAD_BYTES] += 1
                at += 1
                in_step = False
        parts[part, 0] = at
    counts[MESSAGES] += n
    return n, last_t
