"""Serialise the complete twin of one aircraft for a handover, so that its new owner continues without a gap.

msgspec encodes and checks everything by the annotations of the state; hooks convert the types that it does not know.
Untrusted bytes give a snapshot of these types or a `ValueError`.
"""

import threading
from collections import deque
from dataclasses import dataclass, field
from typing import Any, get_args, get_origin

import msgspec
import numpy as np
from scipy.interpolate import CubicSpline

from fleet.contract import TOPICS, Message, Mismatch
from twin_worker.alerts.hysteresis import AlertState
from twin_worker.confidence.table_files import TableSet
from twin_worker.confidence.table_files import load as load_tables
from twin_worker.telemetry.history import RowBuffer
from twin_worker.twin.state.state import Twin


@dataclass
class Snapshot:
    """Data of one aircraft in a handover.

    Attributes:
        twin: complete state of the twin
        inbox: queued messages, oldest first
        traffic_alerts: its open traffic alerts
        mismatch: newest mismatch; None: none
    """

    twin: Twin
    inbox: list[Message] = field(default_factory=list)
    traffic_alerts: AlertState = field(default_factory=AlertState)
    mismatch: Mismatch | None = None


_Encoded = tuple[Twin, list[tuple[str, msgspec.Raw]], AlertState, Mismatch | None]  # queued messages with their topics
# msgspec prepares a class at its first use, and crashes if a second thread decodes one meanwhile. The decoder prepares
# most classes, at import; the hooks prepare the items of deques.
_decoding = threading.Lock()


def encode_snapshot(snapshot: Snapshot) -> bytes:
    """Encode a snapshot.

    Raises:
        TypeError: when a part of the state has a type that neither msgspec nor a hook encodes.
    """
    encode = msgspec.msgpack.Encoder(enc_hook=_to_parts).encode
    inbox = [(message.topic, msgspec.Raw(encode(message))) for message in snapshot.inbox]
    twin = msgspec.structs.replace(snapshot.twin, budget=None, terrain=None)  # the new owner has its own
    return encode((twin, inbox, snapshot.traffic_alerts, snapshot.mismatch))


def decode_snapshot(data: bytes, uav: int) -> Snapshot:
    """Decode a snapshot.

    Raises:
        ValueError: when the bytes are not a twin of this aircraft; start it from published data instead.
    """
    try:
        with _decoding:
            twin, queued, *rest = _DECODER.decode(data)
        inbox: list[Message] = [msgspec.msgpack.decode(message, type=TOPICS[topic]) for topic, message in queued]
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise ValueError(
            f"uav-{uav}: found {len(data)} invalid bytes ({error}), expected its twin; it starts without a snapshot"
        ) from None
    if twin.config.uav != uav:
        raise ValueError(
            f"uav-{uav}: found the twin of uav-{twin.config.uav}, expected its own; it starts without a snapshot"
        )
    if not twin.telemetry.history.is_consistent():
        raise ValueError(f"uav-{uav}: found other telemetry columns, expected ours; it starts without a snapshot")
    return Snapshot(twin, inbox, *rest)


def _to_parts(value: Any) -> Any:
    """Return the parts of a value that msgspec encodes."""
    if isinstance(value, np.ndarray):
        data = value.tolist() if value.dtype == object else value.tobytes()
        return value.dtype.str, value.shape, data
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, deque):
        return value.maxlen, list(value)
    if isinstance(value, RowBuffer):
        return value.rows()
    if isinstance(value, CubicSpline):
        return value.x, value.c
    if isinstance(value, TableSet):  # installed with every worker
        return None
    raise TypeError(f"{type(value).__module__}.{type(value).__qualname__}: no hook encodes it; add one")


def _from_parts(kind: Any, parts: Any) -> Any:
    """Return a value of an annotated type from its parts.

    Raises:
        ValueError, TypeError: when the parts do not make one.
    """
    if kind is np.ndarray:
        return _array(parts)
    if get_origin(kind) is deque:
        item_type = get_args(kind)[0]
        maxlen, items = msgspec.convert(parts, tuple[int | None, list[item_type]], dec_hook=_from_parts)  # type: ignore[valid-type]
        return deque(items, maxlen)
    if kind is TableSet:
        return load_tables()
    first, second = msgspec.convert(parts, tuple[np.ndarray, np.ndarray], dec_hook=_from_parts)
    if {first.dtype, second.dtype} != {np.dtype(float)} or first.ndim != 1:
        raise ValueError(f"{first.dtype} {first.shape} and {second.dtype} {second.shape}")
    if kind is RowBuffer and second.ndim == 2 and len(first) == len(second):
        return RowBuffer(first, second)
    if kind is CubicSpline and second.ndim == 3 and second.shape[:2] == (4, len(first) - 1):
        return CubicSpline.construct_fast(second, first, extrapolate=True, axis=0)
    raise ValueError(f"{kind} of {first.shape} and {second.shape}")


def _array(parts: Any) -> np.ndarray:
    """Return a writable array of numbers, or of text; without msgspec, because a twin has hundreds of them.

    Raises:
        ValueError, TypeError: when the parts are not type, shape and data.
    """
    dtype, shape, data = parts
    if type(dtype) is not str or type(shape) is not list or not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError(f"an array of {dtype!r} {shape}")
    if type(data) is list:
        return np.array(msgspec.convert(data, list[str]), object).reshape(shape)
    if type(data) is not bytes or np.dtype(dtype).kind not in "biuf":
        raise ValueError(f"an array of {dtype!r} of {type(data).__name__}")
    return np.frombuffer(data, dtype).reshape(shape).copy()


_DECODER = msgspec.msgpack.Decoder(_Encoded, dec_hook=_from_parts)
