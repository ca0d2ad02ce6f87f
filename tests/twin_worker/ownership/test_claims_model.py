"""A fleet of workers that join, leave, die, freeze and are cut off, in every order: who holds what, and who is read.

The world is made up: a router that knows tokens and passes messages on in order, as late as it likes; clocks that are
wrong by minutes; readers. Every worker is `Claims`, driven as `twin_worker/ownership/protocol.py` drives it.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from fleet.bus.bus_protocol import WRITER_TIMEOUT_S, EpochFence
from fleet.bus.codec import Stamp
from twin_worker.ownership.protocol_state import CLAIM_DELAY_S, PAUSE_S, SILENT_S, FencingToken, OwnershipState, owners

UAVS = range(5)
RANGES = (range(5), range(3), range(2, 5))
LEASE_S, TURN_S, ANNOUNCE_S, HAND_S = 1.6, 0.1, 0.25, 3.0  # a lease of 1 s is over later


@dataclass
class Node:
    """One worker process and its link."""

    claims: OwnershipState
    skew_ms: int
    born: int
    inbox: deque[Callable[[], None]] = field(default_factory=deque)  # on its way, in order
    link: bool = True
    frozen: bool = False
    silent_s: float = 0.0  # since the router last heard of it
    token: bool = False  # known to the router
    said: float = -1.0
    asked: dict[int, float] = field(default_factory=dict)  # handovers that are waited for: until when

    @property
    def sees(self) -> bool:
        return self.link and not self.frozen


class Fleet(RuleBasedStateMachine):
    """Workers, router, readers."""

    @initialize()
    def begin(self) -> None:
        self.now, self.count = 100.0, 0
        self.nodes: dict[str, Node] = {}
        self.calm = False  # nothing has happened since there was peace
        self.fence = EpochFence(lambda: self.now)
        self.ranks: dict[int, set[FencingToken]] = {uav: set() for uav in UAVS}  # ever taken
        self.accepted: dict[int, tuple[Stamp, float]] = {}

    # --- what happens to workers -------------------------------------------------------------------------------------

    @precondition(lambda self: len(self.nodes) < 4)
    @rule(ids=st.sampled_from(RANGES), skew_s=st.sampled_from((0, 0, -300, 300)))
    def join(self, ids: range, skew_s: int) -> None:
        self.calm = False
        self.count += 1
        name = f"{self.count:016x}"
        node = self.nodes[name] = Node(OwnershipState(name, ids), 1000 * skew_s, self.count)
        node.claims.known.update(uav for uav in UAVS if uav in ids)
        self._connect(node)
        self._turn(node)

    @precondition(lambda self: self.nodes)
    @rule(data=st.data())
    def die(self, data: st.DataObject) -> None:
        self.calm = False
        name = data.draw(st.sampled_from(sorted(self.nodes)))
        node = self.nodes.pop(name)
        if node.token:  # of one that was cut off, too: its lease is over soon
            self._forget(node)

    @precondition(lambda self: self.nodes)
    @rule(data=st.data())
    def freeze_or_thaw(self, data: st.DataObject) -> None:
        self.calm = False
        node = self.nodes[data.draw(st.sampled_from(sorted(self.nodes)))]
        node.frozen = not node.frozen

    @precondition(lambda self: self.nodes)
    @rule(data=st.data())
    def cut_or_heal(self, data: st.DataObject) -> None:
        self.calm = False
        self._plug(self.nodes[data.draw(st.sampled_from(sorted(self.nodes)))])

    @rule()
    def restart_the_router(self) -> None:
        """Cut everyone off for a moment; where nothing else was amiss nobody's aircraft become another's."""
        before = self._taken() if self.calm else None
        self._restart()
        if before is not None:
            self._pass_time(int((CLAIM_DELAY_S + 1.0) / TURN_S))
            assert self._taken() == before
            self.calm = True

    def _restart(self) -> None:
        cut = [node for node in self.nodes.values() if node.link]
        for node in cut:
            self._plug(node)
        self._pass_time(3)
        for node in cut:  # one after the other, so that who is first finds nobody
            self._plug(node)
            self._pass_time(2)

    @precondition(lambda self: self.nodes)
    @rule(data=st.data())
    def leave(self, data: st.DataObject) -> None:
        self.calm = False
        self.nodes[data.draw(st.sampled_from(sorted(self.nodes)))].claims.leaving = True

    @rule(turns=st.integers(1, 15), late=st.integers(0, 3))
    def time_passes(self, turns: int, late: int) -> None:
        self._pass_time(turns, late)

    # --- what must hold ----------------------------------------------------------------------------------------------

    @invariant()
    def nobody_holds_what_it_may_not(self) -> None:
        for node in getattr(self, "nodes", {}).values():
            assert all(uav in node.claims.ids for uav in node.claims.owned)

    @rule()
    def peace_comes(self) -> None:
        """With everyone awake and connected there is one holder of each, the owner, and it is whom readers believe."""
        for node in self.nodes.values():
            node.frozen = False
            if not node.link:
                self._plug(node)
        self._pass_time(int((CLAIM_DELAY_S + LEASE_S + 3.0) / TURN_S))
        for node in [node for node in self.nodes.values() if node.claims.leaving]:
            others = [other.claims.ids for other in self.nodes.values() if not other.claims.leaving]
            left = [uav for uav in node.claims.owned if any(uav in ids for ids in others)]
            assert not left, "a leaver hands everything over"
            del self.nodes[node.claims.worker_id]
            self._forget(node)
        self._pass_time(10)
        self._who_is_known_of_is_outdone()
        self.now += WRITER_TIMEOUT_S  # everyone stands still for so long
        self._pass_time(10)
        self.calm = True
        live = {name: node.claims.ids for name, node in self.nodes.items()}
        expected = owners(UAVS, live)
        for uav in UAVS:
            holders = [name for name, node in self.nodes.items() if uav in node.claims.owned]
            assert holders == [expected[uav]] if uav in expected else not holders
            if uav in expected:
                stamp, heard = self.accepted[uav]
                assert self.now - heard < 0.5, "the holder is read"
                assert stamp == Stamp(self.nodes[expected[uav]].claims.owned[uav], int(expected[uav], 16))

    def _who_is_known_of_is_outdone(self) -> None:
        """Hold that readers need not wait where any worker knows the claim they believe."""
        for name, node in self.nodes.items():
            for uav, epoch in node.claims.owned.items():
                stamp, _ = self.accepted.get(uav, (Stamp(0, 0), 0.0))
                believed = FencingToken(stamp.epoch, f"{stamp.writer:016x}")
                if any(other.claims.highest.get(uav, FencingToken(0, "")) >= believed for other in self.nodes.values()):
                    assert stamp == Stamp(epoch, int(name, 16))

    def _taken(self) -> int:
        return sum(len(ranks) for ranks in self.ranks.values())

    # --- the world ---------------------------------------------------------------------------------------------------

    def _pass_time(self, turns: int, late: int = 0) -> None:
        """Let time pass; messages are delivered so many turns late."""
        self.calm = self.calm and not late
        for turn in range(turns):
            self.now += TURN_S
            for node in list(self.nodes.values()):
                node.silent_s = 0.0 if node.sees else node.silent_s + TURN_S
                if node.token and node.silent_s >= LEASE_S:
                    self._forget(node)
                if node.frozen:
                    continue
                node.claims.receiving |= node.link  # telemetry
                if node.link and not node.token:
                    self._connect(node)
                if turn >= late:
                    for _ in range(len(node.inbox)):
                        node.inbox.popleft()()
                self._turn(node)
            self._write()

    def _plug(self, node: Node) -> None:
        """Cut a link or mend it; what was on its way is lost, and who is cut off sees all tokens go."""
        node.link = not node.link
        node.inbox.clear()
        node.asked.clear()
        if node.link and node.token:  # sooner than the router missed it: its session is another all the same
            self._forget(node)
        if not node.link:
            self._lose_sight(node)

    def _lose_sight(self, node: Node) -> None:
        for name, peer in list(node.claims.peers.items()):
            node.claims.on_leave(name, peer.incarnation)

    def _connect(self, node: Node) -> None:
        node.token, node.silent_s = True, 0.0
        for other in self.nodes.values():
            if other is not node and other.token:
                self._send(other, lambda o=other: o.claims.on_join(node.claims.worker_id, node.claims.ids, node.born))
                self._send(node, lambda o=other: node.claims.on_join(o.claims.worker_id, o.claims.ids, o.born))

    def _forget(self, node: Node) -> None:
        """End a session at the router: its token goes, and it has to connect anew."""
        node.token = False
        node.inbox.clear()
        self._lose_sight(node)
        for other in self.nodes.values():
            if other is not node:
                self._send(other, lambda o=other: o.claims.on_leave(node.claims.worker_id, node.born))

    def _send(self, to: Node, act: Callable[[], None]) -> None:
        if to.link and to.token:
            to.inbox.append(act)

    # --- one worker, as the protocol drives it -----------------------------------------------------------------------

    def _turn(self, node: Node) -> None:
        claims = node.claims
        claims.tick(self.now, node.sees)
        if not node.sees:
            return
        if claims.unsynchronised:
            self._synchronise(node)
        waiting = {uav for uav, until in node.asked.items() if until > self.now}
        plan = claims.plan(self.now)
        for worker, uavs in plan.request.items():
            for uav in set(uavs) - waiting:
                if uav in node.asked:  # in vain
                    self._take(node, uav)
                    continue
                node.asked[uav] = self.now + HAND_S
                holder = self.nodes.get(worker)
                if holder is not None:
                    self._send(holder, lambda h=holder, u=uav: self._hand_over(h, node, u))
        for uav in plan.acquire:
            self._take(node, uav)
        if plan.acquire or self.now - node.said >= ANNOUNCE_S:
            node.said = self.now
            held, leaving, known = dict(claims.owned), claims.leaving, claims.superseding_claims()
            for other in self.nodes.values():
                if other is not node:
                    self._send(other, lambda o=other: self._hear(o, claims.worker_id, held, leaving, known))

    def _hear(
        self, node: Node, worker: str, held: dict[int, int], leaving: bool, known: dict[int, FencingToken]
    ) -> None:
        node.claims.on_claim(worker, held, leaving)
        for uav, rank in known.items():
            node.claims.record(uav, rank)

    def _synchronise(self, node: Node) -> None:
        for other in self.nodes.values():
            if other is not node and other.sees and other.token:
                node.claims.on_claim(other.claims.worker_id, other.claims.owned, other.claims.leaving)
                for uav, rank in other.claims.highest.items():
                    node.claims.record(uav, rank)
        before = dict(node.claims.owned)
        node.claims.resynchronise(self._wall(node))
        for uav, epoch in node.claims.owned.items():
            if before[uav] != epoch:
                self._unheard_of(node, uav)

    def _take(self, node: Node, uav: int) -> None:
        assert node.sees, "nobody claims anything without a router in sight"
        node.asked.pop(uav, None)
        node.claims.acquire(uav, self._wall(node))
        self._unheard_of(node, uav)

    def _unheard_of(self, node: Node, uav: int) -> None:
        """Hold that no claim is made twice."""
        rank = FencingToken(node.claims.owned[uav], node.claims.worker_id)
        assert rank not in self.ranks[uav]
        self.ranks[uav].add(rank)

    def _hand_over(self, holder: Node, asker: Node, uav: int) -> None:
        epoch = holder.claims.owned.get(uav)
        if epoch is not None:
            self._send(asker, lambda: self._receive(asker, holder, uav, epoch))

    def _receive(self, asker: Node, holder: Node, uav: int, epoch: int) -> None:
        if uav in asker.asked:
            asker.claims.record(uav, FencingToken(epoch, holder.claims.worker_id))
            self._take(asker, uav)

    def _wall(self, node: Node) -> int:
        return 1_700_000_000_000 + int(1000 * self.now) + node.skew_ms

    def _write(self) -> None:
        """Let everyone write what it may; readers see no claim fall while the higher one still speaks."""
        for name, node in self.nodes.items():
            if not node.sees or not node.claims.may_write(self.now):
                continue
            for uav, epoch in node.claims.owned.items():
                stamp = Stamp(epoch, int(name, 16))
                for other in self.nodes.values():
                    if other is not node:
                        self._send(
                            other, lambda o=other, u=uav, e=epoch, n=name: o.claims.record(u, FencingToken(e, n))
                        )
                if self.fence.accepts(uav, stamp):
                    before, heard = self.accepted.get(uav, (Stamp(0, 0), 0.0))
                    assert stamp >= before or self.now - heard >= WRITER_TIMEOUT_S
                    self.accepted[uav] = stamp, self.now


def test_a_pause_is_noticed_before_others_notice_it() -> None:
    """Who stood still for long enough to pass for dead must know it before it writes again."""
    assert min(LEASE_S, SILENT_S) > PAUSE_S


TestFleet = Fleet.TestCase
TestFleet.settings = settings(
    max_examples=150,
    stateful_step_count=25,
    phases=(Phase.explicit, Phase.generate),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)
