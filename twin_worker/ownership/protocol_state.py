"""Ownership state of one worker and its next actions, with rendezvous hashing; without bus, thread or clock.

A worker knows the others by their liveliness tokens and their aircraft by their announcements. Rendezvous hashing
assigns each aircraft to one live worker. That worker requests a snapshot from a live owner, and acquires aircraft
without a live owner. Every acquisition raises the aircraft's epoch; of two publishers, the higher `FencingToken` is
valid for readers and for both workers. The previous owner publishes until it receives the higher claim, so that
predictions continue.

A worker with a token is live, however late its announcements arrive. The router withdraws the token of a frozen or
disconnected process when its lease expires. A process with little CPU time keeps its token, since session keep-alives
need almost none. A worker with a token but without announcements for `SILENT_S`, while others announce, counts as dead.

    unsynchronised  after a pause, and without a router: publishes and claims nothing until it has queried the claims
                    of the others
    settling        for a while after the router reconnects: claims nothing, because tokens arrive one by one and a
                    worker whose token is still in transit would count as dead
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import blake2b
from typing import NamedTuple

import numpy as np

_GOLDEN, _MIX = np.uint64(0x9E3779B97F4A7C15), (np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB))
_S30, _S27, _S31 = np.uint64(30), np.uint64(27), np.uint64(31)


def owners(uavs: Iterable[int], workers: Mapping[str, range]) -> dict[int, str]:
    """Return the assigned worker of each aircraft; an id outside every range has none.

    If a worker leaves, only its own aircraft move; if one joins, it only acquires: all other assignments stay.

    Args:
        uavs: ids
        workers: id range of every live worker, by name
    Source: Thaler and Ravishankar 1998, highest random weight.
    """
    ids = np.fromiter(uavs, np.int64)
    names = sorted(workers)  # deterministic tie-break by name
    if not len(ids) or not names:
        return {}
    low = np.array([[workers[name].start] for name in names])
    high = np.array([[workers[name].stop] for name in names])
    allowed = (low <= ids) & (ids < high)
    salt = np.array([[_number(name)] for name in names], np.uint64)
    weight = np.where(allowed, _mixed(_mixed(ids.astype(np.uint64)) ^ salt), np.uint64(0))
    best = weight.argmax(axis=0)
    return {int(ids[k]): names[best[k]] for k in np.flatnonzero(allowed.any(axis=0))}


def owner(uav: int, workers: Mapping[str, range]) -> str | None:
    """Return the assigned worker of one aircraft; None outside every range."""
    return owners([uav], workers).get(uav)


@lru_cache(maxsize=1024)
def _number(name: str) -> int:
    return int.from_bytes(blake2b(name.encode(), digest_size=8).digest(), "big")


def _mixed(x: np.ndarray) -> np.ndarray:
    """Mix 64 bits so that each output bit depends on all input bits.

    Source: Steele, Lea and Flood 2014, SplitMix64.
    """
    with np.errstate(over="ignore"):
        x = x + _GOLDEN
        x = (x ^ (x >> _S30)) * _MIX[0]
        x = (x ^ (x >> _S27)) * _MIX[1]
    return x ^ (x >> _S31)


PAUSE_S = 0.8  # a worker that paused longer may have been replaced [s]
CLAIM_DELAY_S = 2.5  # from reconnection to the first claim: tokens arrive late on a busy machine [s]
# Without an announcement from a worker with a token while others announce [s]. An overloaded machine was measured to
# stop all threads of a live process for up to 10.3 s; a frozen or disconnected one loses its token much earlier.
SILENT_S = 20.0
_MAX_SILENCE_STEP_S = 0.3  # maximum silence counted between two ticks; a delayed tick is not silence of others [s]


class FencingToken(NamedTuple):
    """A claim on one aircraft; the greater one is valid: by epoch, then by worker name."""

    epoch: int
    worker: str


class Peer(NamedTuple):
    """Another live worker."""

    ids: range
    incarnation: int
    leaving: bool = False


@dataclass
class OwnershipPlan:
    """Next actions: aircraft to acquire at once, and aircraft to request from their owners."""

    acquire: list[int] = field(default_factory=list)
    request: dict[str, list[int]] = field(default_factory=dict)
    valid: bool = field(default=False, compare=False)  # false: no claims are allowed now


class OwnershipState:
    """Ownership state of one worker.

    Args:
        worker_id: its name
        ids: UAV ids this worker may own
    """

    def __init__(self, worker_id: str, ids: range) -> None:
        self.worker_id, self.ids = worker_id, ids
        self.owned: dict[int, int] = {}  # epoch by UAV id
        self.highest: dict[int, FencingToken] = {}  # highest claim on each id in range, own claims included
        self.peers: dict[str, Peer] = {}
        self.known: set[int] = set()  # ids in range that were seen
        self.leaving = False
        self.unsynchronised = True
        self._superseded: set[int] = set()  # ids that a live worker claims below the claim of one that is gone
        self.receiving = False  # anything received since the last tick
        self._received_t = float("-inf")  # tick of the last reception
        self._silence: dict[str, float] = {}  # of each peer [s]
        self._settled_t = float("-inf")
        self._tick_t = float("nan")
        self._assignments: tuple[object, dict[int, str]] = ((), {})  # inputs of the last assignment, and its result

    # --- reception ---------------------------------------------------------------------------------------------------

    def on_join(self, worker: str, ids: range, incarnation: int) -> None:
        """Add a worker with a token."""
        previous = self.peers.get(worker)
        if worker != self.worker_id and (previous is None or previous.incarnation <= incarnation):
            leaving = previous is not None and previous.incarnation == incarnation and previous.leaving
            self.peers[worker] = Peer(ids, incarnation, leaving)
            self._silence[worker] = 0.0

    def on_leave(self, worker: str, incarnation: int) -> None:
        """Remove a worker whose token ended; tokens of earlier incarnations are ignored."""
        previous = self.peers.get(worker)
        if previous is not None and previous.incarnation <= incarnation:
            del self.peers[worker], self._silence[worker]

    def on_claim(self, worker: str, claimed: Mapping[int, int], leaving: bool = False) -> list[int]:
        """Process an announcement with epochs by UAV id; return the aircraft lost to a higher claim."""
        peer = self.peers.get(worker)
        if peer is not None:
            self.peers[worker] = peer._replace(leaving=leaving)
            self._silence[worker] = 0.0
        self.receiving = True
        lost = []
        for uav, epoch in claimed.items():
            token = FencingToken(epoch, worker)
            self.record(uav, token)
            if uav in self.highest and token < self.highest[uav] and not self.is_live(self.highest[uav].worker):
                self._superseded.add(uav)
            if uav in self.owned and worker != self.worker_id and token > FencingToken(self.owned[uav], self.worker_id):
                del self.owned[uav]
                lost.append(uav)
        return lost

    def superseding_claims(self) -> dict[int, FencingToken]:
        """Return the claims that readers still prefer to those announced since the last call, by UAV id.

        A worker that was disconnected may have missed the last claim of one that is gone; it then claims anew.
        """
        claims = {uav: self.highest[uav] for uav in self._superseded if uav in self.highest}
        self._superseded.clear()
        return claims

    def record(self, uav: int, token: FencingToken) -> None:
        """Record a claim of another worker, e.g. from its results; owned aircraft stay owned."""
        if uav not in self.ids or token.worker == self.worker_id:
            return
        self.known.add(uav)
        self.highest[uav] = max(token, self.highest.get(uav, token))

    # --- time --------------------------------------------------------------------------------------------------------

    def tick(self, now: float, connected: bool) -> None:
        """Update the clock (monotonic [s]) and the router state; call several times per `PAUSE_S`."""
        if now - self._tick_t > PAUSE_S:
            self.unsynchronised = True
        if not connected:
            self.unsynchronised, self._settled_t = True, now + CLAIM_DELAY_S
        self._tick_t = now
        if self.receiving:
            step, self._received_t, self.receiving = min(now - self._received_t, _MAX_SILENCE_STEP_S), now, False
            self._silence = {worker: silence + step for worker, silence in self._silence.items()}

    def is_live(self, worker: str) -> bool:
        """Return whether another worker has a token and announces."""
        return self._silence.get(worker, float("inf")) <= SILENT_S

    def may_write(self, now: float) -> bool:
        """Return whether results may be published now."""
        return not self.unsynchronised and now - self._tick_t <= PAUSE_S

    def resynchronise(self, wall_ms: int) -> None:
        """Continue after a query of all claims: claim again what is owned without the highest claim."""
        self.unsynchronised = False
        for uav, epoch in list(self.owned.items()):
            if self.highest[uav] != FencingToken(epoch, self.worker_id):
                self.acquire(uav, wall_ms)

    def drop_future_epochs(self, latest_ms: int, wall_ms: int) -> dict[int, int]:
        """Drop claims above the latest valid epoch; return owned aircraft claimed again, with their new epochs."""
        if any(token.epoch > latest_ms for token in self.highest.values()):
            self.highest = {uav: rank for uav, rank in self.highest.items() if rank.epoch <= latest_ms}
        return {uav: self.acquire(uav, wall_ms) for uav in [uav for uav in self.owned if uav not in self.highest]}

    # --- decisions ---------------------------------------------------------------------------------------------------

    def plan(self, now: float) -> OwnershipPlan:
        """Return the aircraft this worker should own and does not."""
        plan = OwnershipPlan()
        if self.leaving or not self.may_write(now) or now < self._settled_t:
            return plan
        plan.valid = True
        for uav, epoch in self.owned.items():
            token = self.highest[uav]
            if token > FencingToken(epoch, self.worker_id) and not self.is_live(token.worker):
                plan.acquire.append(uav)
        inputs = self.known - self.owned.keys(), {self.worker_id: self.ids} | self.successors()
        if inputs != self._assignments[0]:  # rarely
            self._assignments = inputs, owners(sorted(inputs[0]), inputs[1])
        for uav, assigned in self._assignments[1].items():
            if assigned != self.worker_id:
                continue
            claim = self.highest.get(uav)
            if claim is not None and self.is_live(claim.worker):
                plan.request.setdefault(claim.worker, []).append(uav)
            else:
                plan.acquire.append(uav)
        return plan

    def successors(self) -> dict[str, range]:
        """Return the id ranges of the other live workers that are not leaving."""
        return {name: peer.ids for name, peer in self.peers.items() if self.is_live(name) and not peer.leaving}

    def acquire(self, uav: int, wall_ms: int) -> int:
        """Acquire an aircraft; return its epoch, above every known one and not below the clock's."""
        self.known.add(uav)
        previous = self.highest[uav].epoch if uav in self.highest else 0
        epoch = self.owned[uav] = max(previous + 1, wall_ms)
        self.highest[uav] = FencingToken(epoch, self.worker_id)
        return epoch
