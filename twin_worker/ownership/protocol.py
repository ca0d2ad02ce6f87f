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
from collections.abc import Callable, Iterator
from typing import Any

import msgspec

from fleet import SOURCES
from fleet.bus.bus_protocol import WorkerToken, parse_token
from fleet.bus.codec import MAX_EPOCH_AHEAD_MS, Stamp, is_plausible_epoch
from fleet.bus.session import Bus
from fleet.contract import Claim, Handover, HandoverRequest
from twin_worker.ownership.protocol_state import FencingToken, OwnershipState
from twin_worker.ownership.twin_store import TwinStore

_log = logging.getLogger(__name__)
_STEP_PERIOD_S = 0.1  # between steps without an event [s]
_BURST_S = 0.03  # waits for the rest of a burst of tokens [s]
_ANNOUNCE_PERIOD_S = 0.25  # several times in `SILENT_S` [s]
_CLAIM_TIMEOUT_S = 0.5  # for the claims of all workers; a frozen worker does not answer [s]
_HANDOVER_TIMEOUT_S = 3.0  # maximum gap between snapshots from an owner, which publishes meanwhile [s]
_BATCH_TIMEOUT_S = 20.0  # for all snapshots requested from one worker at once [s]
_SNAPSHOT_TIMEOUT_S = (
    1.4  # for one snapshot; below half of the handover timeout, so that two lost ones do not end the handover [s]
)
# Rest between two snapshots from an owner that stays, in times of the duration of the last one [-], and its limit; the
# limit and two lost snapshots fit into the handover timeout [s]. The CPU time of a handover delays predictions.
_REST_FACTOR, _MAX_REST_S = 4.0, 0.15
_TRANSFER_PAUSE_S = 0.5  # handovers count as ended this long after the last snapshot [s]
_MAX_TRANSFER_S = 10.0  # heavy work waits no longer for handovers [s]
_LEAVE_TIMEOUT_S = 5.0  # for the other workers to acquire everything at shutdown [s]
_REPAIR_PERIOD_S = 1.0  # between checks for incomplete acquisitions [s]
_MAX_CLOCK_WARNINGS = 100  # maximum number of workers with a clock warning
_REQUEST_DECODER = msgspec.msgpack.Decoder(HandoverRequest)


class OwnershipProtocol:
    """One worker's side of the ownership protocol.

    Args:
        bus: connected bus
        ids: UAV ids this worker may own
        store: of its twins
    """

    def __init__(self, bus: Bus, ids: range, store: TwinStore) -> None:
        self.worker_id = f"{bus.writer:016x}"
        self.state = OwnershipState(self.worker_id, ids)
        self.threaded = False  # true: `run` steps; false: callbacks step
        self._bus, self._store = bus, store
        self._lock = threading.RLock()
        self._wakeup = threading.Event()
        self._announced_t = float("-inf")
        self._announced: tuple[object, ...] = ()  # last announced claim
        self._requested: dict[int, float] = {}  # start of the wait for a snapshot, by UAV id [s, monotonic]
        self._request_threads: dict[str, threading.Thread] = {}  # by worker
        self._query_threads: list[threading.Thread] = []
        self._unknown_peer = False  # a worker without a known token announces; tokens can arrive out of order
        self._repaired_t = float("-inf")
        # times of the first and the last snapshot of the handovers in progress [s, monotonic]
        self._transfer_begun = self._transferred_t = float("-inf")
        self._clock_warned: set[str] = set()  # workers whose epochs were rejected

    # --- from any thread ---------------------------------------------------------------------------------------------

    def join(self) -> None:
        """Declare this worker's liveliness token, and subscribe to tokens, claims and handover queries."""
        self._bus.watch_liveliness(self._on_token)
        self._bus.subscribe(Claim, lambda claim, stamp: self._on_claim(claim))
        self._bus.declare_queryable(Claim, lambda *_: [(self.claim(with_highest=True), None)])
        self._bus.declare_queryable(Handover, lambda uav, params, payload: self._on_handover_query(payload))
        self._bus.declare_liveliness(WorkerToken(self.worker_id, self.state.ids, _wall_ms()).token)
        self.step()

    def on_aircraft(self, uav: int) -> None:
        """Register an aircraft; if it has no owner, the assigned worker acquires it."""
        state = self.state
        state.receiving = True
        if uav in state.ids and uav not in state.known:
            state.known.add(uav)
            self._wakeup.set()
            if not self.threaded:
                self.step()

    def may_write(self) -> bool:
        """Return whether this worker may publish results."""
        return not self.threaded or self.state.may_write(time.monotonic())

    @property
    def transferring(self) -> bool:
        """Return whether snapshots are sent or received now, for which less urgent work should wait."""
        now = time.monotonic()
        return now - self._transferred_t < _TRANSFER_PAUSE_S and now - self._transfer_begun < _MAX_TRANSFER_S

    def _count_transfer(self) -> None:
        now = time.monotonic()
        if now - self._transferred_t >= _TRANSFER_PAUSE_S:
            self._transfer_begun = now
        self._transferred_t = now

    def observe_stamp(self, uav: int, stamp: Stamp | None) -> None:
        """Record the publisher of an aircraft's result."""
        if stamp is not None and is_plausible_epoch(stamp.epoch):
            with self._lock:
                self.state.record(uav, FencingToken(stamp.epoch, f"{stamp.writer:016x}"))

    def claim(self, *, with_highest: bool = False) -> Claim:
        """Return this worker's claim with the highest known claims of others: all, or those above announced ones."""
        with self._lock:
            known = self.state.highest if with_highest else self.state.superseding_claims()
            highest = ((uav, *rank) for uav, rank in known.items())
            not_publishing = self._store.not_publishing
            owned = tuple((uav, epoch) for uav, epoch in self.state.owned.items() if uav not in not_publishing)
            return Claim(
                t=time.time(),
                worker=self.worker_id,
                owned=owned,
                without_history=self._store.without_history,
                leaving=self.state.leaving,
                machine=platform.node(),
                code=SOURCES,
                highest_claims=tuple(highest),
            )

    def _on_token(self, name: str, live: bool) -> None:
        presence = parse_token(name)
        if presence is None or (live and not self._is_timely(presence.worker, presence.started_ms)):
            return
        with self._lock:
            if live:
                self.state.on_join(*presence)
            else:
                self.state.on_leave(presence.worker, presence.started_ms)
        self._wakeup.set()

    def _on_claim(self, claim: Claim) -> None:
        if claim.worker == self.worker_id:
            return
        with self._lock:
            self._unknown_peer |= claim.worker not in self.state.peers and not claim.leaving
            claimed = {uav: epoch for uav, epoch in claim.owned if self._is_timely(claim.worker, epoch)}
            lost = self.state.on_claim(claim.worker, claimed, claim.leaving)
            for uav, epoch, worker in claim.highest_claims:
                if is_plausible_epoch(epoch):
                    self.state.record(uav, FencingToken(epoch, worker))
            self._store.release(lost)
        if lost:
            _log.info("%d aircraft released: worker %s has the higher claim", len(lost), claim.worker)

    def _on_handover_query(self, payload: bytes) -> Iterator[tuple[Handover, None]]:
        """Yield snapshots of owned aircraft, one by one; the requester acquires them and announces it."""
        try:
            wanted = _REQUEST_DECODER.decode(payload).uavs if payload else ()
        except (msgspec.DecodeError, RecursionError) as error:
            raise ValueError(f"handover: found no Wanted ({error}); see `fleet schema @handover`") from None
        for uav in wanted:
            with self._lock:
                epoch = self.state.owned.get(uav)
            self._count_transfer()
            if epoch is not None and (twin := self._store.snapshot(uav, epoch)) is not None:
                yield twin, None

    # --- one thread --------------------------------------------------------------------------------------------------

    def run(self, stop: threading.Event) -> None:
        """Step until `stop` is set."""
        while not stop.is_set():
            if self._wakeup.wait(_STEP_PERIOD_S):
                self.tick()
                stop.wait(_BURST_S)
            self._wakeup.clear()
            try:
                self.step()
            except ConnectionError:  # the session is closed: shutdown
                return
            except Exception:  # an error must not stop the protocol
                _log.exception("ownership step failed; report it")

    def step(self) -> None:
        """Run whatever is due."""
        if not self.tick():
            return
        with self._lock:  # after the clock was set back
            renewed = self.state.drop_future_epochs(_wall_ms() + MAX_EPOCH_AHEAD_MS, _wall_ms())
        self._store.set_epochs(renewed)
        if self.state.unsynchronised:
            self._synchronise()
        with self._lock:
            plan = self.state.plan(time.monotonic())
        self._acquire(plan.acquire)
        if plan.valid:  # a short unsynchronised phase, as on a busy machine, does not restart the timeouts
            self._acquire(self._request_handovers(plan.request))
            self._repair()
        self._announce(only_if_due=True)

    def leave(self) -> None:
        """Hand all aircraft over to the other workers, within a few seconds."""
        with self._lock:
            self.state.leaving = True
        until, pause = time.monotonic() + _LEAVE_TIMEOUT_S, threading.Event()
        while self.tick() and time.monotonic() < until:
            with self._lock:
                successors = self.state.successors().values()
                if not any(uav in ids for uav in self.state.owned for ids in successors):
                    return
            self._announce()
            pause.wait(_STEP_PERIOD_S)

    def tick(self) -> bool:
        """Update the clock and the router state; return whether the router is connected."""
        connected = bool(self._bus.router)
        with self._lock:
            self.state.tick(time.monotonic(), connected)
        return connected

    def _synchronise(self) -> None:
        """Query all claims and resynchronise; aircraft claimed by others meanwhile are claimed again or released."""
        for claim, _ in self._bus.get(Claim, timeout_s=_CLAIM_TIMEOUT_S):
            self._on_claim(claim)
        if not self.tick():
            return
        with self._lock:
            previous = dict(self.state.owned)
            self.state.resynchronise(_wall_ms())
            renewed = {uav: epoch for uav, epoch in self.state.owned.items() if previous[uav] != epoch}
        self._store.set_epochs(renewed)

    def _is_timely(self, worker: str, epoch: int) -> bool:
        """Return whether a worker's epoch is within the limit; warn once if it is far ahead of this clock."""
        if is_plausible_epoch(epoch):
            return True
        if worker not in self._clock_warned and len(self._clock_warned) < _MAX_CLOCK_WARNINGS:
            self._clock_warned.add(worker)
            problem = f"claims over {MAX_EPOCH_AHEAD_MS // 60_000} minutes ahead of this clock"
            _log.warning("worker %s: found %s, expected synchronised clocks; set its clock", worker, problem)
        return False

    def _request_handovers(self, wanted: dict[str, list[int]]) -> list[int]:
        """Request snapshots from all owners at once; return the aircraft whose owner does not respond in time."""
        now, uavs = time.monotonic(), {uav for batch in wanted.values() for uav in batch}
        with self._lock:
            self._requested = {uav: self._requested.get(uav, now) for uav in uavs}
        for worker, mine in wanted.items():
            if not self.threaded:
                self._fetch_snapshots(worker, mine)
            elif worker not in self._request_threads or not self._request_threads[worker].is_alive():
                self._request_threads[worker] = self._start_thread(self._fetch_snapshots, worker, mine)
        with self._lock:
            late = [uav for uav, since in self._requested.items() if now - since > _HANDOVER_TIMEOUT_S]
            return [uav for uav in late if uav not in self.state.owned]

    def _fetch_snapshots(self, worker: str, uavs: list[int]) -> None:
        """Request snapshots from one owner and acquire each on arrival.

        One at a time: unread snapshots must fit into the buffers between two processes, else they are dropped. An owner
        that stays publishes meanwhile, so its handover may last; one that leaves has little time.
        """
        until, rest = time.monotonic() + _BATCH_TIMEOUT_S, threading.Event()
        for uav in uavs:
            started = time.monotonic()
            remaining_s = min(until - started, _SNAPSHOT_TIMEOUT_S)
            if remaining_s > 0.0 and uav not in self.state.owned:
                self._count_transfer()
                payload = msgspec.msgpack.encode(HandoverRequest(uavs=(uav,)))
                for twin in self._bus.get_stream(Handover, worker, payload, remaining_s):
                    self._accept_snapshot(worker, uavs, twin)
                if self.threaded and uav in self.state.owned and worker in self.state.successors():
                    rest.wait(min(_REST_FACTOR * (time.monotonic() - started), _MAX_REST_S))

    def _accept_snapshot(self, worker: str, uavs: list[int], twin: Handover) -> None:
        self._count_transfer()
        now = time.monotonic()  # the owner responds: keep waiting for the rest
        with self._lock:
            self._requested = self._requested | dict.fromkeys(uavs, now)
            accepted = twin.uav in uavs and twin.uav not in self.state.owned and is_plausible_epoch(twin.epoch)
            if not accepted or not self.state.may_write(time.monotonic()):
                return
            self.state.record(twin.uav, FencingToken(twin.epoch, worker))
            epoch = self.state.acquire(twin.uav, _wall_ms())
        self._store.acquire(twin.uav, epoch, twin)

    def _acquire(self, uavs: list[int]) -> None:
        for uav in uavs:
            with self._lock:
                epoch = self.state.acquire(uav, _wall_ms())
            self._store.acquire(uav, epoch, None)
        self._rehydrate(uavs)

    def _rehydrate(self, uavs: list[int]) -> None:
        if uavs and self.threaded:
            self._query_threads.append(self._start_thread(self._store.rehydrate, uavs))
        elif uavs:
            self._store.rehydrate(uavs)

    def _repair(self) -> None:
        """Repair rare inconsistencies after crossed or lost messages or an internal error."""
        now = time.monotonic()
        if now - self._repaired_t < _REPAIR_PERIOD_S:
            return
        self._repaired_t = now
        if self._unknown_peer:
            self._unknown_peer = False
            self._bus.list_liveliness(self._on_token)
        self._query_threads = [thread for thread in self._query_threads if thread.is_alive()]
        busy = bool(self._query_threads) or any(thread.is_alive() for thread in self._request_threads.values())
        with self._lock:
            owned, ready = dict(self.state.owned), self._store.ready_by_uav
            self._store.release(ready.keys() - owned.keys() - self._requested.keys())
        if missing := [uav for uav in owned if not ready.get(uav)] if not busy else []:
            _log.warning("%d owned aircraft have no twin; restored from published data", len(missing))
            for uav in missing:
                self._store.acquire(uav, owned[uav], None)
            self._rehydrate(missing)

    def _start_thread(self, task: Callable[..., None], *arguments: Any) -> threading.Thread:
        """Run a task in a thread."""
        thread = threading.Thread(target=self._run_task, args=(task, *arguments), daemon=True)
        thread.start()
        return thread

    def _run_task(self, task: Callable[..., None], *arguments: Any) -> None:
        try:
            task(*arguments)
        except ConnectionError:  # the session is closed: shutdown
            return
        except Exception:  # an error must not stop the protocol
            _log.exception("takeover failed with an internal error; report it")
        self._wakeup.set()

    def _announce(self, *, only_if_due: bool = False) -> None:
        """Publish the claim; with `only_if_due` only after a change or a period."""
        claim, now = self.claim(), time.monotonic()
        content = claim.owned, claim.without_history
        if not only_if_due or content != self._announced or now - self._announced_t >= _ANNOUNCE_PERIOD_S:
            self._announced_t, self._announced = now, content
            self._bus.publish(claim)


def _wall_ms() -> int:
    return time.time_ns() // 1_000_000
