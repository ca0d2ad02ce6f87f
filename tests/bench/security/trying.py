"""Try something beside a rightful use of the same thing that must not fail. `Admitted` says what went in."""

import contextlib
import time
from collections.abc import Callable, Iterator
from itertools import count
from queue import Empty, SimpleQueue
from typing import Any

import zenoh

from fleet.access.roles import topic_keys

from .site import PATIENCE_S, Site

ROUNDS = 4  # a forger tries so often beside the rightful one
RIGHT, FORGED = b"right", b"forged"
UNTRIED = "the rightful one did not succeed either, so nothing was tried"
IDS = count(1)  # every attempt has an aircraft of its own
Attempt = Callable[[Site], str]


class Admitted(Exception):
    """What should have been refused was not."""


def fresh(topic: str) -> str:
    """Give a key of a topic that no other attempt uses."""
    return topic_keys(topic).replace("*", str(next(IDS)))


def only_heard(reader: zenoh.Session, name: str, right: Callable[[], None], forge: Callable[[], None]) -> str:
    """Let both publish until the rightful one was heard often enough; give words when it alone was heard."""
    heard: SimpleQueue[bytes] = SimpleQueue()

    def hear(sample: zenoh.Sample) -> None:
        heard.put(sample.payload.to_bytes() if sample.kind == zenoh.SampleKind.PUT else FORGED)

    watch = reader.declare_subscriber(name, hear)
    found: list[bytes] = []

    def tell() -> bool:
        forge()
        right()
        found.extend(drained(heard, 0.05))
        return sum(one.startswith(RIGHT) for one in found) >= ROUNDS

    spoken = until(tell)
    found += drained(heard, 0.2)
    watch.undeclare()
    return _judged(found, spoken)


def only_asked(holder: zenoh.Session, name: str, right: Callable[[], Any], forge: Callable[[], Any]) -> str:
    """Let both ask who holds it, until the rightful one was answered often enough."""
    asked: SimpleQueue[bytes] = SimpleQueue()

    def reply(query: zenoh.Query) -> None:
        with query:
            asked.put(query.payload.to_bytes() if query.payload else b"")
            query.reply(name, b"there")

    queryable = holder.declare_queryable(name, reply)
    found: list[bytes] = []

    def ask() -> bool:
        list(forge())
        list(right())
        found.extend(drained(asked, 0.05))
        return found.count(RIGHT) >= ROUNDS

    spoken = until(ask)
    queryable.undeclare()
    return _judged(found, spoken)


def _judged(found: list[bytes], spoken: bool) -> str:
    if any(one.startswith(FORGED) for one in found):
        raise Admitted("it arrived")
    if not spoken:
        raise Admitted(UNTRIED)
    return f"{len(found)} arrived, all rightful"


def drained(queue: SimpleQueue[Any], wait_s: float) -> Iterator[Any]:
    """Give what comes until nothing comes for a while."""
    with contextlib.suppress(Empty):
        while True:
            yield queue.get(timeout=wait_s)


def until(true: Callable[[], bool]) -> bool:
    """Tell whether something becomes true before patience ends."""
    end = time.monotonic() + PATIENCE_S
    while not (done := true()) and time.monotonic() < end:
        pass
    return done
