"""The bus within one process, for tests and for what needs no router."""

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
    """The bus within one process, synchronous; every message still goes through its bytes."""

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
        """Send one message to whoever listens."""
        self.deliver(type(message), encode(message), encoding(type(message)), stamp)

    def put(self, wire: Wire, stamp: Stamp | None = None) -> None:
        """Send one message that is packed already."""
        self.deliver(wire.kind, wire.payload, encoding(wire.kind), stamp)

    def deliver(self, kind: type, payload: bytes, named: str, stamp: Stamp | None = None) -> None:
        """Hand bytes to the listeners as if they had come over a wire; count what does not decode."""
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
        """Call `heard(message, stamp)` for every message of a class, or those it wants."""
        if wants is not None:
            heard = partial(_wanted, heard, wants)
        self._heard.setdefault(kind, []).append(heard)

    def overhear(self, kind: type, heard: Overheard) -> None:
        """Call `heard(payload, encoding, stamp)` for every message of a class, as it came."""
        self._overheard.setdefault(kind, []).append(heard)

    def collect(self, kind: type, heard: Collected) -> None:
        """Call `heard` with every message of a class, at once."""
        self.overhear(kind, lambda payload, *rest: heard([(_whose(payload), payload, *rest)]))

    def hand_out(self, newest: Container[type] = ()) -> None:
        """Do nothing: nothing waits here."""

    def answer(self, kind: type, reply: Answer) -> None:
        """Declare one wildcard queryable for a class."""
        self._reply.setdefault(kind, []).append(reply)

    def ask(self, kind: type[M], who: int | str = "*", timeout_s: float = 1.0) -> list[tuple[M, Stamp | None]]:
        """Ask everyone for a class; the highest epoch per aircraft is kept."""
        uav = who if isinstance(who, int) else None
        found: list[tuple[M, Stamp | None]] = []
        for reply in self._reply.get(kind, []):
            try:
                answers = list(asked_for(uav, reply(uav, {}, b"")))
            except ValueError:
                continue  # a refusal; on Zenoh it travels as an error reply, which `ask` leaves out
            found += [(decode(kind, encode(message), encoding(kind)), stamp) for message, stamp in answers]
        return newest(found)

    def inquire(self, kind: type[M], who: int, payload: bytes, timeout_s: float = 5.0) -> tuple[M, Stamp | None] | None:
        """Ask about one aircraft with a payload; a refusal is raised as it is."""
        answers = [pair for reply in self._reply.get(kind, []) for pair in asked_for(who, reply(who, {}, payload))]
        found = newest([(decode(kind, encode(message), encoding(kind)), stamp) for message, stamp in answers])
        return found[0] if found else None

    def gather(self, kind: type[M], who: int | str, payload: bytes, timeout_s: float) -> Iterator[M]:
        """Ask with a payload and return every answer as it comes."""
        uav = who if isinstance(who, int) else None
        for reply in self._reply.get(kind, []):
            with suppress(ValueError):
                for message, _ in reply(uav, {}, payload):
                    yield decode(kind, encode(message), encoding(kind))

    def fetch(self, kind: type, who: int | str, timeout_s: float) -> Iterator[bytes]:
        """Ask and return the bytes of every answer as it comes."""
        return map(encode, self.gather(kind, who, b"", timeout_s))

    def present(self, name: str) -> None:
        """Say that this process lives."""
        self._present.append(name)
        for told in self._attends:
            told(name, True)

    def attend(self, told: Token) -> None:
        """Call `told(name, lives)` for every process that is present or comes."""
        self._attends.append(told)
        self.recount(told)

    def recount(self, told: Token) -> None:
        """Call `told(name, True)` for every process that is present now."""
        for name in self._present:
            told(name, True)

    def close(self) -> None:
        """Forget everyone."""
        self._heard.clear()
        self._overheard.clear()
        self._reply.clear()

    def __exit__(self, *_: object) -> None:
        self.close()


class _Whose(msgspec.Struct):
    """Of a message only whose it is."""

    uav: int | None = None


def _whose(payload: bytes) -> int | None:
    """Read the UAV that on a wire the key would name; None where there is none."""
    try:
        return msgspec.msgpack.decode(payload, type=_Whose).uav
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


def _wanted(heard: Heard, wants: Wants, message: Any, stamp: Stamp | None) -> None:
    if wants(message.uav):
        heard(message, stamp)
