"""The claim protocol on the bus: tokens, announcements, handovers; `Claims` decides, a `Keeper` keeps the twins.

every 0.1 s, and at once when a token comes or goes or an aircraft is heard of that nobody holds
unsure     ask everyone what they hold (`Claim`), then go on
ask        the live holder of what should be ours hands over (`Handover`), each twin as soon as it is packed;
what it does not hand over in time is taken without
take       what nobody live holds; the keeper recalls its telemetry and its last model
announce   what we hold, every 0.5 s and at once when that grew
asked        for a handover: give up each aircraft and send its twin; the asker is its owner
heard        a higher claim on what we hold: drop it, without a word
"""

import logging
import platform
import threading
import time
from collections.abc import Iterable, Iterator
from typing import Protocol

import msgspec

from fleet import SOURCES
from fleet.codec import Stamp
from fleet.contract import Claim, Handover, Wanted
from fleet.presence import Present, read
from fleet.talk import Bus
from twin_worker.claims.decide import Claims, Rank

_log = logging.getLogger(__name__)
_TURN_S = 0.1  # between turns without news [s]
_SETTLE_S = 0.03  # tokens come in bursts [s]
_ANNOUNCE_S = 0.5
_ASK_S = 0.5  # for everyone to say what they hold; a frozen worker never does [s]
_HAND_S = 1.5  # for one to hand over all it was asked for [s]
_LEAVE_S = 3.0  # to hand everything over at the end [s]
_MOST_EPOCH = 1 << 62  # beyond is no epoch


class Keeper(Protocol):
    """Who keeps the twins."""

    def expect(self, uavs: Iterable[int]) -> None:
        """Begin to collect what is heard of these, before their twins are here."""

    def adopt(self, uav: int, epoch: int, twin: Handover | None) -> None:
        """Hold one from now on, with its twin or without."""

    def recall(self, uavs: list[int]) -> None:
        """Ask for the telemetry of before of some that came without their twins."""

    def renew(self, uav: int, epoch: int) -> None:
        """Write under another epoch from now on."""

    def drop(self, uavs: Iterable[int]) -> None:
        """Hold these no longer."""

    def hand_over(self, uav: int, epoch: int) -> Handover | None:
        """Hold one no longer; give its twin."""

    @property
    def bare(self) -> tuple[int, ...]:
        """Name those without the telemetry of before."""


class Claiming:
    """One worker's side of the protocol.

    Args:
        bus: joined
        ids: what it may hold
        keeper: of its twins
    """

    def __init__(self, bus: Bus, ids: range, keeper: Keeper) -> None:
        self.me = f"{bus.writer:016x}"
        self.claims = Claims(self.me, ids)
        self.threaded = False  # true: `run` turns; false: whoever hears of news does
        self._bus, self._keeper = bus, keeper
        self._lock = threading.RLock()
        self._news = threading.Event()
        self._said = float("-inf")

    # --- from any thread ---------------------------------------------------------------------------------------------

    def join(self) -> None:
        """Make known that this worker lives, and learn who else does and what they hold."""
        self._bus.attend(self._token)
        self._bus.subscribe(Claim, lambda claim, stamp: self._claim(claim))
        self._bus.answer(Claim, lambda *_: [(self.claim(asked=True), None)])
        self._bus.answer(Handover, lambda uav, asked, payload: self._asked(payload))
        self._bus.present(Present(self.me, self.claims.ids, _wall_ms()).token)
        self.turn()

    def hear_of(self, uav: int) -> None:
        """Learn that there is an aircraft; where nobody holds it, its owner does before long."""
        claims = self.claims
        if uav in claims.ids and uav not in claims.known:
            claims.known.add(uav)
            self._news.set()
            if not self.threaded:
                self.turn()

    def may_write(self) -> bool:
        """Tell whether results may be published."""
        return not self.threaded or self.claims.may_write(time.monotonic())

    def overheard(self, uav: int, stamp: Stamp | None) -> None:
        """Learn from a result who writes for an aircraft."""
        if stamp is not None and stamp.epoch < _MOST_EPOCH:
            with self._lock:
                self.claims.note(uav, Rank(stamp.epoch, f"{stamp.writer:016x}"))

    def claim(self, *, asked: bool = False) -> Claim:
        """Say what is held; to those who ask also what is known of others."""
        with self._lock:
            seen = ((uav, *rank) for uav, rank in self.claims.seen.items()) if asked else ()
            held = tuple(self.claims.held.items())
            return Claim(
                t=time.time(),
                worker=self.me,
                held=held,
                bare=self._keeper.bare,
                leaving=self.claims.leaving,
                machine=platform.node(),
                code=SOURCES,
                seen=tuple(seen),
            )

    def _token(self, name: str, lives: bool) -> None:
        told = read(name)
        if told is None:
            return
        with self._lock:
            if lives:
                self.claims.appeared(*told)
            else:
                self.claims.vanished(told.worker, told.born)
        self._news.set()

    def _claim(self, claim: Claim) -> None:
        if claim.worker == self.me:
            return
        with self._lock:
            held = {uav: epoch for uav, epoch in claim.held if 0 <= epoch < _MOST_EPOCH}
            lost = self.claims.heard(claim.worker, held, claim.leaving)
            for uav, epoch, worker in claim.seen:
                if 0 <= epoch < _MOST_EPOCH:
                    self.claims.note(uav, Rank(epoch, worker))
            self._keeper.drop(lost)
        if lost:
            _log.info("%d aircraft are written for by %s, which has the higher claim", len(lost), claim.worker)

    def _asked(self, payload: bytes) -> Iterator[tuple[Handover, None]]:
        """Hand over one by one: each is written for until its own turn comes."""
        if not payload:
            return
        for uav in _wanted(payload).uavs:
            with self._lock:
                given = self.claims.give([uav])
            if given and (twin := self._keeper.hand_over(uav, given[uav])) is not None:
                yield twin, None

    # --- one thread --------------------------------------------------------------------------------------------------

    def run(self, stop: threading.Event) -> None:
        """Turn until told to stop."""
        while not stop.is_set():
            if self._news.wait(_TURN_S):
                self.tick()
                stop.wait(_SETTLE_S)
            self._news.clear()
            try:
                self.turn()
            except ConnectionError:  # the session is closed: we are leaving
                return
            except Exception:  # a defect met once must not end the claims
                _log.exception("a turn of the claims failed; report it")

    def turn(self) -> None:
        """Do what is due."""
        if not self.tick():
            return
        if self.claims.unsure:
            self._synchronise()
        with self._lock:
            plan = self.claims.plan(time.monotonic())
        grown = bool(plan.take or plan.ask)
        for worker, uavs in plan.ask.items():
            plan.take += self._ask(worker, uavs)
        self._take(plan.take)
        if grown or time.monotonic() - self._said >= _ANNOUNCE_S:
            self._announce()
        if plan.take:
            self._keeper.recall(plan.take)
            self._announce()

    def leave(self) -> None:
        """Hand everything over to the others, for a few seconds at most."""
        with self._lock:
            self.claims.leaving = True
        until, waited = time.monotonic() + _LEAVE_S, threading.Event()
        while self.tick() and self._heirs() and time.monotonic() < until:
            self._announce()
            waited.wait(_TURN_S)

    def _heirs(self) -> bool:
        """Tell whether anyone is there to hand what is still held to."""
        with self._lock:
            others = [peer.ids for peer in self.claims.peers.values() if not peer.leaving]
            return any(uav in ids for uav in self.claims.held for ids in others)

    def tick(self) -> bool:
        """Look at clock and router; give whether the router is in sight."""
        in_sight = bool(self._bus.router)
        with self._lock:
            self.claims.tick(time.monotonic(), in_sight)
        return in_sight

    def _synchronise(self) -> None:
        """Ask everyone what they hold and go on; what was overtaken meanwhile is claimed anew, or dropped."""
        for claim, _ in self._bus.ask(Claim, timeout_s=_ASK_S):
            self._claim(claim)
        if not self.tick():
            return
        with self._lock:
            before = dict(self.claims.held)
            self.claims.synced(_wall_ms())
            renewed = {uav: epoch for uav, epoch in self.claims.held.items() if before[uav] != epoch}
        for uav, epoch in renewed.items():
            self._keeper.renew(uav, epoch)

    def _ask(self, worker: str, uavs: list[int]) -> list[int]:
        """Ask a holder for twins and adopt each that comes; give those that did not."""
        self._keeper.expect(uavs)
        missing = dict.fromkeys(uavs)
        payload = msgspec.msgpack.encode(Wanted(uavs=tuple(uavs)))
        for twin in self._bus.gather(Handover, worker, payload, _HAND_S):
            if twin.uav in missing and 0 <= twin.epoch < _MOST_EPOCH:
                del missing[twin.uav]
                with self._lock:
                    self.claims.note(twin.uav, Rank(twin.epoch, worker))
                    epoch = self.claims.take(twin.uav, _wall_ms())
                self._keeper.adopt(twin.uav, epoch, twin)
        self.tick()
        return list(missing)

    def _take(self, uavs: Iterable[int]) -> None:
        for uav in uavs:
            with self._lock:
                epoch = self.claims.take(uav, _wall_ms())
            self._keeper.adopt(uav, epoch, None)

    def _announce(self) -> None:
        self._said = time.monotonic()
        self._bus.publish(self.claim())


def _wanted(payload: bytes) -> Wanted:
    try:
        return msgspec.msgpack.decode(payload, type=Wanted)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"handover: found no Wanted ({error}); see `fleet schema @handover`") from None


def _wall_ms() -> int:
    return time.time_ns() // 1_000_000
