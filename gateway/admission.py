"""Admission of frames of one link: message filter and signature check."""

import hashlib
import hmac
import os
import re
import stat
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.telemetry.mavlink.parsing.decode import Frames
from fleet.telemetry.mavlink.parsing.scan import COMPONENT, EXTRA, START, STOP, SYSTEM, V2
from fleet.telemetry.mavlink.parsing.scan import SIGNED as FLAG
from gateway.link_spec import LinkSpec, MessageFilter

FILTERED = "excluded by the filter of the link"
WRONG = "signature: wrong"
REPLAYED = "signature: its time was used before"
STALE = "signature: its time lies more than a minute back"
UNSIGNED = "signature: none, and this link requires one"
_EPOCH_S = 1_420_070_400  # 2015-01-01 [s since 1970]
_UNITS = 100_000  # of a time stamp [1/s]
_WINDOW = 60 * _UNITS  # oldest time accepted from a new sender
_TAIL, _STAMP, _SIGNATURE = 13, 6, 6  # link id, time, signature [bytes]
MAX_SENDERS = 4096  # senders whose times are stored


def read_keys(path: Path) -> dict[str, bytes]:
    """Read keys by name: lines of `NAME KEY`, KEY being 64 hex digits; # begins a comment.

    Raises:
        ValueError: when others may read the file, or a line is invalid.
        OSError: when it cannot be read.
    """
    with path.open() as file:
        file_stat = os.fstat(file.fileno())
        mode = stat.S_IMODE(file_stat.st_mode)
        if not stat.S_ISREG(file_stat.st_mode) or mode & 0o077 or file_stat.st_uid not in (0, os.geteuid()):
            permissions = f"mode {mode:04o}, owner {file_stat.st_uid}"
            raise ValueError(
                f"keys {path}: found {permissions}, expected a file readable only by its owner; chmod 600 {path}"
            )
        lines = [line.split("#")[0].split() for line in file.read().splitlines()]
    keys: dict[str, bytes] = {}
    for number, fields in enumerate(lines, start=1):
        if fields and (len(fields) != 2 or not re.fullmatch(r"[0-9a-fA-F]{64}", fields[1]) or fields[0] in keys):
            raise ValueError(
                f"keys {path}: found invalid line {number}, expected a new name and 64 hex digits; correct it"
            )
        if fields:
            keys[fields[0]] = bytes.fromhex(fields[1])
    return keys


def select_key(keys: dict[str, bytes], name: str, link: str) -> bytes:
    """Return the key of a link: the named one, or the only one.

    Raises:
        ValueError: when there is no such key.
    """
    if name in keys or (not name and len(keys) == 1):
        return keys.get(name) or next(iter(keys.values()))
    available = f"no key {name!r}" if name else f"{len(keys)} keys and none named"
    raise ValueError(f"link {link}: found {available}, expected one of --keys FILE; write #sign=require&key=NAME")


def stamp_now() -> int:
    """Return the present time in units of signatures [10 us since 2015]."""
    return round((time.time() - _EPOCH_S) * _UNITS)


class Signing:
    """Signature check and signing of one link.

    Args:
        key: shared key, 32 bytes
        require: refuse unsigned frames
        link: our link id, 0..255
        clock: returns the time in units of signatures
    """

    def __init__(self, key: bytes, require: bool, link: int = 0, clock: Callable[[], int] = stamp_now) -> None:
        self._key, self._require, self._link, self._clock = key, require, link & 0xFF, clock
        self._last: dict[tuple[int, int, int], int] = {}  # newest verified time, by system, component, sender's link id
        self._last_sent = 0  # newest time sent

    def verify(self, frames: Frames, refused: Counter[str]) -> np.ndarray:
        """Return whether each frame is accepted, (n,) bool; refused frames are counted by reason."""
        passed = np.ones(len(frames.headers), bool)
        for i, header in enumerate(frames.headers.tolist()):
            frame = frames.buf[header[START] : header[STOP]].tobytes()
            if reason := self._rejection_reason(frame, header[SYSTEM], header[COMPONENT]):
                passed[i] = False
                refused[reason] += 1
        return passed

    def _rejection_reason(self, frame: bytes, system: int, component: int) -> str:
        """Return the reason to refuse a frame; empty: it is accepted."""
        if frame[0] != V2 or not frame[2] & FLAG:
            return UNSIGNED if self._require else ""
        if not hmac.compare_digest(self._signature(frame[:-_SIGNATURE]), frame[-_SIGNATURE:]):
            return WRONG
        sender = system, component, frame[-_TAIL]
        stamp = int.from_bytes(frame[-_TAIL + 1 : -_SIGNATURE], "little")
        last = self._last.get(sender)
        if last is not None and stamp <= last:
            return REPLAYED
        if last is None and stamp < self._clock() - _WINDOW:
            return STALE
        if last is None and len(self._last) >= MAX_SENDERS:
            self._last.pop(next(iter(self._last)))
        self._last[sender] = stamp
        self._last_sent = max(self._last_sent, stamp)  # a peer whose clock is ahead would refuse ours as replayed
        return ""

    def sign(self, frame: bytes) -> bytes:
        """Return a MAVLink 2 frame with its signature."""
        body = bytearray(frame[:-2])
        body[2] |= FLAG
        extra = int(EXTRA[int.from_bytes(body[7:10], "little")])
        body += dialect.x25crc(bytes(body[1:]) + bytes([extra])).crc.to_bytes(2, "little")
        self._last_sent = max(self._last_sent + 1, self._clock())
        body += bytes([self._link]) + self._last_sent.to_bytes(_STAMP, "little")
        return bytes(body) + self._signature(bytes(body))

    def _signature(self, signed: bytes) -> bytes:
        return hashlib.sha256(self._key + signed).digest()[:_SIGNATURE]


class Admission:
    """Admission of frames of one link.

    Args:
        message_filter: filter of frames
        signing: signature check; None: signatures are not checked
    """

    def __init__(self, message_filter: MessageFilter, signing: Signing | None = None) -> None:
        self._filter, self._signing = message_filter, signing

    def admit(self, frames: Frames, refused: Counter[str]) -> Frames:
        """Return the accepted frames, and count the refused ones by reason."""
        if self._signing is not None and len(frames.headers):
            frames = frames.subset(self._signing.verify(frames, refused))
        if self._filter.rules and len(frames.headers):
            passed = self._filter.passes(frames.headers)
            refused[FILTERED] += int((~passed).sum())
            frames = frames.subset(passed)
        return frames

    def sign(self, message: bytes) -> bytes:
        """Return an outgoing message, signed if the link requires it."""
        return message if self._signing is None else self._signing.sign(message)


def make_admissions(specs: Sequence[LinkSpec], stations: int = 0, keys: Path | None = None) -> list[Admission]:
    """Create the admission of each link; the filter of a station's link applies to frames sent there, not received.

    Args:
        specs: the links
        stations: number of links to ground stations, the last ones
        keys: file of keys
    Raises:
        ValueError: when the file of keys is readable by others, or lacks the key of a link.
        OSError: when it cannot be read.
    """
    keys_by_name = read_keys(keys) if keys is not None else {}
    admissions = []
    for number, spec in enumerate(specs):
        signing = None
        if spec.sign:
            key = select_key(keys_by_name, spec.key, spec.text)
            signing = Signing(key, spec.sign == "require", number)
        is_station = number >= len(specs) - stations
        admissions.append(Admission(MessageFilter() if is_station else spec.message_filter, signing))
    return admissions
