"""MAVLink frames of every message with any content, and what pymavlink reads in them: the oracle of the decoder."""

from collections.abc import Iterator

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.telemetry.mavlink.parsing.decode import Decoder, Frames, GroupedFrames
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes
from fleet.telemetry.mavlink.parsing.scan import START, STOP

V1, V2 = mav.PROTOCOL_MARKER_V1, mav.PROTOCOL_MARKER_V2
KINDS = tuple(mav.mavlink_map[number] for number in sorted(mav.mavlink_map))


def frame(rng: np.random.Generator, kind: type, version: int, signed: bool = False) -> bytes:
    """Pack one message with random content: any numbers, printable text, zeros at the end cut off."""
    payload = bytearray(rng.bytes(kind.unpacker.size))
    at = 0
    for count, letter in _letters(kind):
        if letter == "s":
            text = rng.integers(32, 127, count).astype(np.uint8)
            text[int(rng.integers(0, count + 1)) :] = 0
            payload[at : at + count] = text.tobytes()
        at += np.dtype(_SIZES[letter]).itemsize * count
    if rng.random() < 0.3:
        payload[int(rng.integers(0, len(payload) + 1)) :] = b""
    sign = rng.bytes(13) if signed else b""
    told = bytes(payload).rstrip(b"\0") if version == V2 else bytes(payload)
    return framed(kind.id, told or b"\0", kind.crc_extra, version, who=rng.bytes(3), sign=sign)


_SIZES = {"s": "u1", "c": "u1", "b": "i1", "B": "u1", "h": "i2", "H": "u2", "i": "i4", "I": "u4"}
_SIZES |= {"q": "i8", "Q": "u8", "f": "f4", "d": "f8"}


def _letters(kind: type) -> Iterator[tuple[int, str]]:
    """Give count and type of every field on the wire."""
    number = ""
    for letter in kind.unpacker.format.lstrip("<"):
        if letter.isdigit():
            number += letter
        else:
            yield int(number or 1), letter
            number = ""


def framed(number: int, payload: bytes, extra: int, version: int = V2, *, who=b"\0\7\1", sign=b"") -> bytes:
    """Put head, checksum and signature round a payload; `who`: sequence number, system, component."""
    if version == V1:
        head = bytes([len(payload)]) + who + bytes([number])
    else:
        head = bytes([len(payload), bool(sign), 0]) + who + number.to_bytes(3, "little")
    crc = mav.x25crc(head + payload + bytes([extra])).crc
    return bytes([version]) + head + payload + crc.to_bytes(2, "little") + sign


def frames(rng: np.random.Generator, count: int) -> list[bytes]:
    """Pack messages of all kinds, one after the other, in both versions, some signed."""
    made = []
    for i in range(count):
        kind = KINDS[i % len(KINDS)]
        version = V1 if kind.id < 256 and rng.random() < 0.3 else V2
        made.append(frame(rng, kind, version, version == V2 and rng.random() < 0.1))
    return made


def worsened(rng: np.random.Generator, stream: bytes, every: int = 120) -> bytes:
    """Corrupt about one place in `every` bytes: bits turned, bytes lost, bytes added, magics where none belong."""
    out = bytearray()
    at = 0
    while at < len(stream):
        step = int(rng.integers(1, 2 * every))
        out += stream[at : at + step]
        at += step
        what = rng.random()
        if what < 0.3 and out:
            out[-1] ^= 1 << int(rng.integers(8))
        elif what < 0.6:
            at += int(rng.integers(1, 30))
        elif what < 0.8:
            out += rng.bytes(int(rng.integers(1, 30)))
        else:
            out += bytes([V2 if rng.random() < 0.5 else V1, int(rng.integers(256)), int(rng.integers(2))])
    return bytes(out)


def by_pymavlink(pieces: list[bytes]) -> list:
    """Hear a stream as pymavlink's own parser does, which loses what a false start swallows."""
    parser = mav.MAVLink(None)
    parser.robust_parsing = True
    heard = [message for piece in pieces for message in parser.parse_buffer(piece) or ()]
    return [m for m in heard if m.get_msgId() >= 0 and not isinstance(m, mav.MAVLink_unknown)]


def searched(stream: bytes) -> list:
    """Hear a stream with pymavlink's decoder for single frames, trying every byte: nothing good is lost."""
    parser, found, at = mav.MAVLink(None), [], 0
    while at + 8 <= len(stream):
        size = length(stream, at)
        if size and at + size <= len(stream):
            try:
                message = parser.decode(bytearray(stream[at : at + size]))
            except mav.MAVError:
                message = None
            if message is not None and not isinstance(message, mav.MAVLink_unknown):
                found.append(message)
                at += size
                continue
        at += 1
    return found


def length(stream: bytes, at: int) -> int:
    """Give the length that a frame at `at` claims; 0: none can begin there [bytes]."""
    if stream[at] == V1:
        return stream[at + 1] + 8
    return stream[at + 1] + 12 + 13 * (stream[at + 2] & 1) if stream[at] == V2 and stream[at + 2] < 2 else 0


def ours(pieces: list[bytes], decoder: Decoder | None = None) -> Frames:
    """Hear the same with the batched decoder, all at once."""
    return (decoder or Decoder()).decode(
        ReceivedBytes.from_pieces([(float(i), None, piece) for i, piece in enumerate(pieces)])
    )


def raw(frames: Frames) -> list[bytes]:
    """Give the bytes of every frame."""
    told = frames.buf.tobytes()
    return [told[start:stop] for start, stop in frames.headers[:, [START, STOP]].tolist()]


def assert_equal(frames: Frames, messages: list) -> None:
    """Compare everything, field by field."""
    assert raw(frames) == [bytes(m.get_msgbuf()) for m in messages]
    heads = [(m.get_msgId(), m.get_srcSystem(), m.get_srcComponent(), m.get_seq()) for m in messages]
    assert list(map(tuple, frames.headers[:, 4:8].tolist())) == heads
    dealt = GroupedFrames(frames)
    assert sorted(np.concatenate([dealt.fields(name)[0] for name in dealt.names()] or [np.empty(0, int)])) == list(
        range(len(messages))
    )
    for name in dealt.names():
        which, fields = dealt.fields(name)
        mine = [messages[i] for i in which.tolist()]
        assert all(m.get_type() == name for m in mine)
        for field in mine[0].fieldnames:
            _assert_field(name, field, getattr(fields, field), mine)


def _assert_field(name: str, field: str, got: np.ndarray, messages: list) -> None:
    if got.dtype.kind == "S":
        want = [getattr(m, f"_{field}_raw") for m in messages]
        assert got.tolist() == want, (name, field)
        return
    want = np.array([getattr(m, field) for m in messages], "f8" if got.dtype.kind == "f" else got.dtype.base)
    assert np.array_equal(want.reshape(got.shape), got, equal_nan=got.dtype.kind == "f"), (name, field)
