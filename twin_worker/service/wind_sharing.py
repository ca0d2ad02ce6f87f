"""Exchange of wind between workers: estimates of all aircraft in, one wind field out, by one worker at a time.

Every worker stores the estimates in all fleet tables (`FleetState`). The rendezvous hash that assigns aircraft also
assigns the field to one live worker, which estimates and publishes it. If that worker disappears, the next one has all
recent estimates already. Each assignment begins with a higher epoch; readers keep the highest, as for aircraft.
"""

import logging
import threading
import time

from fleet.bus.codec import Stamp, is_plausible_epoch
from fleet.bus.session import Bus
from fleet.contract import FleetState, WindField
from twin_worker.estimation.wind_field import MAX_AGE_S, WindFieldEstimator, shared_wind
from twin_worker.ownership.protocol import OwnershipProtocol
from twin_worker.ownership.protocol_state import owner
from twin_worker.ownership.twin_store import OwnedTwin

_log = logging.getLogger(__name__)
_PERIOD_S = 5.0  # between two fields [s]
_STEP_S = 0.5  # between checks for one that is due [s]
_MAX_WARNINGS = 20  # rejected messages that are logged; all are counted
_ASSIGNED_ID = 0  # the hash assigns ids; the field has this one in a range of its own


class WindSharing:
    """One worker's part in the wind field.

    Args:
        bus: connected bus
        ownership: of this worker, which knows the live workers
    """

    def __init__(self, bus: Bus, ownership: OwnershipProtocol) -> None:
        self.latest: WindField | None = None  # newest valid field
        self.rejected = 0  # estimates and fields that must not be used
        self._bus, self._ownership = bus, ownership
        self._estimator, self._lock = WindFieldEstimator(), threading.Lock()
        self._stamp = Stamp(0, 0)  # of `latest`
        self._received_t = float("-inf")  # [s, monotonic]
        self._due_t = float("-inf")  # of the next field [s, monotonic]
        self._epoch = 0  # while this worker estimates the field

    def connect(self) -> None:
        """Subscribe to fleet tables and fields, and declare the query handler."""
        self._bus.subscribe(FleetState, lambda state, _: self._on_state(state))
        self._bus.subscribe(WindField, self._on_field)
        self._bus.declare_queryable(WindField, lambda *_: [(self.latest, self._stamp)] if self.latest else [])

    def apply(self, owned: OwnedTwin) -> None:
        """Set the newest field of a twin of this worker, for its next prediction; forget one that is too old."""
        if self.latest is not None and time.monotonic() - self._received_t > MAX_AGE_S:
            self.latest = None
        if owned.twin.environment.wind_field is not self.latest:
            owned.twin.environment.set_wind_field(self.latest)

    def _on_state(self, state: FleetState) -> None:
        for row in state.rows:
            if row.wind is not None:
                try:
                    with self._lock:
                        self._estimator.add(row.uav, row.wind)
                except ValueError as error:
                    self._reject(error)

    def _on_field(self, message: WindField, stamp: Stamp | None) -> None:
        """Use a field if it is valid and its epoch is not below that of the newest one."""
        if stamp is None or not is_plausible_epoch(stamp.epoch):
            self._reject(ValueError(f"wind field: found {stamp}, expected the epoch of a claim; it is ignored"))
            return
        if stamp < self._stamp:
            return  # of a worker that another has replaced
        try:
            shared_wind(message)
        except ValueError as error:
            self._reject(error)
            return
        self.latest, self._stamp, self._received_t = message, stamp, time.monotonic()

    def _reject(self, error: ValueError) -> None:
        self.rejected += 1
        if self.rejected <= _MAX_WARNINGS:
            _log.warning("%s", error)

    def is_assigned(self) -> bool:
        """Return whether this worker estimates the field: the highest hash of all live workers that do not leave."""
        state = self._ownership.state
        if state.leaving or not self._ownership.may_write():
            return False
        workers = [name for name, peer in list(state.peers.items()) if state.is_live(name) and not peer.leaving]
        ids = range(_ASSIGNED_ID, _ASSIGNED_ID + 1)
        return owner(_ASSIGNED_ID, dict.fromkeys([*workers, state.worker_id], ids)) == state.worker_id

    def step(self) -> None:
        """Estimate and publish the field if this worker is assigned to it and one is due."""
        if not self.is_assigned():
            self._epoch = 0
            return
        now = time.monotonic()
        if now < self._due_t:
            return
        self._due_t = now + _PERIOD_S
        with self._lock:
            wind_field = self._estimator.estimate()
        if wind_field is None:
            return
        self._epoch = self._epoch or max(self._stamp.epoch + 1, time.time_ns() // 1_000_000)
        self._bus.publish(wind_field, Stamp(self._epoch, self._bus.writer))

    def run(self, stop: threading.Event) -> None:
        """Step until `stop` is set."""
        while not stop.wait(_STEP_S):
            try:
                self.step()
            except ConnectionError:  # the session is closed: shutdown
                return
            except Exception:  # an error in the field must not stop the predictions
                _log.exception("the wind field failed with an internal error; report it")
