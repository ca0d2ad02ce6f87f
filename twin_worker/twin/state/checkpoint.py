"""Checkpoints of a twin over the last minutes, and the fault effects that its models contain."""

from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass
from datetime import UTC, datetime

from twin_worker.estimation.wind_filter import WindFilter
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel
from twin_worker.identification.fixed_wing.plant import Plant
from twin_worker.identification.fixed_wing.point_mass_model import PointMassModel

CHECKPOINT_PERIOD_S = 10.0  # between checkpoints [s]
MAX_CHECKPOINTS = 15  # number of checkpoints kept; covers the telemetry history


@dataclass(frozen=True)
class Checkpoint:
    """State of one twin at one instant.

    Attributes:
        t: time [s since 1970]
        wind_filter: copy of the wind filter
        derivatives_model: verified stability-and-control model; None before the first
        point_mass: verified point-mass model; None before the first
    """

    t: float
    wind_filter: WindFilter
    derivatives_model: DerivativesModel | None
    point_mass: PointMassModel | None


@dataclass(frozen=True)
class ActiveEffects:
    """Fault effects added to the active model: their names, and the onset [s since 1970]."""

    names: str
    onset: float

    def __str__(self) -> str:
        return f"{self.names} since {datetime.fromtimestamp(self.onset, UTC):%H:%M:%S} UTC"


def create_checkpoint(
    t: float, wind_filter: WindFilter, models: tuple[Plant | None, ...], point_mass: PointMassModel | None
) -> Checkpoint:
    """Create a checkpoint with the first stability-and-control model among `models`."""
    derivatives_model = next((model for model in models if isinstance(model, DerivativesModel)), None)
    return Checkpoint(t, deepcopy(wind_filter), derivatives_model, point_mass)


def latest_before(checkpoints: Iterable[Checkpoint], t: float) -> Checkpoint | None:
    """Return the newest checkpoint before time t [s since 1970]; None if there is none."""
    return max((checkpoint for checkpoint in checkpoints if checkpoint.t < t), key=lambda one: one.t, default=None)
