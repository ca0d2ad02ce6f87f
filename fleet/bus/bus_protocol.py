"""What a bus is: its keys, what can be done on it, and which of two answers is believed."""

from collections.abc import Callable, Container, Iterable, Iterator
from contextlib import AbstractContextManager
from functools import lru_cache
from typing import Any, Protocol, TypeVar

from fleet.access.roles import ROOT
from fleet.bus.codec import Stamp, Wire, timely
from fleet.contract import PER_UAV

M = TypeVar("M")
Heard = Callable[[Any, Stamp | None], None]
Overheard = Callable[[bytes, str, Stamp | None], None]
Letter = tuple[int | None, bytes, str, Stamp | None]
"""The UAV its key names, the payload, its encoding and its claim."""
Collected = Callable[[list[Letter]], None]
Answers = Iterable[tuple[Any, Stamp | None]]
Answer = Callable[[int | None, dict[str, str], bytes], Answers]
Token = Callable[[str, bool], None]
Wants = Callable[[int], bool]


def key(kind: type, who: int | str) -> str:
    """Return the key of one message class: `parauav/7/sample`, `parauav/@fleet/state/{writer}`; who may be `*`."""
    topic: str = kind.topic  # type: ignore[attr-defined]
    return f"{ROOT}/{who}/{topic}" if kind in PER_UAV else f"{ROOT}/{topic}/{who}"


@lru_cache(maxsize=16_384)
def uav_in(name: str) -> int | None:
    """Read the UAV id out of a key; None where the chunk is a wildcard or no number."""
    chunk = name.split("/")[1] if name.count("/") >= 2 else ""
    return int(chunk) if chunk.isdecimal() and len(chunk) <= 9 else None


class Bus(AbstractContextManager, Protocol):
    """What every process talks through."""

    writer: int  # random id of this process on the bus
    bad: int  # messages heard that do not fit the contract

    def publish(self, message: Any, stamp: Stamp | None = None) -> None:
        """Send one message to whoever listens."""

    def put(self, wire: Wire, stamp: Stamp | None = None) -> None:
        """Send one message that is packed already."""

    @property
    def router(self) -> str:
        """Name who is there to pass on what is published; empty: nobody, and it is looked for again and again."""

    def subscribe(self, kind: type, heard: Heard, wants: Wants | None = None) -> None:
        """Call `heard(message, stamp)` for every message of a class; undecodable ones are counted, not raised.

        Args:
            kind: of the contract
            heard: called on a thread of the bus
            wants: tells by UAV id which messages are worth decoding; None: all
        """

    def overhear(self, kind: type, heard: Overheard) -> None:
        """Call `heard(payload, encoding, stamp)` for every message of a class, as it came and whatever is in it."""

    def collect(self, kind: type, heard: Collected) -> None:
        """Put every message of a class aside until `hand_out`: it costs no thread and no turn of one.

        Args:
            kind: of the contract
            heard: called with all of them in the order they came, whatever is in them
        """

    def hand_out(self, newest: Container[type] = ()) -> None:
        """Give out what was put aside, on this thread; call it often, for only so much is kept: the newest.

        Args:
            newest: classes of which the newest message of each sender is enough: those it replaces are not unpacked
        """

    def answer(self, kind: type, reply: Answer) -> None:
        """Declare one wildcard queryable for a class: `reply(uav or None, parameters, payload)`."""

    def ask(self, kind: type[M], who: int | str = "*", timeout_s: float = 1.0) -> list[tuple[M, Stamp | None]]:
        """Ask everyone for a class, for at most `timeout_s` [s]; the highest epoch per aircraft is kept.

        Raises:
            ConnectionError: when the session is closed; join the router again.
        """

    def inquire(self, kind: type[M], who: int, payload: bytes, timeout_s: float = 5.0) -> tuple[M, Stamp | None] | None:
        """Ask about one aircraft with a payload; None where nobody answers.

        Raises:
            ValueError: when every answer is a refusal; in the words of the one who refused.
            ConnectionError: when the session is closed; join the router again.
        """

    def gather(self, kind: type[M], who: int | str, payload: bytes, timeout_s: float) -> Iterator[M]:
        """Ask with a payload and return every answer as it comes, for at most `timeout_s` [s]; refusals are left out.

        Raises:
            ConnectionError: when the session is closed; join the router again.
        """

    def fetch(self, kind: type, who: int | str, timeout_s: float) -> Iterator[bytes]:
        """Ask and give the bytes of every answer as it comes, for at most `timeout_s` [s]; other versions are left out.

        Raises:
            ConnectionError: when the session is closed; join the router again.
        """

    def present(self, name: str) -> None:
        """Say that this process lives, until it does not: a liveliness token at `parauav/@live/{name}`."""

    def attend(self, told: Token) -> None:
        """Call `told(name, lives)` for every process that is present, comes or goes; those there now at once."""

    def recount(self, told: Token) -> None:
        """Call `told(name, True)` for every process that is present now."""

    def close(self) -> None:
        """Leave the bus."""


def newest(found: list[tuple[M, Stamp | None]]) -> list[tuple[M, Stamp | None]]:
    """Keep the reply with the highest timely claim, then the newest, per UAV (and alert); without a UAV all stay."""
    best: dict[tuple[int, str], tuple[M, Stamp | None]] = {}
    rest = []
    for message, stamp in found:
        uav = getattr(message, "uav", None)
        if uav is None:
            rest.append((message, stamp))
            continue
        if stamp is not None and not timely(stamp.epoch):
            continue
        what = uav, str(getattr(message, "about", ""))
        held = best.get(what)
        if held is None or _rank(message, stamp) > _rank(*held):
            best[what] = (message, stamp)
    return [best[what] for what in sorted(best)] + rest


def _rank(message: Any, stamp: Stamp | None) -> tuple[Stamp, float]:
    return stamp or Stamp(0, 0), message.t


def asked_for(uav: int | None, answers: Answers) -> Answers:
    """Keep the answers about the aircraft asked for, each as soon as it is there; None keeps all."""
    return ((m, stamp) for m, stamp in answers if uav is None or getattr(m, "uav", uav) == uav)
