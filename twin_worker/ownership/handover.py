"""Serialise the complete twin of one aircraft for a handover, so that its new owner continues without a gap."""

from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline

from fleet import contract as c
from fleet.airframes import Airframe
from fleet.airframes.airframe import ServoMap
from fleet.contract import Message, Mismatch
from fleet.frames import Origin
from twin_worker.alerts.hysteresis import AlertState, PendingAlert
from twin_worker.confidence.adaptive_conformal import AdaptiveLevels, ScaleFactors
from twin_worker.confidence.prediction_log import PredictionLog
from twin_worker.confidence.table_files import TableSet
from twin_worker.confidence.table_files import load as load_tables
from twin_worker.confidence.tube_and_horizon import Confidence, ConfidenceTracker, LaggedForecasts, PointForecast
from twin_worker.estimation.wind_filter import WindFilter
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel
from twin_worker.identification.fixed_wing.energy_balance import RegressionResult
from twin_worker.identification.fixed_wing.point_mass_model import PointMassModel
from twin_worker.identification.linear.linear_model import AxisModel
from twin_worker.ownership.typed_serialization import ClassCodec, ClassRegistry, deserialise, serialise
from twin_worker.prediction.autopilot_identification import AutopilotEstimate
from twin_worker.prediction.autopilot_parameters import ControllerTwin
from twin_worker.prediction.kinematic import KinematicModel
from twin_worker.prediction.method_selection import MethodSelector
from twin_worker.prediction.multirotor.rollout import MultirotorModel
from twin_worker.telemetry.history import ArrivalDelay, RowBuffer, TelemetryHistory
from twin_worker.telemetry.resample import Resampler
from twin_worker.twin.state.budget import ComputeBudget, Schedule, Timer
from twin_worker.twin.state.events import FlightEvent
from twin_worker.twin.state.flight_phase import FlightPhase
from twin_worker.twin.state.inputs import Environment, OnboardState, Telemetry
from twin_worker.twin.state.models import ActiveEffects, Checkpoint, Identification, ModelBank, VerifiedModel
from twin_worker.twin.state.outputs import AlertingState, ConfidenceState, PredictionState
from twin_worker.twin.state.state import Twin, TwinConfig
from twin_worker.validation.forecast_shrinkage import Shrinkage


@dataclass
class Snapshot:
    """Data of one aircraft in a handover.

    Attributes:
        twin: complete state of the twin
        inbox: queued messages, oldest first
        traffic_alerts: its open traffic alerts
        mismatch: newest mismatch; None: none
    """

    twin: Twin
    inbox: list[Message] = field(default_factory=list)
    traffic_alerts: AlertState = field(default_factory=AlertState)
    mismatch: Mismatch | None = None


def _build_spline(parts: tuple[np.ndarray, np.ndarray]) -> CubicSpline:
    x, coefficients = parts
    if coefficients.ndim != 3 or coefficients.shape[:2] != (4, len(x) - 1):
        raise TypeError(f"a spline of {coefficients.shape} over {len(x)}")
    return CubicSpline.construct_fast(coefficients, x, extrapolate=True, axis=0)


def _build_rows(parts: tuple[np.ndarray, np.ndarray]) -> RowBuffer:
    t, x = parts
    if t.ndim != 1 or x.ndim != 2 or len(t) != len(x) or {t.dtype, x.dtype} != {np.dtype(float)}:
        raise TypeError(f"rows of {x.shape} at {t.shape}")
    return RowBuffer(t, x)


_MESSAGE_TYPES = (
    c.Status,
    c.Mission,
    c.Params,
    c.Sample,
    c.Model,
    c.Prediction,
    c.Mismatch,
    c.Alert,
    c.Verdict,
    c.Item,
)
_VALUE_TYPES = (c.TwinState, c.Event, c.AlertKind, Origin)
_STATE_TYPES = (
    *(
        Snapshot,
        Twin,
        TwinConfig,
        Telemetry,
        OnboardState,
        Environment,
        Identification,
        ModelBank,
        PredictionState,
        ConfidenceState,
        AlertingState,
        Timer,
        TelemetryHistory,
        Resampler,
        WindFilter,
        ConfidenceTracker,
        AlertState,
        PendingAlert,
        MultirotorModel,
        KinematicModel,
        AutopilotEstimate,
        MethodSelector,
        Shrinkage,
        Checkpoint,
    ),
    *(
        DerivativesModel,
        AxisModel,
        PointMassModel,
        RegressionResult,
        VerifiedModel,
        ActiveEffects,
        FlightPhase,
        FlightEvent,
        ControllerTwin,
        LaggedForecasts,
        PredictionLog,
        AdaptiveLevels,
        ScaleFactors,
    ),
    *(PointForecast, Confidence, Airframe, ServoMap, Schedule, ArrivalDelay),
)
REGISTRY: ClassRegistry = {
    **{one.__name__: one for one in (*_MESSAGE_TYPES, *_VALUE_TYPES, *_STATE_TYPES)},
    "RowBuffer": (RowBuffer, ClassCodec(RowBuffer.rows, _build_rows)),
    "CubicSpline": (CubicSpline, ClassCodec(lambda one: (one.x, one.c), _build_spline)),
    "ComputeBudget": (ComputeBudget, ClassCodec(lambda _: None, lambda _: None)),  # the new driver has its own
    "TableSet": (TableSet, ClassCodec(lambda _: None, lambda _: load_tables())),  # installed with every worker
}


def encode_snapshot(snapshot: Snapshot) -> bytes:
    """Encode a snapshot."""
    return serialise(snapshot, REGISTRY)


def decode_snapshot(data: bytes, uav: int) -> Snapshot:
    """Decode a snapshot.

    Raises:
        ValueError: when the bytes are not a twin of this aircraft; start it from published data instead.
    """
    snapshot = deserialise(data, REGISTRY)
    if not isinstance(snapshot, Snapshot) or not isinstance(snapshot.twin, Twin) or snapshot.twin.config.uav != uav:
        raise ValueError(f"uav-{uav}: found another object, expected its twin; it starts without a snapshot")
    if (
        not isinstance(snapshot.twin.telemetry.history, TelemetryHistory)
        or not snapshot.twin.telemetry.history.is_consistent()
    ):
        raise ValueError(f"uav-{uav}: found other telemetry columns, expected ours; it starts without a snapshot")
    return snapshot
