"""Exchange between aircraft of one type: data of all models in, one distribution of each type out, by one worker."""

import time

from fleet.airframes import Airframe
from fleet.bus.session import Bus
from fleet.contract import Model, SiblingData, Siblings
from twin_worker.identification.fixed_wing.siblings import data_defect, estimate_type, type_defect
from twin_worker.ownership.protocol import OwnershipProtocol
from twin_worker.ownership.twin_store import OwnedTwin
from twin_worker.service.shared_estimate import SharedEstimate
from twin_worker.twin.steps.identify_step import airframe_type

_PERIOD_S = 10.0  # between two estimates [s]
_MAX_AIRCRAFT, _MAX_TYPES = 500, 50  # aircraft of all types, and types; a bound against hostile input


class SiblingSharing(SharedEstimate[Siblings]):
    """One worker's part in the distributions: it stores the data in the models of all aircraft.

    Only models of the airframe file of this worker count, because the distribution needs its prior.

    Args:
        bus: connected bus
        ownership: of this worker, which knows the live workers
        airframe: of this worker
    """

    kind, name, assigned_id, max_age_s = Siblings, "siblings", 1, 3600.0

    def __init__(self, bus: Bus, ownership: OwnershipProtocol, airframe: Airframe) -> None:
        super().__init__(bus, ownership)
        self._airframe = airframe
        self._data: dict[int, SiblingData] = {}  # by aircraft

    @property
    def period_s(self) -> float:
        """Return the time between two estimates [s]."""
        return _PERIOD_S

    def connect(self) -> None:
        """Subscribe to models and distributions, and declare the query handler."""
        self._bus.subscribe(Model, lambda model, _: self.on_model(model))
        super().connect()

    def on_model(self, model: Model) -> None:
        """Store what the data of an aircraft say, of an accepted model only."""
        derivatives, verdict = model.derivatives, model.active_verdict
        if derivatives is None or derivatives.data is None or derivatives.prior != self._airframe.name:
            return
        if verdict is None or not verdict.outcome.is_accepted:
            return
        if defect := data_defect(derivatives.data):
            self.reject(ValueError(f"uav-{model.uav}, data for its siblings: {defect}; they are ignored"))
            return
        with self._lock:
            if model.uav in self._data or len(self._data) < _MAX_AIRCRAFT:
                self._data[model.uav] = derivatives.data

    def apply(self, owned: OwnedTwin) -> None:
        """Set the distribution of the type of a twin of this worker, for its first models."""
        self.forget_if_old()
        types = self.latest.types if self.latest is not None else ()
        kind = airframe_type(owned.twin) if types else ""
        siblings = next((one for one in types if one.airframe_type == kind), None)
        if owned.twin.identification.siblings is not siblings:
            owned.twin.identification.set_siblings(siblings)

    def check(self, message: Siblings) -> None:
        """Check distributions received from the bus.

        Raises:
            ValueError: when they must not be used; their worker must correct them.
        """
        for one in message.types:
            if defect := type_defect(one):
                raise ValueError(f"siblings, {one.airframe_type[:60]!r}: {defect}; they are ignored")

    def estimate(self) -> Siblings | None:
        """Return the distribution of each type with enough aircraft; None: there is none."""
        names = sorted({one.airframe_type for one in self._data.values()})[:_MAX_TYPES]
        by_type = ({uav: one for uav, one in self._data.items() if one.airframe_type == name} for name in names)
        types = tuple(one for data in by_type if (one := estimate_type(data, self._airframe)) is not None)
        return Siblings(t=time.time(), types=types) if types else None
