"""Bytes to MAVLink messages, versions 1 and 2, behind one door; whatever arrives, nothing is raised.

After a false start the search goes on one byte later, so that a good frame inside garbage is still found.
"""

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

V1, V2 = 0xFE, 0xFD
SIGNED = 0x01  # incompatibility flag of MAVLink 2
LONGEST = 280  # bytes of the longest frame, signature included


class Decoder:
    """Parse one stream of bytes; each sender needs its own, for frames may be cut between datagrams."""

    def __init__(self) -> None:
        self.bad_bytes = 0  # bytes that belonged to no frame
        self.bad_frames = 0  # frames with a wrong checksum or an unknown message id
        self.messages = 0
        self._mav = dialect.MAVLink(None)
        self._carry = bytearray()

    def feed(self, data: bytes) -> list[Any]:
        """Take bytes as they came, give the messages completed by them, oldest first."""
        buf = self._carry
        buf += data
        found: list[Any] = []
        at = 0
        while (start := _next_magic(buf, at)) < len(buf):
            self.bad_bytes += start - at
            at = start
            length = frame_length(buf, at)
            if length == 0:
                at += 1
                self.bad_bytes += 1
                continue
            if length < 0 or at + length > len(buf):
                break
            message = self._decode(buf[at : at + length])
            if message is not None:
                found.append(message)
                at += length
            elif self._is_foreign(buf, at, length):
                at += length
            else:
                at += 1
                self.bad_bytes += 1
        else:
            self.bad_bytes += len(buf) - at
            at = len(buf)
        del buf[:at]
        self.messages += len(found)
        return found

    def _decode(self, frame: bytearray) -> Any | None:
        try:
            message = self._mav.decode(frame)
        except (dialect.MAVError, ValueError, IndexError):  # checksum, or text that is no text
            self.bad_frames += 1
            return None
        return None if message.get_type().startswith("UNKNOWN") else message

    def _is_foreign(self, buf: bytearray, at: int, length: int) -> bool:
        """Tell whether a frame with an id unknown here is one all the same: then it fills what arrived exactly."""
        if _message_id(buf, at) in dialect.mavlink_map:
            return False
        self.bad_frames += 1
        return at == 0 and length == len(buf)


def _next_magic(buf: bytearray, at: int) -> int:
    found = [i for i in (buf.find(V1, at), buf.find(V2, at)) if i >= 0]
    return min(found, default=len(buf))


def frame_length(buf: bytes | bytearray, at: int = 0) -> int:
    """Give the length a frame starting at `at` claims [bytes]; 0: no frame, -1: header not complete yet."""
    if len(buf) < at + 3:
        return -1
    if buf[at] == V1:
        return buf[at + 1] + 8
    if buf[at] != V2 or buf[at + 2] & ~SIGNED:
        return 0
    return buf[at + 1] + 12 + (13 if buf[at + 2] & SIGNED else 0)


def _message_id(buf: bytearray, at: int) -> int:
    if buf[at] == V1:
        return buf[at + 5]
    return int.from_bytes(buf[at + 7 : at + 10], "little")
