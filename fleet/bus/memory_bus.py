"""In-memory bus within one process, for tests and for uses without a router."""

import secrets
from collections.abc import Container, Iterator
from contextlib import AbstractContextManager, suppress
from functools import partial
from typing import Any, TypeVar

import msgspec

from fleet.bus.bus_protocol import Answer, Collected, Heard, Overheard, Token, Wants, asked_for, newest
from fleet.bus.codec import Stamp, Wire, decode, encode, encoding

M = TypeVar("M")


class MemoryBus(AbstractContextManager):
    """Synchronous bus within one process; every message is encoded and decoded."""

    router = "this process"

    def __init__(self) -> None:
        self.writer = secrets.randbits(63)
        self._heard: dict[type, list[Heard]] = {}
        self._overheard: dict[type, list[Overheard]] = {}
        self._reply: dict[type, list[Answer]] = {}
        self._present: list[str] = []
        self._attends: list[Token] = []
        self.bad = 0

    def publish(self, message: Any, stamp: Stamp | None = None) -> None:
        """Publish one message."""
        self.deliver(type(message), encode(message), encoding(type(message)), stamp)

    def put(self, wire: Wire, stamp: Stamp | None = None) -> None:
        """Publish one encoded message."""
        self.deliver(wire.kind, wire.payload, encoding(wire.kind), stamp)

    def deliver(self, kind: type, payload: bytes, named: str, stamp: Stamp | None = None) -> None:
        """Pass a payload to the subscribers as if received; count payloads that do not decode."""
        for overheard in self._overheard.get(kind, []):
            overheard(payload, named, stamp)
        for heard in self._heard.get(kind, []):
            try:
                message: Any = decode(kind, payload, named)
            except ValueError:
                self.bad += 1
                continue
            heard(message, stamp)

    def subscribe(self, kind: type, heard: Heard, wants: Wants | None = None) -> None:
        """Call `callback(message, stamp)` for every message of a class that `accepts` admits."""
        if wants is not None:
            heard = partial(_wanted, heard, wants)
        self._heard.setdefault(kind, []).append(heard)

    def overhear(self, kind: type, heard: Overheard) -> None:
        """Call `callback(payload, encoding, stamp)` for every message of a class, undecoded."""
        self._overheard.setdefault(kind, []).append(heard)

    def collect(self, kind: type, heard: Collected) -> None:
        """Call `callback` with every message of a class immediately."""
        self.overhear(kind, lambda payload, *rest: heard([(_whose(payload), payload, *rest)]))

    def hand_out(self, newest: Container[type] = ()) -> None:
        """Do nothing: this bus has no buffer."""

    def answer(self, kind: type, reply: Answer) -> None:
        """Declare one wildcard queryable for a class."""
        self._reply.setdefault(kind, []).append(reply)

    def ask(self, kind: type[M], who: int | str = "*", timeout_s: float = 1.0) -> list[tuple[M, Stamp | None]]:
        """Query all handlers of a class; return the reply of highest epoch per aircraft."""
        uav = who if isinstance(who, int) else None
        found: list[tuple[M, Stamp | None]] = []
        for reply in self._reply.get(kind, []):
            try:
                answers = list(asked_for(uav, reply(uav, {}, b"")))
            except ValueError:
                continue  # on Zenoh this is an error reply, which `get` omits
            found += [(decode(kind, encode(message), encoding(kind)), stamp) for message, stamp in answers]
        return newest(found)

    def inquire(self, kind: type[M], who: int, payload: bytes, timeout_s: float = 5.0) -> tuple[M, Stamp | None] | None:
        """Query one aircraft with a payload; errors of the handler propagate."""
        answers = [pair for reply in self._reply.get(kind, []) for pair in asked_for(who, reply(who, {}, payload))]
        found = newest([(decode(kind, encode(message), encoding(kind)), stamp) for message, stamp in answers])
        return found[0] if found else None

    def gather(self, kind: type[M], who: int | str, payload: bytes, timeout_s: float) -> Iterator[M]:
        """Query with a payload and yield every reply."""
        uav = who if isinstance(who, int) else None
        for reply in self._reply.get(kind, []):
            with suppress(ValueError):
                for message, _ in reply(uav, {}, payload):
                    yield decode(kind, encode(message), encoding(kind))

    def fetch(self, kind: type, who: int | str, timeout_s: float) -> Iterator[bytes]:
        """Query and yield the payload of every reply."""
        return map(encode, self.gather(kind, who, b"", timeout_s))

    def present(self, name: str) -> None:
        """Declare a liveliness token."""
        self._present.append(name)
        for told in self._attends:
            told(name, True)

    def attend(self, told: Token) -> None:
        """Call `callback(name, alive)` for every current and later liveliness token."""
        self._attends.append(told)
        self.recount(told)

    def recount(self, told: Token) -> None:
        """Call `callback(name, True)` for every current liveliness token."""
        for name in self._present:
            told(name, True)

    def close(self) -> None:
        """Remove all subscribers and query handlers."""
        self._heard.clear()
        self._overheard.clear()
        self._reply.clear()

    def __exit__(self, *_: object) -> None:
        self.close()


class _Whose(msgspec.Struct):
    """The UAV id of a message, without its other fields."""

    uav: int | None = None


def _whose(payload: bytes) -> int | None:
    """Read the UAV id from a payload (on Zenoh it is part of the key); None where there is none."""
    try:
        return msgspec.msgpack.decode(payload, type=_Whose).uav
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


def _wanted(heard: Heard, wants: Wants, message: Any, stamp: Stamp | None) -> None:
    if wants(message.uav):
        heard(message, stamp)
