"""Bombard everyone on the bus, or ask everyone what no one should ask; as a command, from a process of its own.

python -m tests.bench.security.attack tcp/127.0.0.1:7447 bombard
python -m tests.bench.security.attack tcp/127.0.0.1:7447 history status
"""

import contextlib
import subprocess
import sys
from collections.abc import Callable, Iterator

import zenoh

from fleet.access.entry import BusConfig
from fleet.access.roles import LIVE, MAX_BYTES, ROOT, topic_keys
from fleet.bus.codec import Stamp, encode, encoding, pack_stamp
from fleet.bus.session import _config
from fleet.contract import TOPICS
from tests.support.examples import EXAMPLES

from .bombs import ESCAPES, bombs, questions

UAV = 7
BOMBARD = "bombard"
ATTACHMENTS = (None, b"", b"\xff" * 16, b"\xff" * 60_000, pack_stamp(Stamp(2**64 - 1, 2**64 - 1)))
NAMES = ("", "application/msgpack;parauav.sample.999", ESCAPES.replace("\r\n", ""), "x" * 200)
TOKENS = ("worker", "worker/a/b/c", "worker/0/0-0/0/0/0", f"worker/{'f' * 16}/9-0/1", f"worker/{'9' * 5_000}/0-9/1")
STRANGE = ("*", str(UAV), "18446744073709551616", "²", "1$*")
Attack = Callable[..., int]  # what: BOMBARD, or the topics that are asked; gives how many


def attack(at: str, *what: str, most: int = MAX_BYTES) -> int:
    """Do it from this process, with bombs of at most so many bytes."""
    with raw(at) as session:
        return _bombard(session, most) if what == (BOMBARD,) else _interrogate(session, what)


def from_outside(at: str, *what: str) -> int:
    """Do it from another process, so that what it takes is not counted here."""
    command = [sys.executable, "-m", "tests.bench.security.attack", at, *what]
    return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def raw(at: str) -> zenoh.Session:
    """Open a session that obeys no contract."""
    return zenoh.open(_config(BusConfig(at).session_settings()))


@contextlib.contextmanager
def lying(at: str, kinds: tuple[type, ...]) -> Iterator[None]:
    """Answer every question about some classes with every bomb, for as long as the block lasts."""
    with raw(at) as session:
        for kind in kinds:
            session.declare_queryable(topic_keys(kind.topic), _liar(kind))  # type: ignore[attr-defined]
        yield


def _liar(kind: type) -> Callable[[zenoh.Query], None]:
    said = [payload for _, payload in bombs(EXAMPLES[kind])]
    name = topic_keys(kind.topic).replace("*", str(UAV))  # type: ignore[attr-defined]

    def reply(query: zenoh.Query) -> None:
        with query:
            for payload in said:
                query.reply(name, payload, encoding=encoding(kind))
            query.reply_err(b"\xff" * 1_000 + ESCAPES.encode())

    return reply


def _bombard(session: zenoh.Session, most: int) -> int:
    count = 0
    every = {"congestion_control": zenoh.CongestionControl.BLOCK}
    for kind in TOPICS.values():
        name = topic_keys(kind.topic).replace("*", str(UAV))  # type: ignore[attr-defined]
        for n, (_, payload) in enumerate(bombs(EXAMPLES[kind], most)):
            attachment = ATTACHMENTS[n % len(ATTACHMENTS)]
            session.put(name, payload, encoding=encoding(kind), attachment=attachment, **every)
            count += 1
        for named in NAMES:
            session.put(name, encode(EXAMPLES[kind]), encoding=named, **every)
            count += 1
    tokens = [session.liveliness().declare_token(f"{ROOT}/{LIVE}/{name}") for name in TOKENS]
    return count + len(tokens)


def _interrogate(session: zenoh.Session, topics: tuple[str, ...]) -> int:
    count = 0
    for topic in topics:
        for who in STRANGE if not topic.startswith("@") else ("*",):
            for _, parameters, payload in questions():
                name = topic_keys(topic).replace("*", who) + (f"?{parameters}" if parameters else "")
                list(session.get(name, payload=payload or None, timeout=2.0))
                count += 1
    return count


if __name__ == "__main__":
    print(attack(*sys.argv[1:]))
