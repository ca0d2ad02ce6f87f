"""Ownership protocol on the bus: liveliness tokens, claims, handovers. `OwnershipState` decides, a `TwinStore` acts.

Runs every 0.1 s, and at once when a token appears or disappears or an aircraft without an owner is seen.
unsynchronised  query the claims of all workers (`Claim`), then continue
acquire         aircraft without a live owner: propagate the last prediction at once, query telemetry and model later
request         snapshots (`Handover`) from live owners of aircraft assigned to this worker; acquire each on arrival,
                and without a snapshot after a timeout
announce        the aircraft published by this worker, every 0.25 s and on change; an acquired snapshot only after its
                first publication
snapshot query  send snapshots, keep the aircraft
superseded      a higher claim on an owned aircraft: release it
repair          look up announcing workers without a token; restart acquisitions that failed
"""

import logging
import platform
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Protocol

import msgspec

from fleet import SOURCES
from fleet.bus.bus_protocol import Bus
from fleet.bus.codec import EPOCH_AHEAD_MS, Stamp, timely
from fleet.bus.presence import Present, read
from fleet.contract import Claim, Handover, Wanted
from twin_worker.ownership.protocol_state import Claims, Rank

_log = logging.getLogger(__name__)
_TURN_S = 0.1  # between steps without an event [s]
_SETTLE_S = 0.03  # waits for the rest of a burst of tokens [s]
_ANNOUNCE_S = 0.25  # several times in `SILENT_S` [s]
_ASK_S = 0.5  # for the claims of all workers; a frozen worker does not answer [s]
_HAND_S = 3.0  # maximum gap between snapshots from an owner, which publishes meanwhile [s]
_COPIES_S = 20.0  # for all snapshots requested from one worker at once [s]
_COPY_S = 1.4  # for one snapshot; below half of the handover timeout, so that two lost ones do not end the handover [s]
_LEAVE_S = 5.0  # for the other workers to acquire everything at shutdown [s]
_MEND_S = 1.0  # between checks for incomplete acquisitions [s]
_MOST_AHEAD = 100  # maximum number of workers with a clock warning


class Keeper(Protocol):
    """Stores the twins of the owned aircraft."""

    def expect(self, uavs: Iterable[int]) -> None:
        """Queue messages of these aircraft before their twins arrive."""

    def adopt(self, uav: int, epoch: int, twin: Handover | None) -> None:
        """Acquire one aircraft, with a snapshot of its twin or without."""

    def recall(self, uavs: list[int]) -> None:
        """Query the past telemetry of aircraft acquired without a snapshot."""

    def renew(self, uav: int, epoch: int) -> None:
        """Publish under another epoch from now on."""

    def drop(self, uavs: Iterable[int]) -> None:
        """Release these aircraft."""

    def copied(self, uav: int, epoch: int) -> Handover | None:
        """Return a snapshot of one twin; None if it is not available now."""

    @property
    def kept(self) -> dict[int, bool]:
        """Return for each owned or expected aircraft whether its twin is ready."""

    @property
    def quiet(self) -> frozenset[int]:
        """Return the aircraft acquired by snapshot that this worker does not publish yet."""

    @property
    def bare(self) -> tuple[int, ...]:
        """Return the aircraft without past telemetry."""


class Claiming:
    """One worker's side of the ownership protocol.

    Args:
        bus: connected bus
        ids: UAV ids this worker may own
        store: of its twins
    """

    def __init__(self, bus: Bus, ids: range, keeper: Keeper) -> None:
        self.me = f"{bus.writer:016x}"
        self.claims = Claims(self.me, ids)
        self.threaded = False  # true: `run` steps; false: callbacks step
        self._bus, self._keeper = bus, keeper
        self._lock = threading.RLock()
        self._news = threading.Event()
        self._said = float("-inf")
        self._told: tuple[object, ...] = ()  # last announced claim
        self._asked_for: dict[int, float] = {}  # start of the wait for a snapshot, by UAV id [s, monotonic]
        self._asking: dict[str, threading.Thread] = {}  # by worker
        self._recalling: list[threading.Thread] = []
        self._stranger = False  # a worker without a known token announces; tokens can arrive out of order
        self._mended = float("-inf")
        self._ahead: set[str] = set()  # workers whose epochs were rejected

    # --- from any thread ---------------------------------------------------------------------------------------------

    def join(self) -> None:
        """Declare this worker's liveliness token, and subscribe to tokens, claims and handover queries."""
        self._bus.attend(self._token)
        self._bus.subscribe(Claim, lambda claim, stamp: self._claim(claim))
        self._bus.answer(Claim, lambda *_: [(self.claim(asked=True), None)])
        self._bus.answer(Handover, lambda uav, asked, payload: self._asked(payload))
        self._bus.present(Present(self.me, self.claims.ids, _wall_ms()).token)
        self.turn()

    def hear_of(self, uav: int) -> None:
        """Register an aircraft; if it has no owner, the assigned worker acquires it."""
        claims = self.claims
        claims.hears = True
        if uav in claims.ids and uav not in claims.known:
            claims.known.add(uav)
            self._news.set()
            if not self.threaded:
                self.turn()

    def may_write(self) -> bool:
        """Return whether this worker may publish results."""
        return not self.threaded or self.claims.may_write(time.monotonic())

    def overheard(self, uav: int, stamp: Stamp | None) -> None:
        """Record the publisher of an aircraft's result."""
        if stamp is not None and timely(stamp.epoch):
            with self._lock:
                self.claims.note(uav, Rank(stamp.epoch, f"{stamp.writer:016x}"))

    def claim(self, *, asked: bool = False) -> Claim:
        """Return this worker's claim; `with_highest` adds the highest known claims of others."""
        with self._lock:
            seen = ((uav, *rank) for uav, rank in self.claims.seen.items()) if asked else ()
            quiet = self._keeper.quiet
            held = tuple((uav, epoch) for uav, epoch in self.claims.held.items() if uav not in quiet)
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
        if told is None or (lives and not self._timely(told.worker, told.born)):
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
            self._stranger |= claim.worker not in self.claims.peers and not claim.leaving
            held = {uav: epoch for uav, epoch in claim.held if self._timely(claim.worker, epoch)}
            lost = self.claims.heard(claim.worker, held, claim.leaving)
            for uav, epoch, worker in claim.seen:
                if timely(epoch):
                    self.claims.note(uav, Rank(epoch, worker))
            self._keeper.drop(lost)
        if lost:
            _log.info("%d aircraft released: worker %s has the higher claim", len(lost), claim.worker)

    def _asked(self, payload: bytes) -> Iterator[tuple[Handover, None]]:
        """Yield snapshots of owned aircraft, one by one; the requester acquires them and announces it."""
        for uav in _wanted(payload).uavs if payload else ():
            with self._lock:
                epoch = self.claims.held.get(uav)
            if epoch is not None and (twin := self._keeper.copied(uav, epoch)) is not None:
                yield twin, None

    # --- one thread --------------------------------------------------------------------------------------------------

    def run(self, stop: threading.Event) -> None:
        """Step until `stop` is set."""
        while not stop.is_set():
            if self._news.wait(_TURN_S):
                self.tick()
                stop.wait(_SETTLE_S)
            self._news.clear()
            try:
                self.turn()
            except ConnectionError:  # the session is closed: shutdown
                return
            except Exception:  # an error must not stop the protocol
                _log.exception("ownership step failed; report it")

    def turn(self) -> None:
        """Run whatever is due."""
        if not self.tick():
            return
        self._set_right()
        if self.claims.unsure:
            self._synchronise()
        with self._lock:
            plan = self.claims.plan(time.monotonic())
        self._take(plan.take)
        if plan.sure:  # a short unsynchronised phase, as on a busy machine, does not restart the timeouts
            self._take(self._ask(plan.ask))
            self._mend()
        if self._news_to_tell() or time.monotonic() - self._said >= _ANNOUNCE_S:
            self._announce()

    def leave(self) -> None:
        """Hand all aircraft over to the other workers, within a few seconds."""
        with self._lock:
            self.claims.leaving = True
        until, waited = time.monotonic() + _LEAVE_S, threading.Event()
        while self.tick() and self._heirs() and time.monotonic() < until:
            self._announce()
            waited.wait(_TURN_S)

    def _heirs(self) -> bool:
        """Return whether another worker can acquire an aircraft still owned here."""
        with self._lock:
            others = self.claims.heirs().values()
            return any(uav in ids for uav in self.claims.held for ids in others)

    def tick(self) -> bool:
        """Update the clock and the router state; return whether the router is connected."""
        in_sight = bool(self._bus.router)
        with self._lock:
            self.claims.tick(time.monotonic(), in_sight)
        return in_sight

    def _synchronise(self) -> None:
        """Query all claims and resynchronise; aircraft claimed by others meanwhile are claimed again or released."""
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

    def _set_right(self) -> None:
        """Claim aircraft again whose epochs are ahead of this clock after it was set back."""
        with self._lock:
            renewed = self.claims.timely(_wall_ms() + EPOCH_AHEAD_MS, _wall_ms())
        for uav, epoch in renewed.items():
            self._keeper.renew(uav, epoch)

    def _timely(self, worker: str, epoch: int) -> bool:
        """Return whether a worker's epoch is within the limit; warn once if it is far ahead of this clock."""
        if timely(epoch):
            return True
        if worker not in self._ahead and len(self._ahead) < _MOST_AHEAD:
            self._ahead.add(worker)
            found = f"claims over {EPOCH_AHEAD_MS // 60_000} minutes ahead of this clock"
            _log.warning("worker %s: found %s, expected synchronised clocks; set its clock", worker, found)
        return False

    def _ask(self, wanted: dict[str, list[int]]) -> list[int]:
        """Request snapshots from all owners at once; return the aircraft whose owner does not respond in time."""
        now, uavs = time.monotonic(), {uav for mine in wanted.values() for uav in mine}
        with self._lock:
            self._asked_for = {uav: self._asked_for.get(uav, now) for uav in uavs}
        for worker, mine in wanted.items():
            if not self.threaded:
                self._copy(worker, mine)
            elif worker not in self._asking or not self._asking[worker].is_alive():
                self._asking[worker] = self._begin(self._copy, worker, mine)
        with self._lock:
            late = [uav for uav, since in self._asked_for.items() if now - since > _HAND_S]
            return [uav for uav in late if uav not in self.claims.held]

    def _copy(self, worker: str, uavs: list[int]) -> None:
        """Request snapshots from one owner and acquire each on arrival.

        One at a time: unread snapshots must fit into the buffers between two processes, else they are dropped.
        """
        until = time.monotonic() + _COPIES_S
        for uav in uavs:
            left = min(until - time.monotonic(), _COPY_S)
            if left > 0.0 and uav not in self.claims.held:
                payload = msgspec.msgpack.encode(Wanted(uavs=(uav,)))
                for twin in self._bus.gather(Handover, worker, payload, left):
                    self._copied(worker, uavs, twin)

    def _copied(self, worker: str, uavs: list[int], twin: Handover) -> None:
        now = time.monotonic()  # the owner responds: keep waiting for the rest
        with self._lock:
            self._asked_for = self._asked_for | dict.fromkeys(uavs, now)
            wanted = twin.uav in uavs and twin.uav not in self.claims.held and timely(twin.epoch)
            if not wanted or not self.claims.may_write(time.monotonic()):
                return
            self.claims.note(twin.uav, Rank(twin.epoch, worker))
            epoch = self.claims.take(twin.uav, _wall_ms())
        self._keeper.adopt(twin.uav, epoch, twin)

    def _take(self, uavs: list[int]) -> None:
        for uav in uavs:
            with self._lock:
                epoch = self.claims.take(uav, _wall_ms())
            self._keeper.adopt(uav, epoch, None)
        self._recall(uavs)

    def _recall(self, uavs: list[int]) -> None:
        if uavs and self.threaded:
            self._recalling.append(self._begin(self._keeper.recall, uavs))
        elif uavs:
            self._keeper.recall(uavs)

    def _mend(self) -> None:
        """Repair rare inconsistencies after crossed or lost messages or an internal error."""
        now = time.monotonic()
        if now - self._mended < _MEND_S:
            return
        self._mended = now
        if self._stranger:
            self._stranger = False
            self._bus.recount(self._token)
        self._recalling = [hand for hand in self._recalling if hand.is_alive()]
        busy = bool(self._recalling) or any(hand.is_alive() for hand in self._asking.values())
        with self._lock:
            held, kept = dict(self.claims.held), self._keeper.kept
            self._keeper.drop(kept.keys() - held.keys() - self._asked_for.keys())
        if lacking := [uav for uav in held if not kept.get(uav)] if not busy else []:
            _log.warning("%d owned aircraft have no twin; restored from published data", len(lacking))
            for uav in lacking:
                self._keeper.adopt(uav, held[uav], None)
            self._recall(lacking)

    def _begin(self, act: Callable[..., None], *given: Any) -> threading.Thread:
        """Run a task in a thread."""
        thread = threading.Thread(target=self._watched, args=(act, *given), daemon=True)
        thread.start()
        return thread

    def _watched(self, act: Callable[..., None], *given: Any) -> None:
        try:
            act(*given)
        except ConnectionError:  # the session is closed: shutdown
            return
        except Exception:  # an error must not stop the protocol
            _log.exception("takeover failed with an internal error; report it")
        self._news.set()

    def _news_to_tell(self) -> bool:
        """Return whether the claim differs from the last announced one."""
        claim = self.claim()
        return (claim.held, claim.bare) != self._told

    def _announce(self) -> None:
        claim = self.claim()
        self._said, self._told = time.monotonic(), (claim.held, claim.bare)
        self._bus.publish(claim)


def _wanted(payload: bytes) -> Wanted:
    try:
        return msgspec.msgpack.decode(payload, type=Wanted)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"handover: found no Wanted ({error}); see `fleet schema @handover`") from None


def _wall_ms() -> int:
    return time.time_ns() // 1_000_000
