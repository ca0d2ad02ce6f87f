"""Compiled search for MAVLink frames, versions 1 and 2, in arbitrary bytes; never raises, never loses a valid frame.

After a false start the search continues one byte later, so that valid frames inside garbage are found. The checksum of
a frame with an unknown id cannot be tested. Such a frame is skipped if it fills a piece, or if it follows a frame, is
followed by a valid frame and contains none; otherwise it is a false start. The end of the bytes counts as a valid
frame, but if a frame that continues after the end may start inside, the next bytes decide.
Source: MAVLink serialization guide; checksum CRC-16/MCRF4XX over everything but the magic, plus CRC_EXTRA.
"""

import numba as nb
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

V1, V2 = 0xFE, 0xFD
SIGNED = 0x01  # incompatibility flag of MAVLink 2
STAMP_SIZE = 8  # bytes of the time stamp before a frame in a .tlog
START, STOP, PAYLOAD, SIZE, ID, SYSTEM, COMPONENT, SEQ, PIECE, COLUMNS = range(10)  # columns of a frame header
MESSAGES, BAD_BYTES, BAD_FRAMES, UNKNOWN_FRAMES, COUNTER_COUNT = range(5)  # counters of `scan`
_MIN_STAMP_US, _MAX_STAMP_US = 3e14, 4e15  # plausible stamps [us since 1970]
_MAX_STAMP_GAP_US = 86_400e6  # between two stamps [us]
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
def checksum(data, at, end, extra, table):
    """Return the checksum of bytes `at` to `end` followed by CRC_EXTRA; `table` is `CRC`."""
    crc, i, last, low = _u(0xFFFF), _u(at), _u(end), _u(0xFF)  # unsigned: no check for negative indices
    while i + _u(8) <= last:
        a, b = _u(data[i]) ^ (crc & low), _u(data[i + _u(1)]) ^ (crc >> _u(8))
        high_bytes = table[7, a] ^ table[6, b] ^ table[5, data[i + _u(2)]] ^ table[4, data[i + _u(3)]]
        low_bytes = table[3, data[i + _u(4)]] ^ table[2, data[i + _u(5)]] ^ table[1, data[i + _u(6)]]
        crc = _u(high_bytes ^ low_bytes ^ table[0, data[i + _u(7)]])
        i += _u(8)
    while i < last:
        crc = crc >> _u(8) ^ _u(table[0, (crc ^ _u(data[i])) & low])
        i += _u(1)
    return crc >> _u(8) ^ _u(table[0, (crc ^ _u(extra)) & low])


@nb.njit(cache=True, nogil=True)
def _stamp(buf, at):
    t = 0.0
    for i in range(STAMP_SIZE):
        t = t * 256.0 + buf[at + i]
    return t


@nb.njit(cache=True, nogil=True)
def _is_plausible_stamp(t, last):
    return abs(t - last) < _MAX_STAMP_GAP_US if last == last else _MIN_STAMP_US < t < _MAX_STAMP_US


@nb.njit(cache=True, nogil=True)
def valid_frame_end(buf, at, end, extras, table):
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
def _skip_unknown(buf, at, end, extras, table):
    """Skip frames with unknown ids from `at`; return the start of the next valid frame or the end, or -1."""
    while at < end:
        if valid_frame_end(buf, at, end, extras, table):
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
def _contains_valid(buf, at, after, end, extras, table):
    """Return whether a valid frame starts between `at` and `after`."""
    start = at + 1
    while start < after and not valid_frame_end(buf, start, end, extras, table):
        start += 1
    return start < after


@nb.njit(cache=True, nogil=True)
def _may_contain_start(buf, at, after, end, extras):
    """Return whether a frame of a dialect message that continues after `end` may start between `at` and `after`."""
    for start in range(at + 1, after):
        if buf[start] != V1 and buf[start] != V2:
            continue
        length = frame_length(buf, start, end)
        if length < 0 or (length > 0 and start + length > end):
            if start + (10 if buf[start] == V2 else 6) > end:
                return True
            number = message_id(buf, start)
            if number < len(extras) and extras[number] >= 0:
                return True
    return False


@nb.njit(cache=True, nogil=True)
def _store_header(buf, at, stop, headers, n):
    """Store the header of frame `n`: all columns but PIECE."""
    is_v2 = buf[at] == V2
    header_size = 10 if is_v2 else 6
    headers[n, START], headers[n, STOP], headers[n, PAYLOAD], headers[n, SIZE] = at, stop, at + header_size, buf[at + 1]
    headers[n, ID] = message_id(buf, at)
    headers[n, SYSTEM] = buf[at + 5 if is_v2 else at + 3]
    headers[n, COMPONENT] = buf[at + 6 if is_v2 else at + 4]
    headers[n, SEQ] = buf[at + 4 if is_v2 else at + 2]


@nb.njit(cache=True, nogil=True)
def scan_clean(buf, begin, end, headers, extras, table):
    """Find the frames of pieces that contain only valid frames of dialect messages: the common case, optimised.

    Args:
        buf, headers, extras, table: as for `scan`
        begin, end: start and end of each piece, (k,)
    Returns:
        number of frames; -1 if the pieces contain anything else and need `scan`
    """
    n = 0
    for piece in range(len(begin)):
        at, piece_end = begin[piece], end[piece]
        while at < piece_end:
            if at + 12 <= piece_end and buf[at] == V2 and not buf[at + 2] & ~SIGNED:
                header_size, stop = 10, at + nb.int64(buf[at + 1]) + (25 if buf[at + 2] & SIGNED else 12)
            elif at + 8 <= piece_end and buf[at] == V1:
                header_size, stop = 6, at + nb.int64(buf[at + 1]) + 8
            else:
                return -1
            number, crc = message_id(buf, at), at + header_size + nb.int64(buf[at + 1])
            if stop > piece_end or number >= len(extras) or extras[number] < 0:
                return -1
            if checksum(buf, at + 1, crc, extras[number], table) != _u(buf[crc]) | _u(buf[crc + 1]) << _u(8):
                return -1
            _store_header(buf, at, stop, headers, n)
            headers[n, PIECE] = piece
            n += 1
            at = stop
    return n


@nb.njit(cache=True, nogil=True)
def scan(buf, pieces, prefix, last_t, headers, times, counts, extras, table):
    """Find all valid frames of dialect messages.

    Args:
        buf: concatenated bytes of one or more senders, (n,) uint8
        pieces: per piece its start, replaced by the position to continue the search; its end; and 0 if it begins with
            a frame, 1 if with carried bytes, 2 if with a carried unknown frame that follows a frame, replaced by 1 or 2
            for the bytes to carry, (k, 3)
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
    for piece in range(len(pieces)):
        begin, end = pieces[piece, 0], pieces[piece, 1]
        at = begin
        is_aligned, confirmed = pieces[piece, 2] != 1, at  # aligned to a frame end; unknown frames confirmed up to here
        is_carried, rest = pieces[piece, 2] != 0, 1
        while at + prefix < end:
            magic = at + prefix
            stop = valid_frame_end(buf, magic, end, extras, table)
            if stop:
                t = _stamp(buf, at) if prefix else 0.0
                if not prefix or _is_plausible_stamp(t, last_t):
                    _store_header(buf, magic, stop, headers, n)
                    headers[n, PIECE] = piece
                    if prefix:
                        times[n] = last_t = t
                    n += 1
                    at, is_aligned = stop, True
                    continue
            length = frame_length(buf, magic, end)
            t = 0.0
            if length > 0 and prefix:
                t = _stamp(buf, at)
                length = length if _is_plausible_stamp(t, last_t) else 0
            if (length < 0 and (buf[magic] == V1 or buf[magic] == V2)) or (length > 0 and magic + length > end):
                break
            if length <= 0:
                at += 1
                counts[BAD_BYTES] += 1
                is_aligned = False
                continue
            number, after = message_id(buf, magic), magic + length
            is_unknown = number >= len(extras) or extras[number] < 0
            if is_unknown and prefix:
                is_unknown = valid_frame_end(buf, after + prefix, end, extras, table) > 0 and _is_plausible_stamp(
                    _stamp(buf, after), t
                )
            elif is_unknown and is_aligned and (is_carried or at != begin or after != end):
                if at >= confirmed:
                    confirmed = _skip_unknown(buf, after, end, extras, table)
                is_unknown = confirmed >= 0 and not _contains_valid(buf, at, after, end, extras, table)
                if is_unknown and confirmed == end and _may_contain_start(buf, at, after, end, extras):
                    rest = 2
                    break
            elif is_unknown:
                is_unknown = is_aligned
            if is_unknown:
                counts[UNKNOWN_FRAMES] += 1
                at = after
            else:
                counts[BAD_FRAMES] += 1
                counts[BAD_BYTES] += 1
                at += 1
                is_aligned = False
        pieces[piece, 0], pieces[piece, 2] = at, rest
    counts[MESSAGES] += n
    return n, last_t
