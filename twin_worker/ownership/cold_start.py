"""Start a twin without a snapshot: from the last minutes of telemetry and the last published model."""

from collections.abc import Mapping

import msgspec
import numpy as np

from fleet.bus.session import Bus
from fleet.contract import (
    COLUMNS,
    Array,
    History,
    Message,
    Mission,
    Model,
    Params,
    Prediction,
    RotorDynamics,
    Rows,
    Sample,
    Status,
    Verdict,
)
from fleet.physics.wrench import N_PAR, NAMES
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel, prior
from twin_worker.identification.multirotor.output_error import FIRST_STD
from twin_worker.identification.multirotor.rotor_model import HIGH, LOW, PARAMETERS, RotorModel
from twin_worker.twin.state.models import VerifiedModel
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps.extrapolate import MAX_ROLLOUT_AGE_S

LATCHED_TYPES: tuple[type[Message], ...] = (Status, Params, Mission)
"""Rare messages of which the last one stays valid."""
_QUERY_TIMEOUT_S = 0.5  # for one message from a gateway [s]
_HISTORY_TIMEOUT_S = 2.0  # for a history of several megabytes [s]
_TRIES = 2  # large answers are dropped on a congested link
_DEFAULT_TRIM_INPUT = np.array([0.0, 0.0, 0.0, 0.5])  # trim inputs, as none are published
_HISTORY_DECODER = msgspec.msgpack.Decoder(History)


def query_history(bus: Bus, uav: int, cached: Mapping[type, Message]) -> list[Message]:
    """Query the past messages of an aircraft for a new twin; types in `cached` are not queried.

    Raises:
        ConnectionError: when the session is closed; stop, the worker is shutting down.
    """
    latched: list[Message] = []
    for kind in LATCHED_TYPES:
        latched += (
            [cached[kind]] if kind in cached else [message for message, _ in bus.get(kind, uav, _QUERY_TIMEOUT_S)]
        )
    for _ in range(_TRIES):
        samples = [
            sample
            for sample in map(decode_history, bus.get_payloads(History, uav, _HISTORY_TIMEOUT_S))
            if sample is not None and sample.uav == uav
        ]
        if samples:
            return [*latched, *samples]
    return latched


def decode_history(payload: bytes) -> Sample | None:
    """Decode a `History` into one sample with all its rows; None if it is invalid or empty.

    Rows are skipped if their shape does not match their byte count, or their dtype is not that of the newest rows.
    """
    try:
        history = _HISTORY_DECODER.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
    joined = {}
    for kind, columns in COLUMNS.items():
        received = [rows for sample in history.samples if (rows := getattr(sample, kind)) is not None]
        valid = [rows for rows in received if _is_consistent(rows, len(columns))]
        parts = [rows for rows in valid if rows.x.dtype == valid[-1].x.dtype]
        if parts:
            n, t, x = (
                sum(rows.t.shape[0] for rows in parts),
                b"".join([rows.t.data for rows in parts]),
                b"".join([rows.x.data for rows in parts]),
            )
            joined[kind] = Rows(t=Array("<f8", (n,), t), x=Array(parts[0].x.dtype, (n, len(columns)), x))
    return Sample(uav=history.uav, t=history.t, **joined) if joined else None


def _is_consistent(rows: Rows, columns: int) -> bool:
    try:
        t, x = rows.t.numpy(), rows.x.numpy()
    except ValueError:
        return False
    return rows.t.dtype == "<f8" and t.ndim == 1 and len(t) > 0 and x.shape == (len(t), columns)


def restore_model(twin: Twin, model: Model) -> bool:
    """Restore a published model of another worker in a new twin; return whether this was possible.

    The message contains neither the point-mass model nor the prior. The complete covariance counts as information from
    the model's own window, so that no data count twice when that window is identified again.
    """
    if model.active_verdict is None or not model.active_verdict.outcome.is_accepted:
        return False
    sentence = f"{model.active_verdict.sentence}; taken over from another worker"
    verdict = msgspec.structs.replace(model.active_verdict, sentence=sentence)
    if model.rotors is not None:
        return _restore_rotors(twin, model, model.rotors, verdict)
    plant = _decode_model(twin, model)
    if plant is None:
        return False
    twin.models.activate(VerifiedModel(plant, verdict, model.t, float("nan")))
    twin.identification.restore(model, verdict, plant)
    twin.prediction.set_state(twin.models.state)
    twin.environment.wind.reset_wind(model.t, np.array([model.wind_n, model.wind_e, 0.0]))
    return True


def _restore_rotors(twin: Twin, model: Model, rotors: RotorDynamics, verdict: Verdict) -> bool:
    """Restore the rotor model of a message; return whether it is valid."""
    try:
        par, covariance = rotors.value.numpy().astype(float), rotors.covariance.numpy().astype(float)
        information = np.linalg.inv(covariance)
    except (ValueError, np.linalg.LinAlgError):
        return False
    n = len(PARAMETERS)
    if rotors.names != PARAMETERS or par.shape != (n,) or information.shape != (n, n):
        return False
    if not (np.isfinite(par).all() and np.isfinite(information).all() and (par >= LOW).all() and (par <= HIGH).all()):
        return False
    restored = RotorModel(
        par=par,
        information=0.5 * (information + information.T),
        prior_precision=information,
        weight=FIRST_STD**-2.0,
        has_command=rotors.has_command,
        hover=rotors.hover_input,
        speed=rotors.airspeed,
        t0=rotors.window_t0,
        t1=rotors.window_t0 + rotors.window_s,
        steps=0,
    )
    twin.models.rotors.restore(restored)
    twin.models.activate_rotors(restored, verdict)
    twin.identification.restore(model, verdict)
    twin.prediction.set_state(twin.models.state)
    return True


def stagger_work(twin: Twin, phase: float, *, has_prediction: bool, has_model: bool) -> None:
    """Delay the first work of a twin by a share of its period, so that many takeovers are spread over time.

    Args:
        twin: twin with past messages ingested
        phase: share of a period, 0..1
        has_prediction: a prediction can be propagated meanwhile; otherwise the first rollout runs at once
        has_model: a model exists; otherwise the first identification runs at once
    """
    newest, pace = twin.telemetry.history.newest, twin.config.schedule
    twin.prediction.predict_timer.restart(newest - (1.0 - phase) * pace.predict if has_prediction else -np.inf)
    twin.identification.timer.restart(newest - (1.0 - phase) * pace.identify if has_model else -np.inf)


def continue_prediction(twin: Twin, prediction: Prediction) -> bool:
    """Propagate the last published prediction of another worker until the twin has its own; return whether it is valid.

    The twin adopts the origin of the local frame. The path can be up to one period old; the tube is widened.
    """
    try:
        ahead, tube = prediction.ahead.numpy(), prediction.prediction_region_half_axes.numpy()
        shapes = [
            (array.dtype, array.numpy().shape)
            for array in (prediction.ahead, prediction.path, prediction.prediction_region_half_axes)
        ]
    except (ValueError, TypeError):
        return False
    n = len(ahead) if ahead.ndim else 0
    if n < 2 or shapes != [("<f4", (n,)), *[("<f4", (n, 3))] * 2]:
        return False
    age = min(twin.config.schedule.predict, MAX_ROLLOUT_AGE_S)
    later = np.column_stack([np.interp(ahead + age, ahead, half_axis) for half_axis in tube.T])
    prediction = msgspec.structs.replace(
        prediction,
        prediction_region_half_axes=Array.of(np.maximum(tube, later)),
        horizon_s=max(prediction.horizon_s - age, 0.0),
        sentence=f"{prediction.sentence}; continued from another worker",
    )
    twin.telemetry.set_origin(prediction.ned_origin())
    twin.prediction.publish(prediction)
    twin.prediction.set_rollout(prediction, is_continued=True)
    twin.prediction.predict_timer.restart(prediction.t)
    return True


def _decode_model(twin: Twin, model: Model) -> DerivativesModel | None:
    """Return the derivatives model of a message; None if it has none or an invalid one."""
    derivatives = model.derivatives
    if derivatives is None or derivatives.names != NAMES or derivatives.prior != twin.config.airframe.name:
        return None
    try:
        par, covariance = derivatives.value.numpy().astype(float), derivatives.covariance.numpy().astype(float)
        precision = np.linalg.inv(covariance)
    except (ValueError, np.linalg.LinAlgError):
        return None
    trim_velocity = np.array([derivatives.U0, derivatives.W0])
    valid = par.shape == (N_PAR,) and precision.shape == (N_PAR, N_PAR) and derivatives.U0 > 0
    if not valid or not all(np.isfinite(values).all() for values in (par, precision, trim_velocity)):
        return None
    mean, sigma = prior(
        twin.config.airframe, trim_velocity, _DEFAULT_TRIM_INPUT, np.array([model.wind_n, model.wind_e])
    )
    prior_precision = np.diag(sigma**-2.0)
    t0 = derivatives.window_t0
    return DerivativesModel(
        par,
        trim_velocity,
        precision,
        mean,
        prior_precision,
        np.ones(9),
        (mean, prior_precision),
        t0,
        t0 + max(derivatives.window_s, 1.0),
        steps=0,
    )
