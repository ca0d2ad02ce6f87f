"""Keys, batches of samples, liveliness tokens, selection among replies, and the fence against a second writer."""

import re
import time
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

from fleet.access.roles import ROOT
from fleet.bus.codec import EncodedMessage, Stamp, decode, encode, encoding, is_plausible_epoch
from fleet.contract import PER_UAV, Sample, Samples

M = TypeVar("M")
RawMessage = tuple[int | None, bytes, str, Stamp | None]
"""UAV id of the key, payload, encoding, stamp."""
Replies = Iterable[tuple[Any, Stamp | None]]
QueryHandler = Callable[[int | None, dict[str, str], bytes], Replies]
MAX_BATCH_BYTES = 12_000  # of samples in one message: on congestion Zenoh drops a message as a whole


def key_of(kind: type, target: int | str) -> str:
    """Return the key of a message class: `parauav/7/sample`, `parauav/@fleet/state/{writer}`; `target` may be `*`."""
    topic: str = kind.topic  # type: ignore[attr-defined]
    return f"{ROOT}/{target}/{topic}" if kind in PER_UAV else f"{ROOT}/{topic}/{target}"


@lru_cache(maxsize=16_384)
def uav_of_key(key_name: str) -> int | None:
    """Parse the UAV id of a key; None where the chunk is a wildcard or not a number."""
    chunk = key_name.split("/")[1] if key_name.count("/") >= 2 else ""
    return int(chunk) if chunk.isdecimal() and len(chunk) <= 9 else None


def make_batches(samples: Iterable[EncodedMessage]) -> Iterator[bytes]:
    """Pack encoded samples of any aircraft, in order, as payloads of `Samples` of at most `MAX_BATCH_BYTES`."""
    batch: list[EncodedMessage] = []
    size = 0
    for sample in samples:
        if batch and size + len(sample.payload) > MAX_BATCH_BYTES:
            yield _pack_batch(batch)
            batch, size = [], 0
        batch.append(sample)
        size += len(sample.payload)
    if batch:
        yield _pack_batch(batch)


def _pack_batch(batch: list[EncodedMessage]) -> bytes:
    _, uavs, payloads, times = zip(*batch, strict=True)
    return encode(Samples(t=max(times), uavs=uavs, samples=payloads))


def split_batch(message: RawMessage) -> list[RawMessage]:
    """Split `Samples` as received into samples in order; one that does not decode remains as it is, for no aircraft."""
    _, payload, encoding_name, stamp = message
    try:
        batch = decode(Samples, payload, encoding_name)
    except ValueError:
        return [message]
    if len(batch.uavs) != len(batch.samples):
        return [message]
    sample_encoding = encoding(Sample)
    return [(uav, sample, sample_encoding, stamp) for uav, sample in zip(batch.uavs, batch.samples, strict=True)]


def select_latest(replies: list[tuple[M, Stamp | None]]) -> list[tuple[M, Stamp | None]]:
    """Select the reply of highest plausible epoch, then the newest, per UAV (and alert); keep all without a UAV."""
    pairs: dict[tuple[int, str], list[tuple[Any, Stamp | None]]] = {}
    without_uav = []
    for message, stamp in replies:
        uav = getattr(message, "uav", None)
        if uav is None:
            without_uav.append((message, stamp))
            continue
        if stamp is not None and not is_plausible_epoch(stamp.epoch):
            continue
        identity = uav, str(getattr(message, "about", ""))
        pairs.setdefault(identity, []).append((message, stamp))
    best = [max(pairs[identity], key=lambda pair: (pair[1] or Stamp(0, 0), pair[0].t)) for identity in sorted(pairs)]
    return best + without_uav


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


WRITER_TIMEOUT_S = 10.0  # a writer silent for this long loses its claim: a lower one is accepted [s]


class EpochFence:
    """Accepted writer by UAV id; hides the brief double writing during a handover.

    Args:
        clock: any monotonic clock [s]
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._by_uav: dict[int, tuple[Stamp, float]] = {}  # claim and time of its last result

    def accepts(self, uav: int, stamp: Stamp | None) -> bool:
        """Return whether a result is accepted: no writer with a higher plausible claim wrote recently."""
        rank, now = stamp or Stamp(0, 0), self._clock()
        if not is_plausible_epoch(rank.epoch):
            return False
        highest, received_t = self._by_uav.get(uav, (rank, now))
        if rank < highest and now - received_t < WRITER_TIMEOUT_S:
            return False
        self._by_uav[uav] = rank, now
        return True
