"""Bus within one process, without a router: the methods of `fleet.bus.session.Bus`."""

import secrets
from collections.abc import Callable, Collection, Container, Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from functools import partial
from typing import Any, TypeVar

import msgspec

from fleet.bus.bus_protocol import QueryHandler, replies_about, select_latest
from fleet.bus.codec import EncodedMessage, Stamp, decode, encode, encoding
from fleet.bus.session import BatchCallback, Callback, LivelinessCallback, RawCallback

M = TypeVar("M")


class MemoryBus(AbstractContextManager):
    """Synchronous bus within one process; every message is encoded and decoded."""

    router = "this process"

    def __init__(self) -> None:
        self.writer = secrets.randbits(63)
        self._callbacks: dict[type, list[Callback]] = {}
        self._raw_callbacks: dict[type, list[RawCallback]] = {}
        self._query_handlers: dict[type, list[QueryHandler]] = {}
        self._tokens: list[str] = []
        self._token_callbacks: list[LivelinessCallback] = []
        self.bad = 0

    def publish(self, message: Any, stamp: Stamp | None = None) -> None:
        """Publish one message."""
        self.deliver(type(message), encode(message), encoding(type(message)), stamp)

    def put_all(self, messages: Sequence[EncodedMessage], stamp: Stamp | None = None) -> None:
        """Publish encoded messages; no batches are made."""
        for message in messages:
            self.deliver(message.kind, message.payload, encoding(message.kind), stamp)

    def remove_publishers(self, uavs: Collection[int]) -> None:
        """Do nothing: this bus keeps nothing per key."""

    def deliver(self, kind: type, payload: bytes, encoding_name: str, stamp: Stamp | None = None) -> None:
        """Pass a payload to the subscribers as if received; count payloads that do not decode."""
        for raw_callback in self._raw_callbacks.get(kind, []):
            raw_callback(payload, encoding_name, stamp)
        for callback in self._callbacks.get(kind, []):
            try:
                message: Any = decode(kind, payload, encoding_name)
            except ValueError:
                self.bad += 1
                continue
            callback(message, stamp)

    def subscribe(self, kind: type, callback: Callback, accepts: Callable[[int], bool] | None = None) -> None:
        """Call `callback(message, stamp)` for every message of a class that `accepts` admits."""
        if accepts is not None:
            callback = partial(_call_if_accepted, callback, accepts)
        self._callbacks.setdefault(kind, []).append(callback)

    def subscribe_raw(self, kind: type, callback: RawCallback) -> None:
        """Call `callback(payload, encoding, stamp)` for every message of a class, undecoded."""
        self._raw_callbacks.setdefault(kind, []).append(callback)

    def subscribe_buffered(self, kind: type, callback: BatchCallback) -> None:
        """Call `callback` with every message of a class immediately."""
        self.subscribe_raw(kind, lambda payload, *rest: callback([(_uav_of_payload(payload), payload, *rest)]))

    def dispatch(self, latest_only: Container[type] = ()) -> None:
        """Do nothing: this bus has no buffer."""

    def declare_queryable(self, kind: type, handler: QueryHandler) -> None:
        """Declare one wildcard queryable for a class."""
        self._query_handlers.setdefault(kind, []).append(handler)

    def get(self, kind: type[M], target: int | str = "*", timeout_s: float = 1.0) -> list[tuple[M, Stamp | None]]:
        """Query all handlers of a class; return the reply of highest epoch per aircraft."""
        uav = target if isinstance(target, int) else None
        pairs: list[tuple[M, Stamp | None]] = []
        for handler in self._query_handlers.get(kind, []):
            try:
                replies = list(replies_about(uav, handler(uav, {}, b"")))
            except ValueError:
                continue  # on Zenoh this is an error reply, which `get` omits
            pairs += [(decode(kind, encode(message), encoding(kind)), stamp) for message, stamp in replies]
        return select_latest(pairs)

    def get_one(
        self, kind: type[M], target: int, payload: bytes, timeout_s: float = 5.0
    ) -> tuple[M, Stamp | None] | None:
        """Query one aircraft with a payload; errors of the handler propagate."""
        replies = [
            pair
            for handler in self._query_handlers.get(kind, [])
            for pair in replies_about(target, handler(target, {}, payload))
        ]
        pairs = select_latest([(decode(kind, encode(message), encoding(kind)), stamp) for message, stamp in replies])
        return pairs[0] if pairs else None

    def get_stream(self, kind: type[M], target: int | str, payload: bytes, timeout_s: float) -> Iterator[M]:
        """Query with a payload and yield every reply."""
        uav = target if isinstance(target, int) else None
        for handler in self._query_handlers.get(kind, []):
            with suppress(ValueError):
                for message, _ in handler(uav, {}, payload):
                    yield decode(kind, encode(message), encoding(kind))

    def get_payloads(self, kind: type, target: int | str, timeout_s: float) -> Iterator[bytes]:
        """Query and yield the payload of every reply."""
        return map(encode, self.get_stream(kind, target, b"", timeout_s))

    def declare_liveliness(self, name: str) -> None:
        """Declare a liveliness token."""
        self._tokens.append(name)
        for callback in self._token_callbacks:
            callback(name, True)

    def watch_liveliness(self, callback: LivelinessCallback) -> None:
        """Call `callback(name, alive)` for every current and later liveliness token."""
        self._token_callbacks.append(callback)
        self.list_liveliness(callback)

    def list_liveliness(self, callback: LivelinessCallback) -> None:
        """Call `callback(name, True)` for every current liveliness token."""
        for name in self._tokens:
            callback(name, True)

    def close(self) -> None:
        """Remove all subscribers and query handlers."""
        self._callbacks.clear()
        self._raw_callbacks.clear()
        self._query_handlers.clear()

    def __exit__(self, *_: object) -> None:
        self.close()


class _MessageUav(msgspec.Struct):
    """The UAV id of a message, without its other fields."""

    uav: int | None = None


def _uav_of_payload(payload: bytes) -> int | None:
    """Read the UAV id from a payload (on Zenoh it is part of the key); None where there is none."""
    try:
        return msgspec.msgpack.decode(payload, type=_MessageUav).uav
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


def _call_if_accepted(callback: Callback, accepts: Callable[[int], bool], message: Any, stamp: Stamp | None) -> None:
    if accepts(message.uav):
        callback(message, stamp)
