"""Ownership state of one worker, and its next actions; without bus, thread or clock.

A worker knows the others by their liveliness tokens and their aircraft by their announcements. Rendezvous hashing
assigns each aircraft to one live worker. That worker requests a snapshot from a live owner, and acquires aircraft
without a live owner. Every acquisition raises the aircraft's epoch; of two publishers, the higher `FencingToken` is
valid for readers and for both workers. The previous owner publishes until it receives the higher claim, so that
predictions continue.

A worker with a token is live, however late its announcements arrive. The router withdraws the token of a frozen or
disconnected process when its lease expires. A process with little CPU time keeps its token, since session keep-alives
need almost none. A worker with a token but without announcements for seconds, while others announce, counts as dead.

    unsynchronised  after a pause, and without a router: publishes and claims nothing until it has queried the claims
                    of the others
    settling        for a while after the router reconnects: claims nothing, because tokens arrive one by one and a
                    worker whose token is still in transit would count as dead
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from twin_worker.ownership.rendezvous import owners

PAUSE_S = 0.8  # a worker that paused longer may have been replaced [s]
SETTLE_S = 2.5  # from reconnection to the first claim: tokens arrive late on a busy machine [s]
SILENT_S = 5.0  # without an announcement from a worker with a token while others announce; above any usual delay [s]
_STEP_S = 0.3  # maximum silence counted between two ticks; a delayed tick is not silence of others [s]


class Rank(NamedTuple):
    """A claim on one aircraft; the greater one is valid: by epoch, then by worker name."""

    epoch: int
    worker: str


class Peer(NamedTuple):
    """Another live worker."""

    ids: range
    incarnation: int
    leaving: bool = False


@dataclass
class Plan:
    """Next actions: aircraft to acquire at once, and aircraft to request from their owners."""

    take: list[int] = field(default_factory=list)
    ask: dict[str, list[int]] = field(default_factory=dict)
    sure: bool = field(default=False, compare=False)  # false: no claims are allowed now


class Claims:
    """Ownership state of one worker.

    Args:
        worker_id: its name
        ids: UAV ids this worker may own
    """

    def __init__(self, me: str, ids: range) -> None:
        self.me, self.ids = me, ids
        self.held: dict[int, int] = {}  # epoch by UAV id
        self.seen: dict[int, Rank] = {}  # highest claim on each id in range, own claims included
        self.peers: dict[str, Peer] = {}
        self.known: set[int] = set()  # ids in range that were seen
        self.leaving = False
        self.unsure = True
        self.hears = False  # anything received since the last tick
        self._heard = float("-inf")  # tick of the last reception
        self._silence: dict[str, float] = {}  # of each peer [s]
        self._settled = float("-inf")
        self._ticked = float("nan")
        self._weighed: tuple[object, dict[int, str]] = ((), {})  # inputs of the last assignment, and its result

    # --- reception ---------------------------------------------------------------------------------------------------

    def appeared(self, worker: str, ids: range, incarnation: int) -> None:
        """Add a worker with a token."""
        old = self.peers.get(worker)
        if worker != self.me and (old is None or old.incarnation <= incarnation):
            leaving = old is not None and old.incarnation == incarnation and old.leaving
            self.peers[worker] = Peer(ids, incarnation, leaving)
            self._silence[worker] = 0.0

    def vanished(self, worker: str, incarnation: int) -> None:
        """Remove a worker whose token ended; tokens of earlier incarnations are ignored."""
        old = self.peers.get(worker)
        if old is not None and old.incarnation <= incarnation:
            del self.peers[worker], self._silence[worker]

    def heard(self, worker: str, held: Mapping[int, int], leaving: bool = False) -> list[int]:
        """Process an announcement with epochs by UAV id; return the aircraft lost to a higher claim."""
        peer = self.peers.get(worker)
        if peer is not None:
            self.peers[worker] = peer._replace(leaving=leaving)
            self._silence[worker] = 0.0
        self.hears = True
        lost = []
        for uav, epoch in held.items():
            rank = Rank(epoch, worker)
            self.note(uav, rank)
            if uav in self.held and worker != self.me and rank > Rank(self.held[uav], self.me):
                del self.held[uav]
                lost.append(uav)
        return lost

    def note(self, uav: int, rank: Rank) -> None:
        """Record a claim of another worker, e.g. from its results; owned aircraft stay owned."""
        if uav not in self.ids or rank.worker == self.me:
            return
        self.known.add(uav)
        self.seen[uav] = max(rank, self.seen.get(uav, rank))

    # --- time --------------------------------------------------------------------------------------------------------

    def tick(self, now: float, in_sight: bool) -> None:
        """Update the clock (monotonic [s]) and the router state; call several times per `PAUSE_S`."""
        if now - self._ticked > PAUSE_S:
            self.unsure = True
        if not in_sight:
            self.unsure, self._settled = True, now + SETTLE_S
        self._ticked = now
        if self.hears:
            step, self._heard, self.hears = min(now - self._heard, _STEP_S), now, False
            self._silence = {worker: silence + step for worker, silence in self._silence.items()}

    def lives(self, worker: str) -> bool:
        """Return whether another worker has a token and announces."""
        return self._silence.get(worker, float("inf")) <= SILENT_S

    def may_write(self, now: float) -> bool:
        """Return whether results may be published now."""
        return not self.unsure and now - self._ticked <= PAUSE_S

    def synced(self, wall_ms: int) -> None:
        """Continue after a query of all claims: claim again what is owned without the highest claim."""
        self.unsure = False
        for uav, epoch in list(self.held.items()):
            if self.seen[uav] != Rank(epoch, self.me):
                self.take(uav, wall_ms)

    def timely(self, latest_ms: int, wall_ms: int) -> dict[int, int]:
        """Drop claims above the latest valid epoch; return owned aircraft claimed again, with their new epochs."""
        if any(rank.epoch > latest_ms for rank in self.seen.values()):
            self.seen = {uav: rank for uav, rank in self.seen.items() if rank.epoch <= latest_ms}
        return {uav: self.take(uav, wall_ms) for uav in [uav for uav in self.held if uav not in self.seen]}

    # --- decisions ---------------------------------------------------------------------------------------------------

    def plan(self, now: float) -> Plan:
        """Return the aircraft this worker should own and does not."""
        plan = Plan()
        if not self._ready(now):
            return plan
        plan.sure = True
        plan.take += [uav for uav, epoch in self.held.items() if self._outdone(uav, epoch)]
        asked = self.known - self.held.keys(), self._candidates()
        if asked != self._weighed[0]:  # rarely
            self._weighed = asked, owners(sorted(asked[0]), asked[1])
        for uav, who in self._weighed[1].items():
            if who != self.me:
                continue
            holder = self._holder(uav)
            if holder is None:
                plan.take.append(uav)
            else:
                plan.ask.setdefault(holder, []).append(uav)
        return plan

    def _ready(self, now: float) -> bool:
        return not self.leaving and self.may_write(now) and now >= self._settled

    def _outdone(self, uav: int, epoch: int) -> bool:
        """Return whether a dead worker has a higher claim on an owned aircraft."""
        rank = self.seen[uav]
        return rank > Rank(epoch, self.me) and not self.lives(rank.worker)

    def _candidates(self) -> dict[str, range]:
        return {self.me: self.ids} | self.heirs()

    def heirs(self) -> dict[str, range]:
        """Return the id ranges of the other live workers that are not leaving."""
        return {name: peer.ids for name, peer in self.peers.items() if self.lives(name) and not peer.leaving}

    def _holder(self, uav: int) -> str | None:
        """Return the live owner of an aircraft; None if there is none."""
        rank = self.seen.get(uav)
        return rank.worker if rank is not None and self.lives(rank.worker) else None

    def take(self, uav: int, wall_ms: int) -> int:
        """Acquire an aircraft; return its epoch, above every known one and not below the clock's."""
        self.known.add(uav)
        before = self.seen[uav].epoch if uav in self.seen else 0
        epoch = self.held[uav] = max(before + 1, wall_ms)
        self.seen[uav] = Rank(epoch, self.me)
        return epoch
