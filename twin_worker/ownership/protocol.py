"""The claim protocol on the bus: tokens, announcements, handovers; `Claims` decides, a `Keeper` keeps the twins.

every 0.1 s, and at once when a token comes or goes or an aircraft is heard of that nobody holds
unsure     ask everyone what they hold (`Claim`), then go on
take       what nobody live holds: the last prediction is renewed at once, telemetry and model are recalled one by one
ask        the live holder of what should be ours for copies (`Handover`), and take each as it comes; what does not come
in time is taken without
announce   what we write for, every 0.25 s and at once when that changed; what came as a copy only once we do write
asked      for copies: send them, and go on
heard      a higher claim on what we hold: drop it, without a word
mend       who announces and is not known to live is looked for; what is claimed and came to nothing is begun anew
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
_TURN_S = 0.1  # between turns without news [s]
_SETTLE_S = 0.03  # tokens come in bursts [s]
_ANNOUNCE_S = 0.25  # several times in `SILENT_S` [s]
_ASK_S = 0.5  # for everyone to say what they hold; a frozen worker never does [s]
_HAND_S = 3.0  # between copies from one that holds what should be ours; it writes meanwhile [s]
_COPIES_S = 20.0  # for all that one worker is asked for at once [s]
_COPY_S = 1.4  # for one of them; two that are lost do not have the rest taken without: less than half of `_HAND_S` [s]
_LEAVE_S = 5.0  # for the others to take everything over at the end [s]
_MEND_S = 1.0  # between looks for what was left half done [s]
_MOST_AHEAD = 100  # workers whose clocks are complained of


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

    def copied(self, uav: int, epoch: int) -> Handover | None:
        """Copy one's twin; None where there is none just now."""

    @property
    def kept(self) -> dict[int, bool]:
        """Tell of each that is held or expected whether its twin is here."""

    @property
    def quiet(self) -> frozenset[int]:
        """Name those that came as copies and are not written for yet."""

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
        self._told: tuple[object, ...] = ()  # what was announced last
        self._asked_for: dict[int, float] = {}  # since when there is no copy, by UAV id asked for [s, monotonic]
        self._asking: dict[str, threading.Thread] = {}  # by worker
        self._recalling: list[threading.Thread] = []
        self._stranger = False  # somebody unknown announces: the news of a life may come before that of its last end
        self._mended = float("-inf")
        self._ahead: set[str] = set()  # workers whose epochs were refused

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
        claims.hears = True
        if uav in claims.ids and uav not in claims.known:
            claims.known.add(uav)
            self._news.set()
            if not self.threaded:
                self.turn()

    def may_write(self) -> bool:
        """Return whether results may be published."""
        return not self.threaded or self.claims.may_write(time.monotonic())

    def overheard(self, uav: int, stamp: Stamp | None) -> None:
        """Learn from a result who writes for an aircraft."""
        if stamp is not None and timely(stamp.epoch):
            with self._lock:
                self.claims.note(uav, Rank(stamp.epoch, f"{stamp.writer:016x}"))

    def claim(self, *, asked: bool = False) -> Claim:
        """Say what is held; to those who ask also what is known of others."""
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
            _log.info("%d aircraft are written for by %s, which has the higher claim", len(lost), claim.worker)

    def _asked(self, payload: bytes) -> Iterator[tuple[Handover, None]]:
        """Send copies of what is held, one by one; who asked takes it, and is heard of when it does."""
        for uav in _wanted(payload).uavs if payload else ():
            with self._lock:
                epoch = self.claims.held.get(uav)
            if epoch is not None and (twin := self._keeper.copied(uav, epoch)) is not None:
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
        self._set_right()
        if self.claims.unsure:
            self._synchronise()
        with self._lock:
            plan = self.claims.plan(time.monotonic())
        self._take(plan.take)
        if plan.sure:  # after a moment of doubt, as on a busy machine, it is waited no longer than before
            self._take(self._ask(plan.ask))
            self._mend()
        if self._news_to_tell() or time.monotonic() - self._said >= _ANNOUNCE_S:
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
        """Return whether anyone is there to hand what is still held to."""
        with self._lock:
            others = self.claims.heirs().values()
            return any(uav in ids for uav in self.claims.held for ids in others)

    def tick(self) -> bool:
        """Look at clock and router; return whether the router is in sight."""
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

    def _set_right(self) -> None:
        """Claim anew what our own clock, once set back, no longer allows."""
        with self._lock:
            renewed = self.claims.timely(_wall_ms() + EPOCH_AHEAD_MS, _wall_ms())
        for uav, epoch in renewed.items():
            self._keeper.renew(uav, epoch)

    def _timely(self, worker: str, epoch: int) -> bool:
        """Return whether a worker's epoch may be believed; say once where it is far ahead of our clock."""
        if timely(epoch):
            return True
        if worker not in self._ahead and len(self._ahead) < _MOST_AHEAD:
            self._ahead.add(worker)
            found = f"claims over {EPOCH_AHEAD_MS // 60_000} minutes ahead of this clock, which are refused"
            _log.warning("worker %s: found %s; expected one time for all; set its clock, restart it", worker, found)
        return False

    def _ask(self, wanted: dict[str, list[int]]) -> list[int]:
        """Ask each holder for copies, all at the same time; return what is asked for in vain."""
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
        """Ask one holder, and take each as it comes.

        One at a time: copies that nobody reads yet must fit into what lies between two processes, or be dropped there.
        """
        until = time.monotonic() + _COPIES_S
        for uav in uavs:
            left = min(until - time.monotonic(), _COPY_S)
            if left > 0.0 and uav not in self.claims.held:
                payload = msgspec.msgpack.encode(Wanted(uavs=(uav,)))
                for twin in self._bus.gather(Handover, worker, payload, left):
                    self._copied(worker, uavs, twin)

    def _copied(self, worker: str, uavs: list[int], twin: Handover) -> None:
        now = time.monotonic()  # it hands over: the rest will come
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
        """Put right what crossing messages, a lost one or a defect left half done; nothing of it is usual."""
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
            _log.warning("%d aircraft are held without their twins; they begin from what was said before", len(lacking))
            for uav in lacking:
                self._keeper.adopt(uav, held[uav], None)
            self._recall(lacking)

    def _begin(self, act: Callable[..., None], *given: Any) -> threading.Thread:
        """Do it beside the turns, which go on."""
        thread = threading.Thread(target=self._watched, args=(act, *given), daemon=True)
        thread.start()
        return thread

    def _watched(self, act: Callable[..., None], *given: Any) -> None:
        try:
            act(*given)
        except ConnectionError:  # the session is closed: we are leaving
            return
        except Exception:  # a defect met once must not end the claims
            _log.exception("taking over met a defect; report it")
        self._news.set()

    def _news_to_tell(self) -> bool:
        """Return whether more or other aircraft are written for than was announced."""
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
