"""Publish, subscribe and query on Zenoh. The only file that imports zenoh, when a session is opened.

A client must never block the router. A message that must not be dropped on congestion (CongestionControl.BLOCK) stops
the router's reading thread for up to 5 s where its receiver does not read; all other traffic of that thread, and every
declaration, waits. Therefore received messages are buffered immediately, independent of Python, and the oldest are
dropped when the buffer is full; large replies are sent one by one, dropped on congestion and queried again; small
replies have a queue of their own, which telemetry cannot fill.
"""

from __future__ import annotations  # zenoh is imported when it is used: no `--help` needs it

import json
import logging
import os
import secrets
import socket
import threading
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeVar

from fleet.access.entry import ROUTER, BusConfig, parse_endpoint
from fleet.access.knock import probe_router
from fleet.access.roles import ROOT
from fleet.bus.bus_protocol import (
    QueryHandler,
    RawMessage,
    key_of,
    make_batches,
    replies_about,
    select_latest,
    split_batch,
    uav_of_key,
)
from fleet.bus.codec import EncodedMessage, Stamp, decode_for_key, encode, encoding, pack_stamp, unpack_stamp
from fleet.contract import PER_UAV, Claim, Sample, Samples

if TYPE_CHECKING:
    import zenoh

M = TypeVar("M")
_log = logging.getLogger(__name__)
Callback = Callable[[Any, Stamp | None], None]
RawCallback = Callable[[bytes, str, Stamp | None], None]
BatchCallback = Callable[[list[RawMessage]], None]
LivelinessCallback = Callable[[str, bool], None]
_LIVE_PREFIX = f"{ROOT}/@live/"
_BUFFER_SIZE = 20_000  # messages of a class buffered until `dispatch`
_QUEUE_SIZE = 4096  # messages of a subscription, or queries of a queryable, waiting for Python; the oldest are dropped
_REPLY_QUEUE_SIZE = 4096  # replies waiting to be read
_TOKEN_QUEUE_SIZE = 4096  # tokens in one query; with the default channel more than 256 block for ever


class Bus(AbstractContextManager):
    """Bus of one process. Use it in a `with` statement: an unclosed session can block at exit."""

    def __init__(self, session: zenoh.Session) -> None:
        import zenoh

        self.writer = secrets.randbits(63)  # random id of this process on the bus
        self.bad = 0  # received messages that do not decode
        self._session, self._zenoh = session, zenoh
        priority, congestion = zenoh.Priority, zenoh.CongestionControl
        self._reliable: dict[type, dict[str, Any]] = {  # rare and essential: the sender blocks on congestion
            Claim: {"congestion_control": congestion.BLOCK, "priority": priority.INTERACTIVE_HIGH}
        }
        # kilobytes: a queue separate from telemetry
        self._small_replies: dict[str, Any] = {"priority": priority.DATA_HIGH}
        # megabytes: telemetry and predictions overtake them, a slow reader blocks no one else
        self._large_replies: dict[str, Any] = {"priority": priority.DATA_LOW, "congestion_control": congestion.DROP}
        self._declared: list[Any] = []
        self._publishers: dict[tuple[type, int], Any] = {}
        self._lock = threading.Lock()
        self._buffered: list[tuple[type, zenoh.Handler[zenoh.Sample], BatchCallback]] = []
        self._dispatching = threading.Lock()

    def publish(self, message: Any, stamp: Stamp | None = None) -> None:
        """Publish one message."""
        kind = type(message)
        self.put_all([EncodedMessage(kind, message.uav if kind in PER_UAV else -1, encode(message), message.t)], stamp)

    def put_all(self, messages: Sequence[EncodedMessage], stamp: Stamp | None = None) -> None:
        """Publish encoded messages in order, and their samples once more as batches of many aircraft."""
        attachment = pack_stamp(stamp) if stamp else None
        for kind, uav, payload, _ in messages:
            publisher = self._publishers.get((kind, uav)) or self._declare_publisher(kind, uav)
            publisher.put(payload, attachment=attachment)
        for batch in make_batches(message for message in messages if message.kind is Sample):
            publisher = self._publishers.get((Samples, -1)) or self._declare_publisher(Samples, -1)
            publisher.put(batch, attachment=attachment)

    def _declare_publisher(self, kind: type, uav: int) -> zenoh.Publisher:
        with self._lock:
            if (publisher := self._publishers.get((kind, uav))) is None:
                name = key_of(kind, uav if kind in PER_UAV else f"{self.writer:016x}")
                quality = self._reliable.get(kind, {})
                publisher = self._session.declare_publisher(name, encoding=encoding(kind), **quality)
                self._publishers[kind, uav] = publisher
        return publisher

    def remove_publishers(self, uavs: Collection[int]) -> None:
        """Undeclare the publishers of aircraft that this process no longer publishes."""
        with self._lock:
            removed = [self._publishers.pop(key) for key in list(self._publishers) if key[1] in uavs]
        for publisher in removed:
            publisher.undeclare()

    @property
    def router(self) -> str:
        """Return the id of the connected router, which changes with a restart; empty while none is connected."""
        return " ".join(map(str, self._session.info.routers_zid()))

    def subscribe(self, kind: type, callback: Callback, accepts: Callable[[int], bool] | None = None) -> None:
        """Call `callback(message, stamp)` for every message of a class; undecodable messages are counted only.

        Args:
            kind: message class of the contract
            callback: called on a thread of the bus
            accepts: filter by UAV id, applied before decoding; None: all
        """

        def on_message(message: RawMessage) -> None:
            uav, payload, encoding_name, stamp = message
            if accepts is not None and uav is not None and not accepts(uav):
                return
            if (decoded := self._decode(kind, uav, payload, encoding_name)) is not None:
                callback(decoded, stamp)

        self._declare_subscriber(kind, on_message, _QUEUE_SIZE)

    def subscribe_raw(self, kind: type, callback: RawCallback) -> None:
        """Call `callback(payload, encoding, stamp)` for every message of a class, undecoded, on a session's thread."""
        self._declare_subscriber(kind, lambda message: callback(*message[1:]), _BUFFER_SIZE)

    def _declare_subscriber(self, kind: type, handle: Callable[[RawMessage], None], queue_size: int) -> None:
        """Call `handle` for every message of a class on a thread of its own; queue at most `queue_size` messages."""

        def on_sample(sample: zenoh.Sample) -> None:
            for message in _raw_messages(kind, (sample,)):
                handle(message)

        self._consume(self._open_channel(kind, queue_size), on_sample, key_of(kind, "*"))

    def _open_channel(self, kind: type, size: int) -> zenoh.Handler[zenoh.Sample]:
        """Subscribe to a class, to samples in batches; the oldest messages of a full channel are dropped."""
        name = key_of(Samples if kind is Sample else kind, "*")
        subscriber = self._session.declare_subscriber(name, self._zenoh.handlers.RingChannel(size))
        self._declared.append(subscriber)
        return subscriber.handler

    def _consume(self, channel: zenoh.Handler[Any], handle: Callable[[Any], None], name: str) -> None:
        """Call `handle` for every item of a channel in order, until the session is closed."""

        def run() -> None:
            while True:
                try:
                    item = channel.recv()
                except self._zenoh.ZError:  # the session is closed
                    return
                try:
                    handle(item)
                except Exception:  # a defect in one message must not stop the others
                    _log.exception("bus: a message on %s caused an internal error; report it", name)

        threading.Thread(target=run, name=f"bus {name}", daemon=True).start()

    def subscribe_buffered(self, kind: type, callback: BatchCallback) -> None:
        """Buffer every message of a class, undecoded, until `dispatch`; a full buffer drops its oldest messages."""
        self._buffered.append((kind, self._open_channel(kind, _BUFFER_SIZE), callback))

    def dispatch(self, latest_only: Container[type] = ()) -> None:
        """Pass the buffered messages to their callbacks in order of arrival, on this thread.

        Args:
            latest_only: classes of which only the newest message of each aircraft is passed on
        """
        if not self._dispatching.acquire(blocking=False):
            return  # another thread is dispatching
        try:
            for kind, channel, callback in self._buffered:
                messages = _raw_messages(kind, islice(iter(channel.try_recv, None), _BUFFER_SIZE))
                if kind in latest_only:
                    messages = list({message[0]: message for message in messages}.values())
                if messages:
                    callback(messages)
        finally:
            self._dispatching.release()

    def declare_queryable(self, kind: type, handler: QueryHandler) -> None:
        """Declare one wildcard queryable for a class: `handler(uav or None, parameters, payload)`, on a thread."""

        def on_query(query: zenoh.Query) -> None:
            with query:
                queried = query.key_expr
                uav = uav_of_key(str(queried)) if kind in PER_UAV else None
                is_wildcard = str(queried) == declared
                reply_encoding = self._zenoh.Encoding(encoding(kind))
                payload = query.payload.to_bytes() if query.payload is not None else b""
                try:
                    for message, stamp in replies_about(uav, handler(uav, _parameters(query), payload)):
                        name = key_of(kind, message.uav) if kind in PER_UAV else declared
                        if not (is_wildcard or queried.intersects(name)):
                            continue  # a key expression outside the contract, such as parauav/1$*/status
                        attachment = pack_stamp(stamp) if stamp else None
                        query.reply(name, encode(message), encoding=reply_encoding, attachment=attachment)
                except ValueError as error:
                    query.reply_err(str(error).encode(), encoding="text/plain")

        declared = key_of(kind, "*" if kind in PER_UAV else f"{self.writer:016x}")
        channel: zenoh.handlers.RingChannel[zenoh.Query] = self._zenoh.handlers.RingChannel(_QUEUE_SIZE)
        queryable = self._session.declare_queryable(declared, channel, complete=False)
        self._declared.append(queryable)
        self._consume(queryable.handler, on_query, declared)

    def get(self, kind: type[M], target: int | str = "*", timeout_s: float = 1.0) -> list[tuple[M, Stamp | None]]:
        """Query all writers of a class for at most `timeout_s` [s]; return the reply of highest epoch per aircraft.

        Raises:
            ConnectionError: when the session is closed; join the router again. All queries raise it.
        """
        return self._decode_replies(kind, self._iter_replies(key_of(kind, target), timeout_s))

    def get_one(
        self, kind: type[M], target: int, payload: bytes, timeout_s: float = 5.0
    ) -> tuple[M, Stamp | None] | None:
        """Query one aircraft with a payload; None without a reply.

        Raises:
            ValueError: when every reply is an error; with the text of the first.
        """
        replies = list(self._iter_replies(key_of(kind, target), timeout_s, payload))
        pairs = self._decode_replies(kind, replies)
        refusals = [reply.err.payload.to_bytes().decode(errors="replace") for reply in replies if reply.err is not None]
        if not pairs and refusals:
            raise ValueError(refusals[0])
        return pairs[0] if pairs else None

    def get_stream(self, kind: type[M], target: int | str, payload: bytes, timeout_s: float) -> Iterator[M]:
        """Query with a payload and yield every reply on arrival, for at most `timeout_s` [s]; omit error replies."""
        for reply in self._iter_replies(key_of(kind, target), timeout_s, payload, self._large_replies):
            if reply.ok is not None and (message := self._decode(kind, *_raw_message(reply.ok)[:3])) is not None:
                yield message

    def get_payloads(self, kind: type, target: int | str, timeout_s: float) -> Iterator[bytes]:
        """Query and yield the payload of every reply on arrival; skip other versions."""
        for reply in self._iter_replies(key_of(kind, target), timeout_s, qos=self._large_replies):
            if (sample := reply.ok) is not None and str(sample.encoding) == encoding(kind):
                yield sample.payload.to_bytes()

    def _iter_replies(
        self, name: str, timeout_s: float, payload: bytes | None = None, qos: dict[str, Any] | None = None
    ) -> Iterator[zenoh.Reply]:
        try:
            yield from self._session.get(
                name,
                self._zenoh.handlers.FifoChannel(_REPLY_QUEUE_SIZE),
                target=self._zenoh.QueryTarget.ALL,
                consolidation=self._zenoh.ConsolidationMode.NONE,
                timeout=timeout_s,
                payload=payload,
                **(qos or self._small_replies),
            )
        except self._zenoh.ZError as error:
            raise ConnectionError(
                f"bus: the query on {name} failed ({error}), expected an open session; connect to the router again"
            ) from None

    def _decode_replies(self, kind: type[M], replies: Iterable[zenoh.Reply]) -> list[tuple[M, Stamp | None]]:
        raw = [_raw_message(reply.ok) for reply in replies if reply.ok is not None]
        pairs = [(self._decode(kind, *message[:3]), message[3]) for message in raw]
        return select_latest([(message, stamp) for message, stamp in pairs if message is not None])

    def _decode(self, kind: type[M], uav: int | None, payload: bytes, encoding_name: str) -> M | None:
        try:
            return decode_for_key(kind, uav, payload, encoding_name)
        except ValueError:
            self.bad += 1
            return None

    def declare_liveliness(self, name: str) -> None:
        """Declare the liveliness token `parauav/@live/{name}` for the lifetime of the session."""
        self._declared.append(self._session.liveliness().declare_token(_LIVE_PREFIX + name))

    def watch_liveliness(self, callback: LivelinessCallback) -> None:
        """Call `callback(name, alive)` for every liveliness token now, and on every later change."""

        def on_token(sample: zenoh.Sample) -> None:
            callback(str(sample.key_expr).removeprefix(_LIVE_PREFIX), sample.kind == self._zenoh.SampleKind.PUT)

        self._declared.append(self._session.liveliness().declare_subscriber(_LIVE_PREFIX + "**", on_token))
        self.list_liveliness(callback)

    def list_liveliness(self, callback: LivelinessCallback) -> None:
        """Call `callback(name, True)` for every current liveliness token."""
        for reply in self._session.liveliness().get(
            _LIVE_PREFIX + "**", self._zenoh.handlers.FifoChannel(_TOKEN_QUEUE_SIZE), timeout=1.0
        ):
            if reply.ok is not None:
                callback(str(reply.ok.key_expr).removeprefix(_LIVE_PREFIX), True)

    def close(self) -> None:
        """Close the session."""
        self._session.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def _raw_message(sample: zenoh.Sample) -> RawMessage:
    stamp = None if (attachment := sample.attachment) is None else unpack_stamp(attachment.to_bytes())
    return uav_of_key(str(sample.key_expr)), sample.payload.to_bytes(), str(sample.encoding), stamp


def _raw_messages(kind: type, samples: Iterable[zenoh.Sample]) -> list[RawMessage]:
    """Return the messages of a class as received, but batches of samples, unless they do not decode, split."""
    messages = map(_raw_message, samples)
    return [one for message in messages for one in split_batch(message)] if kind is Sample else list(messages)


def _parameters(query: zenoh.Query) -> dict[str, str]:
    """Parse the parameters of a query: `?horizon=30;step=0.5`."""
    pairs = (part.partition("=") for part in str(query.parameters).split(";") if part)
    return {name: value for name, _, value in pairs}


def _config(settings: dict[str, Any]) -> zenoh.Config:
    import zenoh

    config = zenoh.Config()
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return config


def _as_bus_config(router: str | BusConfig) -> BusConfig:
    return router if isinstance(router, BusConfig) else BusConfig(router)


def receive_on_one_thread() -> None:
    """Let Zenoh receive on the thread of its other tasks; call it before the first `connect` of a process.

    For processes with one router that only listen. By default two threads receive: they hand over to each other for
    every few messages, which takes about a third of the CPU time of receiving. ZENOH_RUNTIME has precedence.
    """
    os.environ.setdefault("ZENOH_RUNTIME", "(rx: (handover: app))")


def connect(router: str | BusConfig = ROUTER, *, retry: bool = False) -> Bus:
    """Connect to the bus through a router; with `retry` also without one, and join when it starts.

    Raises:
        ConnectionError: when no router responds or it rejects the client; start `zenohd` or `fleet up`.
        ValueError: when a credential is missing, expired or readable by others.
    """
    import zenoh

    bus_config = _as_bus_config(router)
    if probe_router(bus_config):
        try:
            return Bus(zenoh.open(_config(bus_config.session_settings())))
        except zenoh.ZError:
            password = f"it to accept the password of {bus_config.role}"
            expected = password if bus_config.passwords else "a Zenoh router without password"
            reason = f"found the connection rejected, expected {expected}; check it with `fleet doctor`"
            raise ConnectionError(f"router {bus_config.endpoint}: {reason}") from None
    if not retry:
        raise ConnectionError(
            f"router {bus_config.endpoint}: no response; start `zenohd` or `fleet up`, or name another --router"
        )
    return Bus(zenoh.open(_config(bus_config.session_settings(retry=True))))


def open_router(router: str | BusConfig = ROUTER) -> zenoh.Session:
    """Open a Zenoh session in router mode that listens at `router`; close it when done.

    Raises:
        ConnectionError: when `router` is not a free address of this machine; Zenoh itself would retry for ever.
        ValueError: when its certificate is missing, expired or readable by others.
    """
    import zenoh

    bus_config = _as_bus_config(router)
    family = socket.AF_INET6 if ":" in parse_endpoint(bus_config.endpoint)[0] else socket.AF_INET
    try:
        socket.create_server(parse_endpoint(bus_config.endpoint), family=family).close()
    except OSError as error:
        reason = f"no response, and no router can be opened here ({error.strerror or error})"
        raise ConnectionError(
            f"router {bus_config.endpoint}: {reason}; start `zenohd` there or name another --router"
        ) from None
    return zenoh.open(_config(bus_config.router_settings()))
