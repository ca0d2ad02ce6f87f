"""Interface of a bus: keys, publish, subscribe, queries, presence, epoch fence, selection among replies."""

import re
import time
from collections.abc import Callable, Collection, Container, Iterable, Iterator
from contextlib import AbstractContextManager
from functools import lru_cache
from typing import Any, NamedTuple, Protocol, TypeVar

from fleet.access.roles import ROOT
from fleet.bus.codec import EncodedMessage, Stamp, is_plausible_epoch
from fleet.contract import PER_UAV

M = TypeVar("M")
Callback = Callable[[Any, Stamp | None], None]
RawCallback = Callable[[bytes, str, Stamp | None], None]
RawMessage = tuple[int | None, bytes, str, Stamp | None]
"""UAV id of the key, payload, encoding, stamp."""
BatchCallback = Callable[[list[RawMessage]], None]
Replies = Iterable[tuple[Any, Stamp | None]]
QueryHandler = Callable[[int | None, dict[str, str], bytes], Replies]
LivelinessCallback = Callable[[str, bool], None]
Filter = Callable[[int], bool]


def key_of(kind: type, target: int | str) -> str:
    """Return the key of a message class: `parauav/7/sample`, `parauav/@fleet/state/{writer}`; `target` may be `*`."""
    topic: str = kind.topic  # type: ignore[attr-defined]
    return f"{ROOT}/{target}/{topic}" if kind in PER_UAV else f"{ROOT}/{topic}/{target}"


@lru_cache(maxsize=16_384)
def uav_of_key(key_name: str) -> int | None:
    """Parse the UAV id of a key; None where the chunk is a wildcard or not a number."""
    chunk = key_name.split("/")[1] if key_name.count("/") >= 2 else ""
    return int(chunk) if chunk.isdecimal() and len(chunk) <= 9 else None


class Bus(AbstractContextManager, Protocol):
    """Interface of the bus of one process."""

    writer: int  # random id of this process on the bus
    bad: int  # received messages that do not decode

    def publish(self, message: Any, stamp: Stamp | None = None) -> None:
        """Publish one message."""

    def put(self, encoded: EncodedMessage, stamp: Stamp | None = None) -> None:
        """Publish one encoded message."""

    def remove_publishers(self, uavs: Collection[int]) -> None:
        """Release what is kept per key for aircraft that this process no longer publishes."""

    @property
    def router(self) -> str:
        """Return the id of the connected router; empty while none is connected (the bus keeps retrying)."""

    def subscribe(self, kind: type, callback: Callback, accepts: Filter | None = None) -> None:
        """Call `callback(message, stamp)` for every message of a class; undecodable messages are counted only.

        Args:
            kind: message class of the contract
            callback: called on a thread of the bus
            accepts: filter by UAV id, applied before decoding; None: all
        """

    def subscribe_raw(self, kind: type, callback: RawCallback) -> None:
        """Call `callback(payload, encoding, stamp)` for every message of a class, without decoding it."""

    def subscribe_buffered(self, kind: type, callback: BatchCallback) -> None:
        """Buffer every message of a class until `dispatch`; needs no thread.

        Args:
            kind: message class of the contract
            callback: called with all buffered messages in order of arrival, undecoded
        """

    def dispatch(self, latest_only: Container[type] = ()) -> None:
        """Pass the buffered messages to their callbacks on this thread; a full buffer drops its oldest messages.

        Args:
            latest_only: classes of which only the newest message of each key is passed on
        """

    def declare_queryable(self, kind: type, handler: QueryHandler) -> None:
        """Declare one wildcard queryable for a class: `handler(uav or None, parameters, payload)`."""

    def get(self, kind: type[M], target: int | str = "*", timeout_s: float = 1.0) -> list[tuple[M, Stamp | None]]:
        """Query all writers of a class for at most `timeout_s` [s]; return the reply of highest epoch per aircraft.

        Raises:
            ConnectionError: when the session is closed; join the router again.
        """

    def get_one(
        self, kind: type[M], target: int, payload: bytes, timeout_s: float = 5.0
    ) -> tuple[M, Stamp | None] | None:
        """Query one aircraft with a payload; None without a reply.

        Raises:
            ValueError: when every reply is an error; with the text of the first.
            ConnectionError: when the session is closed; join the router again.
        """

    def get_stream(self, kind: type[M], target: int | str, payload: bytes, timeout_s: float) -> Iterator[M]:
        """Query with a payload and yield every reply on arrival, for at most `timeout_s` [s]; omits error replies.

        Raises:
            ConnectionError: when the session is closed; join the router again.
        """

    def get_payloads(self, kind: type, target: int | str, timeout_s: float) -> Iterator[bytes]:
        """Query and yield the payload of every reply on arrival, for at most `timeout_s` [s]; skip other versions.

        Raises:
            ConnectionError: when the session is closed; join the router again.
        """

    def declare_liveliness(self, name: str) -> None:
        """Declare the liveliness token `parauav/@live/{name}` for the lifetime of this process."""

    def watch_liveliness(self, callback: LivelinessCallback) -> None:
        """Call `callback(name, alive)` for every liveliness token now, and on every later change."""

    def list_liveliness(self, callback: LivelinessCallback) -> None:
        """Call `callback(name, True)` for every current liveliness token."""

    def close(self) -> None:
        """Close the connection to the bus."""


def select_latest(replies: list[tuple[M, Stamp | None]]) -> list[tuple[M, Stamp | None]]:
    """Select the reply of highest plausible epoch, then the newest, per UAV (and alert); keep all without a UAV."""
    best: dict[tuple[int, str], tuple[M, Stamp | None]] = {}
    without_uav = []
    for message, stamp in replies:
        uav = getattr(message, "uav", None)
        if uav is None:
            without_uav.append((message, stamp))
            continue
        if stamp is not None and not is_plausible_epoch(stamp.epoch):
            continue
        identity = uav, str(getattr(message, "about", ""))
        current = best.get(identity)
        if current is None or _rank(message, stamp) > _rank(*current):
            best[identity] = (message, stamp)
    return [best[identity] for identity in sorted(best)] + without_uav


def _rank(message: Any, stamp: Stamp | None) -> tuple[Stamp, float]:
    return stamp or Stamp(0, 0), message.t


def replies_about(uav: int | None, replies: Replies) -> Replies:
    """Filter replies lazily by UAV id; None keeps all."""
    return ((m, stamp) for m, stamp in replies if uav is None or getattr(m, "uav", uav) == uav)


_TOKEN_PATTERN = re.compile(r"worker/([0-9a-f]{16})/(\d{1,9})-(\d{1,9})/(\d{1,18})", re.ASCII)


class WorkerToken(NamedTuple):
    """Parsed liveliness token of a worker.

    Attributes:
        worker: its id on the bus, 16 hex digits
        ids: UAV ids it may own
        started_ms: start time, distinguishes it from an earlier incarnation [ms since 1970]
    """

    worker: str
    ids: range
    started_ms: int

    @property
    def token(self) -> str:
        """Return the text of the token."""
        return f"worker/{self.worker}/{self.ids.start}-{self.ids.stop - 1}/{self.started_ms}"


def parse_token(token: str) -> WorkerToken | None:
    """Parse a token; None where it is not a worker's."""
    match = _TOKEN_PATTERN.fullmatch(token)
    if match is None:
        return None
    worker, low, high, started = match.groups()
    return WorkerToken(worker, range(int(low), int(high) + 1), int(started))


WRITER_TIMEOUT_S = (
    10.0  # a writer silent for this long loses its claim: a lower one (a restarted fleet) is accepted [s]
)


class _AcceptedWriter(NamedTuple):
    rank: Stamp
    received_t: float


class EpochFence:
    """Accepted writer by UAV id; hides the brief double writing during a handover.

    Args:
        clock: any monotonic clock [s]
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._by_uav: dict[int, _AcceptedWriter] = {}

    def accepts(self, uav: int, stamp: Stamp | None) -> bool:
        """Return whether a result is accepted: no writer with a higher plausible claim wrote recently."""
        rank, now = stamp or Stamp(0, 0), self._clock()
        if not is_plausible_epoch(rank.epoch):
            return False
        current = self._by_uav.get(uav)
        if current is not None and rank < current.rank and now - current.received_t < WRITER_TIMEOUT_S:
            return False
        self._by_uav[uav] = _AcceptedWriter(rank, now)
        return True
