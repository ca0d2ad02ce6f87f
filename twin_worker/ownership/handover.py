"""Serialise the complete twin of one aircraft for a handover, so that its new owner continues without a gap."""

from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline

from fleet import contract as c
from fleet.airframes import Airframe
from fleet.airframes.airframe import ServoMap
from fleet.contract import Message, Mismatch
from fleet.frames import Origin
from twin_worker.alerts.hysteresis import Ledger, Open
from twin_worker.confidence.adaptive_conformal import Factors, Levels
from twin_worker.confidence.lagged_ensemble import Earlier
from twin_worker.confidence.prediction_log import Ledger as Book
from twin_worker.confidence.table_files import Tables
from twin_worker.confidence.table_files import load as load_tables
from twin_worker.confidence.tube_and_horizon import Made, Record, Trust
from twin_worker.estimation.wind_filter import WindFilter
from twin_worker.identification.fixed_wing.derivatives_model import Coupled
from twin_worker.identification.fixed_wing.energy_balance import Ridge
from twin_worker.identification.fixed_wing.point_mass_model import Hybrid
from twin_worker.identification.linear.linear_model import Axis
from twin_worker.ownership.typed_serialization import Known, Special, pack, unpack
from twin_worker.prediction.autopilot_identification import Learnt
from twin_worker.prediction.autopilot_parameters import Control
from twin_worker.prediction.kinematic import Grey
from twin_worker.prediction.method_selection import Contest
from twin_worker.prediction.multirotor.rollout import Rotor
from twin_worker.telemetry.arrival_delay import Delay
from twin_worker.telemetry.history import History
from twin_worker.telemetry.resample import Grid
from twin_worker.telemetry.row_buffer import Kept
from twin_worker.twin.state.budget import Quota
from twin_worker.twin.state.checkpoint import Extension, Mark
from twin_worker.twin.state.events import Note
from twin_worker.twin.state.flight_phase import Ground
from twin_worker.twin.state.schedule import Pace
from twin_worker.twin.state.state import Believed, Twin
from twin_worker.validation.forecast_shrinkage import Earned


@dataclass
class Load:
    """Data of one aircraft in a handover.

    Attributes:
        twin: complete state of the twin
        inbox: queued messages, oldest first
        traffic_alerts: its open traffic alerts
        mismatch: newest mismatch; None: none
    """

    twin: Twin
    inbox: list[Message] = field(default_factory=list)
    conflicts: Ledger = field(default_factory=Ledger)
    mismatch: Mismatch | None = None


def _spline(parts: tuple[np.ndarray, np.ndarray]) -> CubicSpline:
    x, coefficients = parts
    if coefficients.ndim != 3 or coefficients.shape[:2] != (4, len(x) - 1):
        raise TypeError(f"a spline of {coefficients.shape} over {len(x)}")
    return CubicSpline.construct_fast(coefficients, x, extrapolate=True, axis=0)


def _kept(parts: tuple[np.ndarray, np.ndarray]) -> Kept:
    t, x = parts
    if t.ndim != 1 or x.ndim != 2 or len(t) != len(x) or {t.dtype, x.dtype} != {np.dtype(float)}:
        raise TypeError(f"rows of {x.shape} at {t.shape}")
    return Kept(t, x)


_WIRE = (c.Status, c.Mission, c.Params, c.Sample, c.Model, c.Prediction, c.Mismatch, c.Alert, c.Verdict, c.Item)
_NAMED = (c.State, c.Event, c.AlertKind, Origin)
_OURS = (
    *(Load, Twin, History, Grid, WindFilter, Record, Ledger, Open, Rotor, Grey, Learnt, Contest, Earned, Mark),
    *(Coupled, Axis, Hybrid, Ridge, Believed, Extension, Ground, Note, Control, Earlier, Book, Levels, Factors),
    *(Made, Trust, Airframe, ServoMap, Pace, Delay),
)
CARRIED: Known = {
    **{one.__name__: one for one in (*_WIRE, *_NAMED, *_OURS) if one is not Book},
    "Book": Book,
    "Kept": (Kept, Special(Kept.whole, _kept)),
    "CubicSpline": (CubicSpline, Special(lambda one: (one.x, one.c), _spline)),
    "Quota": (Quota, Special(lambda _: None, lambda _: None)),  # the new driver has its own
    "Tables": (Tables, Special(lambda _: None, lambda _: load_tables())),  # installed with every worker
}


def packed(load: Load) -> bytes:
    """Encode a snapshot."""
    return pack(load, CARRIED)


def unpacked(data: bytes, uav: int) -> Load:
    """Decode a snapshot.

    Raises:
        ValueError: when the bytes are not a twin of this aircraft; start it from published data instead.
    """
    load = unpack(data, CARRIED)
    if not isinstance(load, Load) or not isinstance(load.twin, Twin) or load.twin.uav != uav:
        raise ValueError(f"uav-{uav}: found another object, expected its twin; it starts without a snapshot")
    if not isinstance(load.twin.history, History) or not load.twin.history.sound():
        raise ValueError(f"uav-{uav}: found other telemetry columns, expected ours; it starts without a snapshot")
    return load
