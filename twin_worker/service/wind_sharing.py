"""Exchange of wind between workers: estimates of all aircraft in, one wind field out, by one worker at a time."""

from fleet.bus.session import Bus
from fleet.contract import FleetState, WindField
from twin_worker.estimation.wind_field import MAX_AGE_S, WindFieldEstimator, shared_wind
from twin_worker.ownership.protocol import OwnershipProtocol
from twin_worker.ownership.twin_store import OwnedTwin
from twin_worker.service.shared_estimate import SharedEstimate

_PERIOD_S = 5.0  # between two fields [s]


class WindSharing(SharedEstimate[WindField]):
    """One worker's part in the wind field: every worker stores the estimates in all fleet tables (`FleetState`)."""

    kind, name, assigned_id, max_age_s = WindField, "wind field", 0, MAX_AGE_S

    def __init__(self, bus: Bus, ownership: OwnershipProtocol) -> None:
        super().__init__(bus, ownership)
        self._estimator = WindFieldEstimator()

    @property
    def period_s(self) -> float:
        """Return the time between two fields [s]."""
        return _PERIOD_S

    def connect(self) -> None:
        """Subscribe to fleet tables and fields, and declare the query handler."""
        self._bus.subscribe(FleetState, lambda state, _: self._on_state(state))
        super().connect()

    def apply(self, owned: OwnedTwin) -> None:
        """Set the newest field of a twin of this worker, for its next prediction; forget one that is too old."""
        self.forget_if_old()
        if owned.twin.environment.wind_field is not self.latest:
            owned.twin.environment.set_wind_field(self.latest)

    def _on_state(self, state: FleetState) -> None:
        for row in state.rows:
            if row.wind is not None:
                try:
                    with self._lock:
                        self._estimator.add(row.uav, row.wind)
                except ValueError as error:
                    self.reject(error)

    def check(self, message: WindField) -> None:
        """Check a field received from the bus, see `shared_wind`."""
        shared_wind(message)

    def estimate(self) -> WindField | None:
        """Return the field of all aircraft; None with too few."""
        return self._estimator.estimate()
