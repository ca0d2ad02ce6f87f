"""What one worker holds and what it does next: the claim protocol without bus, thread or clock.

A worker knows the others by their liveliness tokens and what they hold by their announcements. An aircraft belongs to
its `owner`. The owner asks a live holder for a copy of its twin, and takes what nobody live holds. Every taking raises
the aircraft's epoch; of two writers the higher `Rank` is believed, by readers and by both: who held it before goes on
writing until it hears of the higher claim, so that nobody waits.

Who has a token lives, however late its announcements come. The router withdraws the token of a process that is frozen
or cut off when its lease is over; a process that is given little CPU time keeps it, since the keep-alives of its
session need next to none. Who has a token and announces nothing for seconds, while others do, passes for dead, too.

    unsure    after a pause, and with no router in sight: writes nothing and claims nothing until it has asked the
              others what they hold
    settling  for a while after the router came back into sight: claims nothing, since the others' tokens come one
              by one and whoever is still on the way would pass for dead
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from twin_worker.ownership.rendezvous import owners

PAUSE_S = 0.8  # a worker that stood still for longer may have been replaced [s]
SETTLE_S = 2.5  # after the router came back, before anything is claimed: on a busy machine tokens come late [s]
SILENT_S = 5.0  # without a word of a worker whose token stands, while others are heard: longer than any lateness [s]
_STEP_S = 0.3  # of silence counted between two ticks at most: what was late itself hears no silence [s]


class Rank(NamedTuple):
    """A claim on one aircraft; the greater wins: by epoch, then by name."""

    epoch: int
    worker: str


class Peer(NamedTuple):
    """Another live worker."""

    ids: range
    incarnation: int
    leaving: bool = False


@dataclass
class Plan:
    """What is to be done next: take these at once; ask these workers for those."""

    take: list[int] = field(default_factory=list)
    ask: dict[str, list[int]] = field(default_factory=dict)
    sure: bool = field(default=False, compare=False)  # false: nothing may be claimed just now, whatever is missing


class Claims:
    """The claims of one worker.

    Args:
        me: its name
        ids: what it may hold
    """

    def __init__(self, me: str, ids: range) -> None:
        self.me, self.ids = me, ids
        self.held: dict[int, int] = {}  # epoch by UAV id
        self.seen: dict[int, Rank] = {}  # the highest claim on each id of ours, mine among them
        self.peers: dict[str, Peer] = {}
        self.known: set[int] = set()  # ids of ours that were heard of
        self.leaving = False
        self.unsure = True
        self.hears = False  # anything was heard since the last tick
        self._heard = float("-inf")  # tick at which that was so last
        self._silence: dict[str, float] = {}  # of each peer [s]
        self._settled = float("-inf")
        self._ticked = float("nan")
        self._weighed: tuple[object, dict[int, str]] = ((), {})  # owners of what is missing, and for whom and what

    # --- what is heard -----------------------------------------------------------------------------------------------

    def appeared(self, worker: str, ids: range, incarnation: int) -> None:
        """Take the token of a worker."""
        old = self.peers.get(worker)
        if worker != self.me and (old is None or old.incarnation <= incarnation):
            leaving = old is not None and old.incarnation == incarnation and old.leaving
            self.peers[worker] = Peer(ids, incarnation, leaving)
            self._silence[worker] = 0.0

    def vanished(self, worker: str, incarnation: int) -> None:
        """Take the end of a token; one of an earlier life says nothing."""
        old = self.peers.get(worker)
        if old is not None and old.incarnation <= incarnation:
            del self.peers[worker], self._silence[worker]

    def heard(self, worker: str, held: Mapping[int, int], leaving: bool = False) -> list[int]:
        """Take an announcement: epochs by UAV id; return what is lost to a higher claim."""
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
        """Remember a claim of another's, as one met in its results; it takes nothing that is held."""
        if uav not in self.ids or rank.worker == self.me:
            return
        self.known.add(uav)
        self.seen[uav] = max(rank, self.seen.get(uav, rank))

    # --- time --------------------------------------------------------------------------------------------------------

    def tick(self, now: float, in_sight: bool) -> None:
        """Look at the clock (monotonic [s]) and for the router; to be called several times in `PAUSE_S`."""
        if now - self._ticked > PAUSE_S:
            self.unsure = True
        if not in_sight:
            self.unsure, self._settled = True, now + SETTLE_S
        self._ticked = now
        if self.hears:
            step, self._heard, self.hears = min(now - self._heard, _STEP_S), now, False
            self._silence = {worker: silence + step for worker, silence in self._silence.items()}

    def lives(self, worker: str) -> bool:
        """Return whether another worker has a token and speaks."""
        return self._silence.get(worker, float("inf")) <= SILENT_S

    def may_write(self, now: float) -> bool:
        """Return whether results may be published now."""
        return not self.unsure and now - self._ticked <= PAUSE_S

    def synced(self, wall_ms: int) -> None:
        """Go on after everyone was asked: what is held under a claim that is no longer the highest is claimed anew."""
        self.unsure = False
        for uav, epoch in list(self.held.items()):
            if self.seen[uav] != Rank(epoch, self.me):
                self.take(uav, wall_ms)

    def timely(self, latest_ms: int, wall_ms: int) -> dict[int, int]:
        """Forget claims above the latest epoch there may be; return what is held under one, with its new epoch."""
        if any(rank.epoch > latest_ms for rank in self.seen.values()):
            self.seen = {uav: rank for uav, rank in self.seen.items() if rank.epoch <= latest_ms}
        return {uav: self.take(uav, wall_ms) for uav in [uav for uav in self.held if uav not in self.seen]}

    # --- what to do --------------------------------------------------------------------------------------------------

    def plan(self, now: float) -> Plan:
        """Return what this worker should hold and does not."""
        plan = Plan()
        if not self._ready(now):
            return plan
        plan.sure = True
        plan.take += [uav for uav, epoch in self.held.items() if self._outdone(uav, epoch)]
        asked = self.known - self.held.keys(), self._candidates()
        if asked != self._weighed[0]:  # as it seldom is
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
        """Return whether readers believe one that is no more, which took what is held here before it said so."""
        rank = self.seen[uav]
        return rank > Rank(epoch, self.me) and not self.lives(rank.worker)

    def _candidates(self) -> dict[str, range]:
        return {self.me: self.ids} | self.heirs()

    def heirs(self) -> dict[str, range]:
        """Return what the other workers that live and stay may hold."""
        return {name: peer.ids for name, peer in self.peers.items() if self.lives(name) and not peer.leaving}

    def _holder(self, uav: int) -> str | None:
        """Return the live worker that is known to hold an aircraft; None where it is free."""
        rank = self.seen.get(uav)
        return rank.worker if rank is not None and self.lives(rank.worker) else None

    def take(self, uav: int, wall_ms: int) -> int:
        """Hold an aircraft from now on; return the epoch, which is above every one seen and not below the clock's."""
        self.known.add(uav)
        before = self.seen[uav].epoch if uav in self.seen else 0
        epoch = self.held[uav] = max(before + 1, wall_ms)
        self.seen[uav] = Rank(epoch, self.me)
        return epoch
