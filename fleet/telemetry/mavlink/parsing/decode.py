"""Decode bytes of many senders to MAVLink frames, and frames to field arrays or message objects."""

import re
from collections import Counter, OrderedDict, namedtuple
from collections.abc import Hashable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.telemetry.mavlink.parsing import scan as s
from fleet.telemetry.mavlink.parsing.received import (
    ReceivedBytes,
    collect_payloads,
    compact,
    group_payloads,
    joined_senders,
    read_only,
)


class _MessageBase:
    """Base of all message objects, with pymavlink's interface."""

    __slots__ = ()
    NAME = ""

    def get_type(self) -> str:
        """Return the message name."""
        return self.NAME

    def get_srcSystem(self) -> int:
        """Return the MAVLink system id of the sender."""
        return self[-2]  # type: ignore[index, no-any-return]

    def get_srcComponent(self) -> int:
        """Return the MAVLink component id of the sender."""
        return self[-1]  # type: ignore[index, no-any-return]


@cache
def message_class(name: str, fields: tuple[str, ...]) -> type:
    """Return the class of the objects of a message."""
    fields_class = namedtuple(name, (*fields, "system", "component"))  # type: ignore[misc]
    return type(name, (_MessageBase, fields_class), {"__slots__": (), "NAME": name})


def message_objects(name: str, rows: np.ndarray, systems: Sequence[int], components: Sequence[int]) -> list[Any]:
    """Create a message object for every row of field values.

    Args:
        name: message name
        rows: structured array with the layout `decode.layout(name)`, (n,)
        systems, components: MAVLink ids of the senders, n numbers
    """
    names = rows.dtype.names or ()
    columns = [rows[field].tolist() for field in names]
    for k, field in enumerate(names):
        if rows.dtype[field].kind == "S":
            columns[k] = [text.split(b"\0", 1)[0].decode("ascii", errors="replace") for text in columns[k]]
    return list(map(message_class(name, names), *columns, systems, components))


MAX_SENDERS = 512  # senders of one link whose incomplete frames are stored
_NAMES = {number: kind.msgname for number, kind in dialect.mavlink_map.items()}
IDS = {name: number for number, name in _NAMES.items()}
_NUMPY_TYPE = {"b": "i1", "B": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4"}
_NUMPY_TYPE |= {"q": "<i8", "Q": "<u8", "f": "<f4", "d": "<f8"}


class Frames(NamedTuple):
    """Valid frames in order of reception."""

    buf: np.ndarray  # bytes that contain the frames, (b,) uint8
    headers: np.ndarray  # `scan.COLUMNS` numbers per frame, (n, 9)
    arrival: np.ndarray  # fleet time, (n,) [s since 1970]
    sender: np.ndarray  # number of the sender in `senders`, (n,)
    senders: tuple[Hashable, ...] = (None,)

    def messages(self, frame_numbers: np.ndarray) -> list[Any]:
        """Return frames, by number, as message objects like those of pymavlink, (k,)."""
        messages: list[Any] = [None] * len(frame_numbers)
        ids = self.headers[frame_numbers, s.ID]
        for message_id in np.unique(ids).tolist():
            positions = np.flatnonzero(ids == message_id)
            selected, name = frame_numbers[positions], _NAMES[message_id]
            addresses = self.headers[selected][:, [s.SYSTEM, s.COMPONENT]].T.tolist()
            objects = message_objects(name, self.fields(selected, name).rows, *addresses)
            for k, message in zip(positions.tolist(), objects, strict=True):
                messages[k] = message
        return messages

    def subset(self, selection: np.ndarray) -> "Frames":
        """Return a selection of the frames, by number or mask."""
        return self._replace(
            headers=self.headers[selection], arrival=self.arrival[selection], sender=self.sender[selection]
        )

    def fields(self, frame_numbers: np.ndarray, name: str) -> "Fields":
        """Return the fields of frames of one message as arrays."""
        dtype = layout(name)
        starts, sizes = self.headers[frame_numbers, s.PAYLOAD], self.headers[frame_numbers, s.SIZE]
        return Fields(collect_payloads(self.buf, starts, sizes, dtype.itemsize).view(dtype)[:, 0])


_POSITIONS = np.isin(np.arange(s.COLUMNS), [s.START, s.STOP, s.PAYLOAD])  # columns with positions in `Frames.buf`


def joined_frames(parts: Sequence[Frames]) -> Frames:
    """Join several batches in order."""
    if len(parts) == 1:
        return parts[0]
    offsets = np.cumsum([0, *(len(part.buf) for part in parts)])
    headers = [part.headers + offset * _POSITIONS for part, offset in zip(parts, offsets, strict=False)]
    buf, arrival = np.concatenate([part.buf for part in parts]), np.concatenate([part.arrival for part in parts])
    return Frames(read_only(buf), np.concatenate(headers), arrival, *joined_senders(parts))


class Fields:
    """Field arrays of frames of one message, by field name."""

    __slots__ = ("rows",)

    def __init__(self, rows: np.ndarray) -> None:
        self.rows = rows

    def __getattr__(self, name: str) -> np.ndarray:
        return self.rows[name]


_DTYPES: dict[str, np.dtype] = {}


def layout(name: str) -> np.dtype:
    """Return the wire layout of a message, derived from pymavlink's class."""
    if name not in _DTYPES:
        message_class = dialect.mavlink_map[IDS[name]]
        tokens = re.findall(r"(\d*)([a-zA-Z])", message_class.unpacker.format.lstrip("<"))
        dtype_fields: list[Any] = []
        for field, (count, letter) in zip(message_class.ordered_fieldnames, tokens, strict=True):
            shape = () if letter in "cs" or int(count or 1) == 1 else (int(count),)
            dtype_fields.append((field, f"S{count or 1}" if letter in "cs" else _NUMPY_TYPE[letter], shape))
        _DTYPES[name] = np.dtype(dtype_fields)
    return _DTYPES[name]


def restore_message(name: str, values: Sequence[Any]) -> Any:
    """Return the message object whose values, with system and component, were stored."""
    return message_class(name, layout(name).names or ())(*values)


_KIND_BY_NAME = {_NAMES[number]: kind for kind, number in enumerate(sorted(_NAMES))}
_KIND_BY_ID = np.zeros(len(s.EXTRA), np.int64)
_KIND_BY_ID[[IDS[name] for name in _KIND_BY_NAME]] = list(_KIND_BY_NAME.values())
_LAYOUTS = [layout(name) for name in _KIND_BY_NAME]
_WIDTHS = np.array([kind.itemsize for kind in _LAYOUTS])


MESSAGE_NAMES = tuple(_KIND_BY_NAME)
"""Names of all messages of the dialect, by number."""


def message_kinds(frames: Frames) -> np.ndarray:
    """Return the index of each frame's message in `MESSAGE_NAMES`, (n,)."""
    return _KIND_BY_ID[frames.headers[:, s.ID]]


class GroupedFrames:
    """Frames grouped by message, in order of reception."""

    def __init__(self, frames: Frames) -> None:
        self._payloads, payload_start, self._frame_numbers, frame_start = group_payloads(
            frames.buf, frames.headers, _KIND_BY_ID, _WIDTHS
        )
        self._payload_start, self._frame_start = payload_start, frame_start

    def fields(self, name: str) -> tuple[np.ndarray, Fields]:
        """Return the frames of one message: frame numbers, (k,), and field arrays."""
        kind = _KIND_BY_NAME[name]
        payload = self._payloads[self._payload_start[kind] : self._payload_start[kind + 1]]
        frame_numbers = self._frame_numbers[self._frame_start[kind] : self._frame_start[kind + 1]]
        return frame_numbers, Fields(payload.view(_LAYOUTS[kind]))

    def names(self) -> list[str]:
        """Return the names of the received messages."""
        return [MESSAGE_NAMES[kind] for kind in np.flatnonzero(np.diff(self._frame_start)).tolist()]


class Decoder:
    """Find frames in the bytes of many senders; incomplete frames are carried over by sender."""

    def __init__(self) -> None:
        self.counts = np.zeros(s.COUNTER_COUNT, np.int64)
        self._carry: OrderedDict[Hashable, tuple[bytes, int]] = OrderedDict()  # bytes; how they begin, see `scan.scan`

    def counters(self) -> Counter[str]:
        """Return the counts of messages, bad_bytes, bad_frames and unknown (frames of messages outside the dialect)."""
        names = ("messages", "bad_bytes", "bad_frames", "unknown")
        return Counter(dict(zip(names, self.counts.tolist(), strict=True)))

    def decode(self, received: ReceivedBytes) -> Frames:
        """Decode pieces in order of arrival; return the frames they complete."""
        received = received._replace(buf=read_only(received.buf))
        if self._carry and not self._carry.keys().isdisjoint(received.senders):
            return self._decode_joined(received)
        headers = _empty_headers(received.buf, 0)
        n = s.scan_clean(received.buf, received.start, received.stop, headers, s.EXTRA, s.CRC)
        if n < 0:
            counts = self.counts.copy()
            parts = np.stack([received.start, received.stop, np.zeros_like(received.start)], axis=1)
            headers, _, _ = find_frames(received.buf, parts, counts)
            if (parts[:, 0] < parts[:, 1]).any():
                return self._decode_joined(received)
            self.counts[:] = counts
        else:
            self.counts[s.MESSAGES] += n
            headers = headers[:n]
        part = headers[:, s.PIECE]
        return Frames(received.buf, headers, received.arrival[part], received.sender[part], received.senders)

    def _decode_joined(self, received: ReceivedBytes) -> Frames:
        """Decode the joined pieces of each sender, after its carried bytes."""
        order = np.argsort(received.sender, kind="stable")
        data, ends = compact(received.buf, received.start[order], (received.stop - received.start)[order])
        last = np.searchsorted(received.sender[order], np.arange(len(received.senders)), side="right")
        stops = np.concatenate([[0], ends])[last]  # end of each sender's bytes
        carries, begins = zip(*(self._carry.pop(sender, (b"", 0)) for sender in received.senders), strict=True)
        carried = np.array([len(carry) for carry in carries])
        carried_before = np.cumsum(carried)
        pieces = zip(carries, np.split(data, stops[:-1]), strict=True)
        buf = np.frombuffer(
            b"".join(part for carry, sender_data in pieces for part in (carry, sender_data.tobytes())), np.uint8
        )
        parts = np.stack([np.concatenate([[0], (stops + carried_before)[:-1]]), stops + carried_before, begins], axis=1)
        headers, _, _ = find_frames(buf, parts, self.counts)
        for number in np.flatnonzero(parts[:, 0] < parts[:, 1]).tolist():
            begin, end, how = parts[number].tolist()
            self._store_carry(received.senders[number], (buf[begin:end].tobytes(), how))
        sender = headers[:, s.PIECE]
        # A frame wholly in the carried bytes (inside a false start) gets the arrival of its sender's first bytes of the
        # batch: its own is not stored, and its position here would be in the bytes of another sender.
        first = np.concatenate([[0], stops[:-1]]) + 1
        frame_ends = np.maximum(headers[:, s.STOP] - carried_before[sender], first[sender])
        arrival = received.arrival[order][np.searchsorted(ends, frame_ends)]
        order = np.argsort(arrival, kind="stable")
        return Frames(buf, headers[order], arrival[order], sender[order], received.senders)

    def _store_carry(self, sender: Hashable, rest: tuple[bytes, int]) -> None:
        self._carry[sender] = rest
        if len(self._carry) > MAX_SENDERS:
            self.counts[s.BAD_BYTES] += len(self._carry.popitem(last=False)[1][0])


def find_frames(
    buf: np.ndarray, parts: np.ndarray, counts: np.ndarray, prefix: int = 0, last_t: float = np.nan
) -> tuple[np.ndarray, np.ndarray, float]:
    """Run `scan.scan` on `buf`; return frames (n, 9), their stamps (n,) [us] and the newest stamp [us]."""
    headers = _empty_headers(buf, prefix)
    times = np.empty(len(headers) if prefix else 0)
    n, last_t = s.scan(buf, parts, prefix, last_t, headers, times, counts, s.EXTRA, s.CRC)
    return headers[:n], times[:n], last_t


def _empty_headers(buf: np.ndarray, prefix: int) -> np.ndarray:
    """Return an empty header array for the maximum number of frames in `buf`."""
    return np.empty((len(buf) // (8 + prefix) + 1, s.COLUMNS), np.int64)
