"""Encode and decode messages: msgpack maps, a version in the encoding, an attachment of epoch and writer."""

import hashlib
import math
import struct
import time
from typing import Any, NamedTuple, TypeVar

import msgspec

from fleet.access.roles import TOPIC_RULES
from fleet.contract import PER_UAV, TOPICS, Change, Option

M = TypeVar("M")
MAX_EPOCH_AHEAD_MS = 300_000  # an epoch further ahead of the local clock is forged or of a wrong clock
_STAMP = struct.Struct("<QQ")
_PACK = msgspec.msgpack.Encoder()
_CHANGES = msgspec.msgpack.Decoder(tuple[Change, ...])
_UNPACK: dict[str, Any] = {topic: msgspec.msgpack.Decoder(kind) for topic, kind in TOPICS.items()}

_ENCODINGS = {
    kind: f"application/msgpack;parauav.{topic.lstrip('@').replace('/', '.')}.{kind.version}"  # type: ignore[attr-defined]
    for topic, kind in TOPICS.items()
}


class Stamp(NamedTuple):
    """Writer of a worker result and the epoch of its claim; the highest plausible epoch per UAV wins."""

    epoch: int
    writer: int


def is_plausible_epoch(epoch: int, wall_s: float | None = None) -> bool:
    """Return whether an epoch is plausible: a time [ms since 1970], at most 5 minutes ahead of the reader's clock.

    Args:
        epoch: of a claim
        wall_s: the reader's clock; None: now [s since 1970]
    """
    return 0 <= epoch <= (time.time() if wall_s is None else wall_s) * 1e3 + MAX_EPOCH_AHEAD_MS


class EncodedMessage(NamedTuple):
    """An encoded message."""

    kind: type  # from `fleet.contract`
    uav: int
    payload: bytes
    t: float = math.nan  # time of the message, where known [s since 1970]

    def message(self) -> Any:
        """Decode it."""
        return decode(self.kind, self.payload)


def encode(message: Any) -> bytes:
    """Encode one message as a msgpack map; return the payload of an encoded message unchanged."""
    return message.payload if isinstance(message, EncodedMessage) else _PACK.encode(message)


def digest_of(option: Option) -> str:
    """Return the SHA-256 of the changes of an option, 64 hex digits: what an approval is for, without its forecast.

    It is of the changes as received from the bus, where every number of a float field is a float.
    """
    received = _CHANGES.decode(_PACK.encode(option.changes))
    return hashlib.sha256(_PACK.encode(received)).hexdigest()


def encoding(kind: type) -> str:
    """Return the Zenoh encoding of a message class, e.g. `application/msgpack;parauav.sample.1`."""
    return _ENCODINGS[kind]


def decode(kind: type[M], payload: bytes, encoding_name: str = "") -> M:
    """Decode one message of class `kind`.

    Args:
        kind: class from `fleet.contract`
        payload: msgpack bytes
        encoding_name: received Zenoh encoding; empty skips the version check
    Raises:
        ValueError: when the version differs, or the payload is too large or invalid; upgrade the older side.
    """
    expected = encoding(kind)
    if encoding_name and encoding_name != expected:
        raise ValueError(
            f"{kind.__name__}: found encoding {_shorten(repr(encoding_name))}, expected {expected!r}; "
            "upgrade the older side"
        )
    if len(payload) > (max_bytes := TOPIC_RULES[kind.topic].max_bytes):  # type: ignore[attr-defined]
        raise ValueError(f"{kind.__name__}: found {len(payload):,} bytes, expected at most {max_bytes:,}; send less")
    try:
        return _UNPACK[kind.topic].decode(payload)  # type: ignore[attr-defined]
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        problem = f"{len(payload)} bytes that do not fit ({_shorten(str(error))})"
        raise ValueError(f"{kind.__name__}: found {problem}; resend") from None


def decode_for_key(kind: type[M], uav: int | None, payload: bytes, encoding_name: str = "") -> M:
    """Decode one message received under the key of a UAV, as `decode`.

    Raises:
        ValueError: as `decode`, and when the message is of another UAV: permission for one key covers no other.
    """
    message: Any = decode(kind, payload, encoding_name)
    if kind in PER_UAV and message.uav != uav:
        raise ValueError(f"{kind.__name__}: found one of uav {message.uav} under the key of {uav}, expected its own")
    return message  # type: ignore[no-any-return]


def _shorten(text: str) -> str:
    """Shorten untrusted text of any length by omitting its middle."""
    return text if len(text) <= 200 else f"{text[:80]} … {text[-80:]}"


def pack_stamp(stamp: Stamp) -> bytes:
    """Pack the attachment: epoch u64, writer u64, little endian."""
    return _STAMP.pack(*stamp)


def unpack_stamp(attachment: bytes | None) -> Stamp | None:
    """Unpack the attachment; None where it is missing or not 16 bytes."""
    if attachment is None or len(attachment) != _STAMP.size:
        return None
    return Stamp._make(_STAMP.unpack(attachment))
