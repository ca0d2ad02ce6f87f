"""Publish, subscribe, ask and answer: on Zenoh, and in memory for tests. The only file that imports zenoh."""

import json
import secrets
import socket
import threading
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from typing import Any, Protocol, TypeVar

import zenoh

from fleet.codec import Stamp, Wire, decode, encode, encoding, pack_stamp, unpack_stamp
from fleet.contract import PER_UAV

M = TypeVar("M")
Heard = Callable[[Any, Stamp | None], None]
Overheard = Callable[[bytes, str, Stamp | None], None]
Answers = Iterable[tuple[Any, Stamp | None]]
Answer = Callable[[int | None, dict[str, str], bytes], Answers]

ROOT = "parauav"
ROUTER = "tcp/127.0.0.1:7447"


def key(kind: type, who: int | str) -> str:
    """Give the key of one message class: `parauav/7/sample`, `parauav/@fleet/state/{writer}`; who may be `*`."""
    topic: str = kind.topic  # type: ignore[attr-defined]
    return f"{ROOT}/{who}/{topic}" if kind in PER_UAV else f"{ROOT}/{topic}/{who}"


def uav_in(name: str) -> int | None:
    """Read the UAV id out of a key; None where the chunk is a wildcard or no number."""
    chunk = name.split("/")[1] if name.count("/") >= 2 else ""
    return int(chunk) if chunk.isdecimal() and len(chunk) <= 9 else None


class Bus(AbstractContextManager, Protocol):
    """What every process talks through."""

    writer: int  # random id of this process on the bus

    @property
    def router(self) -> str:
        """Name who is there to pass on what is published; empty: nobody, and it is looked for again and again."""

    def publish(self, message: Any, stamp: Stamp | None = None) -> None:
        """Send one message to whoever listens."""

    def put(self, wire: Wire, stamp: Stamp | None = None) -> None:
        """Send one message that is packed already."""

    def subscribe(self, kind: type, heard: Heard) -> None:
        """Call `heard(message, stamp)` for every message of a class; undecodable ones are counted, not raised."""

    def overhear(self, kind: type, heard: Overheard) -> None:
        """Call `heard(payload, encoding, stamp)` for every message of a class, as it came and whatever is in it."""

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

    def present(self, name: str) -> None:
        """Say that this process lives, until it does not: a liveliness token at `parauav/@live/{name}`."""

    def close(self) -> None:
        """Leave the bus."""


def newest(found: list[tuple[M, Stamp | None]]) -> list[tuple[M, Stamp | None]]:
    """Keep the reply with the highest epoch, then the newest, per UAV (and alert); without a UAV all stay."""
    best: dict[tuple[int, str], tuple[M, Stamp | None]] = {}
    rest = []
    for message, stamp in found:
        uav = getattr(message, "uav", None)
        if uav is None:
            rest.append((message, stamp))
            continue
        what = uav, str(getattr(message, "about", ""))
        rank = (stamp.epoch if stamp else 0, message.t)  # type: ignore[attr-defined]
        held = best.get(what)
        if held is None or rank > (held[1].epoch if held[1] else 0, held[0].t):  # type: ignore[attr-defined]
            best[what] = (message, stamp)
    return [best[what] for what in sorted(best)] + rest


def asked_for(uav: int | None, answers: Answers) -> list[tuple[Any, Stamp | None]]:
    """Keep the answers about the aircraft asked for; None keeps all."""
    return [(m, stamp) for m, stamp in answers if uav is None or getattr(m, "uav", uav) == uav]


class MemoryBus(AbstractContextManager):
    """The bus within one process, synchronous; every message still goes through its bytes."""

    router = "this process"

    def __init__(self) -> None:
        self.writer = secrets.randbits(63)
        self._heard: dict[type, list[Heard]] = {}
        self._overheard: dict[type, list[Overheard]] = {}
        self._reply: dict[type, list[Answer]] = {}
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

    def subscribe(self, kind: type, heard: Heard) -> None:
        """Call `heard(message, stamp)` for every message of a class."""
        self._heard.setdefault(kind, []).append(heard)

    def overhear(self, kind: type, heard: Overheard) -> None:
        """Call `heard(payload, encoding, stamp)` for every message of a class, as it came."""
        self._overheard.setdefault(kind, []).append(heard)

    def answer(self, kind: type, reply: Answer) -> None:
        """Declare one wildcard queryable for a class."""
        self._reply.setdefault(kind, []).append(reply)

    def ask(self, kind: type[M], who: int | str = "*", timeout_s: float = 1.0) -> list[tuple[M, Stamp | None]]:
        """Ask everyone for a class; the highest epoch per aircraft is kept."""
        uav = who if isinstance(who, int) else None
        found: list[tuple[M, Stamp | None]] = []
        for reply in self._reply.get(kind, []):
            try:
                answers = asked_for(uav, reply(uav, {}, b""))
            except ValueError:
                continue  # a refusal; on Zenoh it travels as an error reply, which `ask` leaves out
            found += [(decode(kind, encode(message), encoding(kind)), stamp) for message, stamp in answers]
        return newest(found)

    def inquire(self, kind: type[M], who: int, payload: bytes, timeout_s: float = 5.0) -> tuple[M, Stamp | None] | None:
        """Ask about one aircraft with a payload; a refusal is raised as it is."""
        answers = [pair for reply in self._reply.get(kind, []) for pair in asked_for(who, reply(who, {}, payload))]
        found = newest([(decode(kind, encode(message), encoding(kind)), stamp) for message, stamp in answers])
        return found[0] if found else None

    def present(self, name: str) -> None:
        """Need nothing: a process knows that it lives."""

    def close(self) -> None:
        """Forget everyone."""
        self._heard.clear()
        self._overheard.clear()
        self._reply.clear()

    def __exit__(self, *_: object) -> None:
        self.close()


class ZenohBus(AbstractContextManager):
    """The bus between processes. Use it in a `with` statement: an unclosed session can hang at exit."""

    def __init__(self, session: zenoh.Session) -> None:
        self.writer = secrets.randbits(63)
        self.bad = 0
        self._session = session
        self._declared: list[Any] = []
        self._publishers: dict[str, Any] = {}
        self._lock = threading.Lock()

    @property
    def router(self) -> str:
        """Name the router by its id, which is another after a restart; empty: none is there."""
        return " ".join(map(str, self._session.info.routers_zid()))

    def publish(self, message: Any, stamp: Stamp | None = None) -> None:
        """Send one message to whoever listens."""
        kind = type(message)
        self.put(Wire(kind, message.uav if kind in PER_UAV else -1, encode(message)), stamp)

    def put(self, wire: Wire, stamp: Stamp | None = None) -> None:
        """Send one message that is packed already."""
        name = key(wire.kind, wire.uav if wire.kind in PER_UAV else f"{self.writer:016x}")
        publisher = self._publishers.get(name)
        if publisher is None:
            with self._lock:
                if (publisher := self._publishers.get(name)) is None:
                    publisher = self._session.declare_publisher(name, encoding=encoding(wire.kind))
                    self._publishers[name] = publisher
        publisher.put(wire.payload, attachment=pack_stamp(stamp) if stamp else None)

    def subscribe(self, kind: type, heard: Heard) -> None:
        """Call `heard(message, stamp)` for every message of a class, on a thread of the session."""

        def on_sample(sample: zenoh.Sample) -> None:
            pair = self._read(kind, sample)
            if pair is not None:
                heard(*pair)

        self._declared.append(self._session.declare_subscriber(key(kind, "*"), on_sample))

    def overhear(self, kind: type, heard: Overheard) -> None:
        """Call `heard(payload, encoding, stamp)` for every message of a class, as it came, on a session's thread."""

        def on_sample(sample: zenoh.Sample) -> None:
            heard(sample.payload.to_bytes(), str(sample.encoding), _stamp(sample))

        self._declared.append(self._session.declare_subscriber(key(kind, "*"), on_sample))

    def answer(self, kind: type, reply: Answer) -> None:
        """Declare one wildcard queryable for a class; it replies on a thread of the session."""

        def on_query(query: zenoh.Query) -> None:
            with query:
                uav = uav_in(str(query.key_expr)) if kind in PER_UAV else None
                payload = query.payload.to_bytes() if query.payload is not None else b""
                try:
                    found = asked_for(uav, reply(uav, _parameters(query), payload))
                except ValueError as error:
                    query.reply_err(str(error).encode(), encoding="text/plain")
                    return
                for message, stamp in found:
                    who = message.uav if kind in PER_UAV else f"{self.writer:016x}"
                    query.reply(
                        key(kind, who),
                        encode(message),
                        encoding=encoding(kind),
                        attachment=pack_stamp(stamp) if stamp else None,
                    )

        name = key(kind, "*" if kind in PER_UAV else f"{self.writer:016x}")
        self._declared.append(self._session.declare_queryable(name, on_query, complete=False))

    def ask(self, kind: type[M], who: int | str = "*", timeout_s: float = 1.0) -> list[tuple[M, Stamp | None]]:
        """Ask everyone for a class; the highest epoch per aircraft is kept."""
        return self._answers(kind, self._replies(key(kind, who), timeout_s))

    def inquire(self, kind: type[M], who: int, payload: bytes, timeout_s: float = 5.0) -> tuple[M, Stamp | None] | None:
        """Ask about one aircraft with a payload; a refusal that nobody contradicts is raised."""
        replies = self._replies(key(kind, who), timeout_s, payload)
        found = self._answers(kind, replies)
        refused = [reply.err.payload.to_bytes().decode(errors="replace") for reply in replies if reply.err is not None]
        if not found and refused:
            raise ValueError(refused[0])
        return found[0] if found else None

    def _replies(self, name: str, timeout_s: float, payload: bytes | None = None) -> list[zenoh.Reply]:
        try:
            replies = self._session.get(
                name,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout_s,
                payload=payload,
            )
            return list(replies)
        except zenoh.ZError as error:
            raise ConnectionError(
                f"bus: asking on {name} failed ({error}), expected an open session; join the router again"
            ) from None

    def _answers(self, kind: type[M], replies: list[zenoh.Reply]) -> list[tuple[M, Stamp | None]]:
        pairs = [self._read(kind, reply.ok) for reply in replies if reply.ok is not None]
        return newest([pair for pair in pairs if pair is not None])

    def _read(self, kind: type, sample: zenoh.Sample) -> tuple[Any, Stamp | None] | None:
        try:
            message: Any = decode(kind, sample.payload.to_bytes(), str(sample.encoding))
        except ValueError:
            self.bad += 1
            return None
        return message, _stamp(sample)

    def present(self, name: str) -> None:
        """Declare the liveliness token `parauav/@live/{name}`; it goes with the session."""
        self._declared.append(self._session.liveliness().declare_token(f"{ROOT}/@live/{name}"))

    def close(self) -> None:
        """Close the session."""
        self._session.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def _stamp(sample: zenoh.Sample) -> Stamp | None:
    return unpack_stamp(sample.attachment.to_bytes() if sample.attachment is not None else None)


def _parameters(query: zenoh.Query) -> dict[str, str]:
    """Read `?horizon=30;step=0.5`."""
    pairs = (part.partition("=") for part in str(query.parameters).split(";") if part)
    return {name: value for name, _, value in pairs}


def _config(mode: str, *, connect: list[str], listen: list[str]) -> zenoh.Config:
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": mode,
        "connect/endpoints": connect,
        "listen/endpoints": listen,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
        "connect/timeout_ms": 0 if mode == "router" else -1,
        "connect/exit_on_failure": False,
        "transport/link/tx/lease": 1000,
        "transport/link/tx/keep_alive": 4,
    }
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return config


def reachable(router: str = ROUTER) -> bool:
    """Tell whether something accepts connections at a `tcp/host:port` endpoint."""
    host, port = endpoint(router)
    try:
        with socket.create_connection((host, port), timeout=0.5):
            return True
    except OSError:
        return False


def endpoint(router: str) -> tuple[str, int]:
    """Split `tcp/127.0.0.1:7447` into host and port.

    Raises:
        ValueError: when it is no tcp or tls endpoint.
    """
    kind, _, rest = router.partition("/")
    host, _, port = rest.rpartition(":")
    if kind not in ("tcp", "tls") or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ValueError(f"--router: found {router!r}, expected e.g. {ROUTER}; name protocol, host and port")
    return host.strip("[]"), int(port)


def _family(router: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in endpoint(router)[0] else socket.AF_INET


def connect(router: str = ROUTER, *, patient: bool = False) -> ZenohBus:
    """Join the bus through a router; `patient` begins also without one and joins it when it comes.

    Raises:
        ConnectionError: when nobody answers there; start `zenohd` or `fleet up`.
    """
    if reachable(router):
        return ZenohBus(zenoh.open(_config("client", connect=[router], listen=[])))
    if not patient:
        raise ConnectionError(
            f"router {router}: nobody answers; start `zenohd` or `fleet up`, or name another --router"
        )
    return ZenohBus(zenoh.open(_config("peer", connect=[router], listen=[])))  # a client would wait in `open`


def open_router(router: str = ROUTER) -> zenoh.Session:
    """Be the router: a Zenoh session in router mode that listens at `router`; close it when done.

    Raises:
        ConnectionError: when `router` is not an address of this machine, or taken; Zenoh itself would try for ever.
    """
    try:
        socket.create_server(endpoint(router), family=_family(router)).close()
    except OSError as error:
        reason = f"nobody answers and none can be opened here ({error.strerror or error})"
        raise ConnectionError(f"router {router}: {reason}; start `zenohd` there or name another --router") from None
    return zenoh.open(_config("router", connect=[], listen=[router]))
