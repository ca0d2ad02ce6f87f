"""What a twin knew at moments of the last minutes, so that it can begin anew from before a fault, and with what."""

from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass
from datetime import UTC, datetime

from twin_worker.estimation.wind_filter import WindFilter
from twin_worker.identification.fixed_wing.derivatives_model import Coupled
from twin_worker.identification.fixed_wing.plant import Plant
from twin_worker.identification.fixed_wing.point_mass_model import Hybrid

EVERY_S = 10.0  # between marks [s]
MOST = 15  # kept: as far back as telemetry is


@dataclass(frozen=True)
class Mark:
    """One moment.

    Attributes:
        t: when [s since 1970]
        wind: the wind filter, a copy
        plant: the coupled model believed; None before any
        hybrid: the hybrid believed; None before any
    """

    t: float
    wind: WindFilter
    plant: Coupled | None
    hybrid: Hybrid | None


@dataclass(frozen=True)
class Extension:
    """Missing physics that was put into the model in force: names of the effects, and their onset [s since 1970]."""

    names: str
    onset: float

    def __str__(self) -> str:
        return f"{self.names} since {datetime.fromtimestamp(self.onset, UTC):%H:%M:%S} UTC"


def mark(t: float, wind: WindFilter, plants: tuple[Plant | None, ...], hybrid: Hybrid | None) -> Mark:
    """Mark this moment; of the plants the first that is coupled counts."""
    coupled = next((one for one in plants if isinstance(one, Coupled)), None)
    return Mark(t, deepcopy(wind), coupled, hybrid)


def before(marks: Iterable[Mark], t: float) -> Mark | None:
    """Return the newest mark before time t [s since 1970]; None where there is none."""
    return max((one for one in marks if one.t < t), key=lambda one: one.t, default=None)
