"""One estimate for all workers from what all aircraft contribute: one worker estimates, the next takes over.

The rendezvous hash that assigns aircraft also assigns each estimate to one live worker. If that worker disappears, the
next one has all recent contributions already. Each assignment begins with a higher epoch; readers keep the highest, as
for aircraft.
"""

import logging
import threading
import time
from abc import abstractmethod
from typing import ClassVar, Generic, TypeVar

from fleet.bus.codec import Stamp, is_plausible_epoch
from fleet.bus.session import Bus
from twin_worker.ownership.protocol import OwnershipProtocol
from twin_worker.ownership.protocol_state import owner

M = TypeVar("M")
_log = logging.getLogger(__name__)
STEP_S = 0.5  # between checks for one that is due [s]
MAX_WARNINGS = 20  # rejected messages that are logged; all are counted


class SharedEstimate(Generic[M]):
    """One worker's part in an estimate.

    Args:
        bus: connected bus
        ownership: of this worker, which knows the live workers
    """

    kind: ClassVar[type]  # message class
    name: ClassVar[str]  # in texts
    assigned_id: ClassVar[int]  # the hash assigns ids; the estimate has this one in a range of its own
    max_age_s: ClassVar[float]  # an older one is not used [s]

    def __init__(self, bus: Bus, ownership: OwnershipProtocol) -> None:
        self.latest: M | None = None  # newest valid one
        self.rejected = 0  # contributions and estimates that must not be used
        self._bus, self._ownership = bus, ownership
        self._lock = threading.Lock()
        self._stamp = Stamp(0, 0)  # of `latest`
        self._received_t = float("-inf")  # [s, monotonic]
        self._due_t = float("-inf")  # of the next one [s, monotonic]
        self._epoch = 0  # while this worker estimates

    @abstractmethod
    def check(self, message: M) -> None:
        """Check an estimate received from the bus.

        Raises:
            ValueError: when it must not be used; its worker must correct it.
        """

    @abstractmethod
    def estimate(self) -> M | None:
        """Return the estimate from the contributions; None with too few."""

    @property
    @abstractmethod
    def period_s(self) -> float:
        """Return the time between two estimates [s]."""

    def connect(self) -> None:
        """Subscribe to estimates, and declare the query handler."""
        self._bus.subscribe(self.kind, self._on_estimate)
        self._bus.declare_queryable(self.kind, lambda *_: [(self.latest, self._stamp)] if self.latest else [])

    def forget_if_old(self) -> None:
        """Forget an estimate that is too old."""
        if self.latest is not None and time.monotonic() - self._received_t > self.max_age_s:
            self.latest = None

    def _on_estimate(self, message: M, stamp: Stamp | None) -> None:
        """Use an estimate if it is valid and its epoch is not below that of the newest one."""
        if stamp is None or not is_plausible_epoch(stamp.epoch):
            self.reject(ValueError(f"{self.name}: found {stamp}, expected the epoch of a claim; it is ignored"))
            return
        if stamp < self._stamp:
            return  # of a worker that another has replaced
        try:
            self.check(message)
        except ValueError as error:
            self.reject(error)
            return
        self.latest, self._stamp, self._received_t = message, stamp, time.monotonic()

    def reject(self, error: ValueError) -> None:
        """Count and log a message that must not be used."""
        self.rejected += 1
        if self.rejected <= MAX_WARNINGS:
            _log.warning("%s", error)

    def is_assigned(self) -> bool:
        """Return whether this worker estimates: the highest hash of all live workers that do not leave."""
        state = self._ownership.state
        if state.leaving or not self._ownership.may_write():
            return False
        workers = [name for name, peer in list(state.peers.items()) if state.is_live(name) and not peer.leaving]
        ids = range(self.assigned_id, self.assigned_id + 1)
        return owner(self.assigned_id, dict.fromkeys([*workers, state.worker_id], ids)) == state.worker_id

    def step(self) -> None:
        """Estimate and publish if this worker is assigned to it and an estimate is due; during handovers later.

        A handover also assigns the estimate to another worker, for which it is due at once.
        """
        if not self.is_assigned():
            self._epoch = 0
            return
        now = time.monotonic()
        if now < self._due_t or self._ownership.transferring:
            return
        self._due_t = now + self.period_s
        with self._lock:
            message = self.estimate()
        if message is None:
            return
        self._epoch = self._epoch or max(self._stamp.epoch + 1, time.time_ns() // 1_000_000)
        self._bus.publish(message, Stamp(self._epoch, self._bus.writer))

    def run(self, stop: threading.Event) -> None:
        """Step until `stop` is set."""
        while not stop.wait(STEP_S):
            try:
                self.step()
            except ConnectionError:  # the session is closed: shutdown
                return
            except Exception:  # an error in the estimate must not stop the predictions
                _log.exception("%s failed with an internal error; report it", self.name)
