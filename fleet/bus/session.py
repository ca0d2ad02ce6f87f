"""Publish, subscribe and query on Zenoh. The only file that imports zenoh.

A client must never block the router. A message that must not be dropped on congestion (CongestionControl.BLOCK) stops
the router's reading thread for up to 5 s where its receiver does not read; all other traffic of that thread, and every
declaration, waits. Therefore received messages are buffered immediately, independent of Python, and the oldest are
dropped when the buffer is full; large replies are sent one by one, dropped on congestion and queried again; small
replies have a queue of their own, which telemetry cannot fill.
"""

import json
import logging
import secrets
import socket
import threading
from collections.abc import Callable, Container, Iterable, Iterator
from contextlib import AbstractContextManager
from itertools import islice
from typing import Any, TypeVar

import zenoh

from fleet.access.entry import ROUTER, Entry, endpoint
from fleet.access.knock import answers
from fleet.access.roles import ROOT
from fleet.bus.bus_protocol import (
    Answer,
    Collected,
    Heard,
    Letter,
    Overheard,
    Token,
    Wants,
    asked_for,
    key,
    newest,
    uav_in,
)
from fleet.bus.codec import Stamp, Wire, decode_from, encode, encoding, pack_stamp, unpack_stamp
from fleet.contract import PER_UAV, Claim

M = TypeVar("M")
_log = logging.getLogger(__name__)
_WAITED_FOR = (Claim,)  # rare and essential: the sender blocks on congestion; all other messages are dropped
_LIVE = f"{ROOT}/@live/"
_PUT_ASIDE = 20_000  # messages of a class buffered until `dispatch`
_UNHEARD = 4096  # messages of a subscription, or queries of a queryable, waiting for Python; the oldest are dropped
_ANSWERS = 4096  # replies waiting to be read
_SHORT = {"priority": zenoh.Priority.DATA_HIGH}  # queries and replies of kilobytes: a queue separate from telemetry
_LARGE = {  # replies of megabytes: telemetry and predictions overtake them, and a slow reader blocks no one else
    "priority": zenoh.Priority.DATA_LOW,
    "congestion_control": zenoh.CongestionControl.DROP,
}
_TOKENS = 4096  # tokens in one query; with the default channel more than 256 block for ever


class ZenohBus(AbstractContextManager):
    """Bus between processes. Use it in a `with` statement: an unclosed session can block at exit."""

    def __init__(self, session: zenoh.Session) -> None:
        self.writer = secrets.randbits(63)
        self.bad = 0
        self._session = session
        self._declared: list[Any] = []
        self._publishers: dict[tuple[type, int], Any] = {}
        self._lock = threading.Lock()
        self._collected: list[tuple[type, zenoh.Handler[zenoh.Sample], Collected]] = []
        self._handing = threading.Lock()

    def publish(self, message: Any, stamp: Stamp | None = None) -> None:
        """Publish one message."""
        kind = type(message)
        self.put(Wire(kind, message.uav if kind in PER_UAV else -1, encode(message)), stamp)

    def put(self, wire: Wire, stamp: Stamp | None = None) -> None:
        """Publish one encoded message."""
        publisher = self._publishers.get((wire.kind, wire.uav))
        if publisher is None:
            with self._lock:
                if (publisher := self._publishers.get((wire.kind, wire.uav))) is None:
                    name = key(wire.kind, wire.uav if wire.kind in PER_UAV else f"{self.writer:016x}")
                    publisher = self._session.declare_publisher(name, encoding=encoding(wire.kind), **_care(wire.kind))
                    self._publishers[wire.kind, wire.uav] = publisher
        publisher.put(wire.payload, attachment=pack_stamp(stamp) if stamp else None)

    @property
    def router(self) -> str:
        """Return the id of the connected router, which changes with a restart; empty while none is connected."""
        return " ".join(map(str, self._session.info.routers_zid()))

    def subscribe(self, kind: type, heard: Heard, wants: Wants | None = None) -> None:
        """Call `callback(message, stamp)` for every message of a class, on a thread of the session."""

        def on_sample(sample: zenoh.Sample) -> None:
            if wants is not None and ((uav := uav_in(str(sample.key_expr))) is None or not wants(uav)):
                return
            pair = self._read(kind, sample)
            if pair is not None:
                heard(*pair)

        self._receive(kind, on_sample, _UNHEARD)

    def overhear(self, kind: type, heard: Overheard) -> None:
        """Call `callback(payload, encoding, stamp)` for every message of a class, undecoded, on a session's thread."""

        def on_sample(sample: zenoh.Sample) -> None:
            heard(sample.payload.to_bytes(), str(sample.encoding), _stamp(sample))

        self._receive(kind, on_sample, _PUT_ASIDE)

    def _receive(self, kind: type, act: Callable[[zenoh.Sample], None], most: int) -> None:
        """Call `handle` for every message of a class on a thread of its own; queue at most `queue_size` messages."""
        subscriber = self._session.declare_subscriber(key(kind, "*"), zenoh.handlers.RingChannel(most))
        self._declared.append(subscriber)
        self._work_off(subscriber.handler, act, key(kind, "*"))

    @staticmethod
    def _work_off(waiting: "zenoh.Handler[Any]", act: Callable[[Any], None], name: str) -> None:
        """Call `handle` for every item of a channel in order, until the session is closed."""

        def run() -> None:
            while True:
                try:
                    one = waiting.recv()
                except zenoh.ZError:  # the session is closed
                    return
                try:
                    act(one)
                except Exception:  # a defect in one message must not stop the others
                    _log.exception("bus: a message on %s caused an internal error; report it", name)

        threading.Thread(target=run, name=f"bus {name}", daemon=True).start()

    def collect(self, kind: type, heard: Collected) -> None:
        """Buffer every message of a class until `dispatch`; a full buffer drops its oldest messages."""
        subscriber = self._session.declare_subscriber(key(kind, "*"), zenoh.handlers.RingChannel(_PUT_ASIDE))
        self._declared.append(subscriber)
        self._collected.append((kind, subscriber.handler, heard))

    def hand_out(self, newest: Container[type] = ()) -> None:
        """Pass the buffered messages to their callbacks in order of arrival, or only the newest of each key."""
        if not self._handing.acquire(blocking=False):
            return  # another thread is dispatching
        try:
            for kind, handler, heard in self._collected:
                waiting: Iterable[zenoh.Sample] = islice(iter(handler.try_recv, None), _PUT_ASIDE)
                if kind in newest:
                    waiting = {one.key_expr: one for one in waiting}.values()
                if found := [_letter(one) for one in waiting]:
                    heard(found)
        finally:
            self._handing.release()

    def answer(self, kind: type, reply: Answer) -> None:
        """Declare one wildcard queryable for a class; the handler runs on a thread of the session."""

        def on_query(query: zenoh.Query) -> None:
            with query:
                uav, named = uav_in(str(query.key_expr)) if kind in PER_UAV else None, zenoh.Encoding(encoding(kind))
                payload = query.payload.to_bytes() if query.payload is not None else b""
                try:
                    for message, stamp in asked_for(uav, reply(uav, _parameters(query), payload)):
                        name = key(kind, message.uav if kind in PER_UAV else f"{self.writer:016x}")
                        if not query.key_expr.intersects(name):
                            continue  # a key expression outside the contract, such as parauav/1$*/status
                        query.reply(
                            name,
                            encode(message),
                            encoding=named,
                            attachment=pack_stamp(stamp) if stamp else None,
                        )
                except ValueError as error:
                    query.reply_err(str(error).encode(), encoding="text/plain")

        name = key(kind, "*" if kind in PER_UAV else f"{self.writer:016x}")
        queryable = self._session.declare_queryable(name, zenoh.handlers.RingChannel(_UNHEARD), complete=False)
        self._declared.append(queryable)
        self._work_off(queryable.handler, on_query, name)

    def ask(self, kind: type[M], who: int | str = "*", timeout_s: float = 1.0) -> list[tuple[M, Stamp | None]]:
        """Query all writers of a class; return the reply of highest epoch per aircraft."""
        return self._answers(kind, self._replies(key(kind, who), timeout_s))

    def inquire(self, kind: type[M], who: int, payload: bytes, timeout_s: float = 5.0) -> tuple[M, Stamp | None] | None:
        """Query one aircraft with a payload; raise the error of an error reply where no other reply arrives."""
        replies = self._replies(key(kind, who), timeout_s, payload)
        found = self._answers(kind, replies)
        refused = [reply.err.payload.to_bytes().decode(errors="replace") for reply in replies if reply.err is not None]
        if not found and refused:
            raise ValueError(refused[0])
        return found[0] if found else None

    def gather(self, kind: type[M], who: int | str, payload: bytes, timeout_s: float) -> Iterator[M]:
        """Query with a payload and yield every reply on arrival."""
        for reply in self._coming(key(kind, who), timeout_s, payload, _LARGE):
            if (found := reply.ok) is not None and (pair := self._read(kind, found)) is not None:
                yield pair[0]

    def fetch(self, kind: type, who: int | str, timeout_s: float) -> Iterator[bytes]:
        """Query and yield the payload of every reply on arrival; skip other versions."""
        for reply in self._coming(key(kind, who), timeout_s, care=_LARGE):
            if (found := reply.ok) is not None and str(found.encoding) == encoding(kind):
                yield found.payload.to_bytes()

    def _replies(self, name: str, timeout_s: float, payload: bytes | None = None) -> list[zenoh.Reply]:
        return list(self._coming(name, timeout_s, payload))

    def _coming(
        self, name: str, timeout_s: float, payload: bytes | None = None, care: dict[str, Any] = _SHORT
    ) -> Iterator[zenoh.Reply]:
        try:
            yield from self._session.get(
                name,
                zenoh.handlers.FifoChannel(_ANSWERS),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout_s,
                payload=payload,
                **care,
            )
        except zenoh.ZError as error:
            raise ConnectionError(
                f"bus: the query on {name} failed ({error}), expected an open session; connect to the router again"
            ) from None

    def _answers(self, kind: type[M], replies: list[zenoh.Reply]) -> list[tuple[M, Stamp | None]]:
        pairs = [self._read(kind, reply.ok) for reply in replies if reply.ok is not None]
        return newest([pair for pair in pairs if pair is not None])

    def _read(self, kind: type, sample: zenoh.Sample) -> tuple[Any, Stamp | None] | None:
        try:
            uav = uav_in(str(sample.key_expr))
            message: Any = decode_from(kind, uav, sample.payload.to_bytes(), str(sample.encoding))
        except ValueError:
            self.bad += 1
            return None
        return message, _stamp(sample)

    def present(self, name: str) -> None:
        """Declare the liveliness token `parauav/@live/{name}` for the lifetime of the session."""
        self._declared.append(self._session.liveliness().declare_token(_LIVE + name))

    def attend(self, told: Token) -> None:
        """Call `callback(name, alive)` for every liveliness token now, and on every later change."""

        def on_token(sample: zenoh.Sample) -> None:
            told(str(sample.key_expr).removeprefix(_LIVE), sample.kind == zenoh.SampleKind.PUT)

        self._declared.append(self._session.liveliness().declare_subscriber(_LIVE + "**", on_token))
        self.recount(told)

    def recount(self, told: Token) -> None:
        """Call `callback(name, True)` for every current liveliness token."""
        for reply in self._session.liveliness().get(_LIVE + "**", zenoh.handlers.FifoChannel(_TOKENS), timeout=1.0):
            if reply.ok is not None:
                told(str(reply.ok.key_expr).removeprefix(_LIVE), True)

    def close(self) -> None:
        """Close the session."""
        self._session.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def _care(kind: type) -> dict[str, Any]:
    """Return the quality of service of a message class."""
    if kind not in _WAITED_FOR:
        return {}
    return {"congestion_control": zenoh.CongestionControl.BLOCK, "priority": zenoh.Priority.INTERACTIVE_HIGH}


def _stamp(sample: zenoh.Sample) -> Stamp | None:
    return unpack_stamp(sample.attachment.to_bytes() if sample.attachment is not None else None)


def _letter(one: zenoh.Sample) -> Letter:
    return uav_in(str(one.key_expr)), one.payload.to_bytes(), str(one.encoding), _stamp(one)


def _parameters(query: zenoh.Query) -> dict[str, str]:
    """Parse the parameters of a query: `?horizon=30;step=0.5`."""
    pairs = (part.partition("=") for part in str(query.parameters).split(";") if part)
    return {name: value for name, _, value in pairs}


def _config(settings: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return config


def _entry(router: str | Entry) -> Entry:
    return router if isinstance(router, Entry) else Entry(router)


def connect(router: str | Entry = ROUTER, *, patient: bool = False) -> ZenohBus:
    """Connect to the bus through a router; with `retry` also without one, and join when it starts.

    Raises:
        ConnectionError: when no router responds or it rejects the client; start `zenohd` or `fleet up`.
        ValueError: when a credential is missing, expired or readable by others.
    """
    entry = _entry(router)
    if answers(entry):
        try:
            return ZenohBus(zenoh.open(_config(entry.session())))
        except zenoh.ZError:
            words = (
                f"it to accept the password of {entry.role}" if entry.passwords else "a Zenoh router without password"
            )
            raise ConnectionError(
                f"router {entry.at}: found the connection rejected, expected {words}; check it with `fleet doctor`"
            ) from None
    if not patient:
        raise ConnectionError(f"router {entry.at}: no response; start `zenohd` or `fleet up`, or name another --router")
    return ZenohBus(zenoh.open(_config(entry.session(patient=True))))


def open_router(router: str | Entry = ROUTER) -> zenoh.Session:
    """Open a Zenoh session in router mode that listens at `router`; close it when done.

    Raises:
        ConnectionError: when `router` is not a free address of this machine; Zenoh itself would retry for ever.
        ValueError: when its certificate is missing, expired or readable by others.
    """
    entry = _entry(router)
    family = socket.AF_INET6 if ":" in endpoint(entry.at)[0] else socket.AF_INET
    try:
        socket.create_server(endpoint(entry.at), family=family).close()
    except OSError as error:
        reason = f"no response, and no router can be opened here ({error.strerror or error})"
        raise ConnectionError(f"router {entry.at}: {reason}; start `zenohd` there or name another --router") from None
    return zenoh.open(_config(entry.router()))
