"""Checkpoints of a twin over the last minutes, and the fault effects that its models contain."""

from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass
from datetime import UTC, datetime

from twin_worker.estimation.wind_filter import WindFilter
from twin_worker.identification.fixed_wing.derivatives_model import Coupled
from twin_worker.identification.fixed_wing.plant import Plant
from twin_worker.identification.fixed_wing.point_mass_model import Hybrid

EVERY_S = 10.0  # between checkpoints [s]
MOST = 15  # number of checkpoints kept; covers the telemetry history


@dataclass(frozen=True)
class Mark:
    """State of one twin at one instant.

    Attributes:
        t: time [s since 1970]
        wind_filter: copy of the wind filter
        derivatives_model: verified stability-and-control model; None before the first
        point_mass: verified point-mass model; None before the first
    """

    t: float
    wind: WindFilter
    plant: Coupled | None
    hybrid: Hybrid | None


@dataclass(frozen=True)
class Extension:
    """Fault effects added to the active model: their names, and the onset [s since 1970]."""

    names: str
    onset: float

    def __str__(self) -> str:
        return f"{self.names} since {datetime.fromtimestamp(self.onset, UTC):%H:%M:%S} UTC"


def mark(t: float, wind: WindFilter, plants: tuple[Plant | None, ...], hybrid: Hybrid | None) -> Mark:
    """Create a checkpoint with the first stability-and-control model among `models`."""
    coupled = next((one for one in plants if isinstance(one, Coupled)), None)
    return Mark(t, deepcopy(wind), coupled, hybrid)


def before(marks: Iterable[Mark], t: float) -> Mark | None:
    """Return the newest checkpoint before time t [s since 1970]; None if there is none."""
    return max((one for one in marks if one.t < t), key=lambda one: one.t, default=None)
