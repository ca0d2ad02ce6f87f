"""Identification step of multirotors: window of flight, rotor model, verification on held-out data, publication."""

import numpy as np

from fleet.contract import Array, Message, Model, Outcome, RotorDynamics, TwinState, Verdict
from fleet.process.sanitise import format_below
from twin_worker.identification.multirotor.output_error import identify
from twin_worker.identification.multirotor.rotor_model import PARAMETERS, RotorModel
from twin_worker.identification.multirotor.rotor_window import DT, RotorWindow, missing_telemetry, rotor_window
from twin_worker.twin.state.state import Twin
from twin_worker.validation.rotors import verify_rotors, verify_since_identification

PERIOD_S = 20.0  # between identifications: the window hardly changes within less [s]
MIN_WINDOW_S = 40.0  # shortest flight for identification [s]
_WINDOW_S = 150.0  # longest window, what the history keeps [s]
_HELD_OUT = 0.4, 56.0  # held-out share of the window, and its maximum [s]
_BASE_S = 60.0  # length of a window whose model is the prior of those after it [s]


def identify_rotors(twin: Twin) -> list[Message]:
    """Identify and verify the rotor model if it is due; return the model with its verdict."""
    newest, rotors = twin.telemetry.history.newest, twin.models.rotors
    if not rotors.timer.due(newest, PERIOD_S if rotors.newest is not None else 0.0):
        return []
    if rotors.base is not None and rotors.base.t1 > newest:
        rotors.forget_times()
    window = _window(twin)
    if window is None or window.seconds < MIN_WINDOW_S:
        if rotors.active is None:
            twin.identification.conclude(_insufficient_data(twin, window))
            twin.prediction.set_learning_state(TwinState.WAITING)
        return []
    rotors.timer.restart(newest)
    share, most = _HELD_OUT
    n_train = len(window) - round(min(share * window.duration, most) / DT)
    begin = int(np.searchsorted(window.t, rotors.base.t1, side="right")) if rotors.base is not None else 0
    try:
        model = identify(window.part(begin, n_train), twin.received_params, rotors.base, rotors.newest)
    except (ValueError, np.linalg.LinAlgError) as error:
        if rotors.active is None:
            sentence = f"{twin.name}: {error}"
            twin.identification.conclude(Verdict(outcome=Outcome.INSUFFICIENT_DATA, sentence=sentence))
        return []
    active = rotors.active
    verdict = verify_rotors(model, window, n_train, name=twin.name, threshold=twin.config.omega, active=active)
    is_valid = verdict.outcome.is_accepted or verdict.outcome is Outcome.WORSE_THAN_LAST
    fails = not is_valid or bool(verdict.derivative_error)
    rotors.store(model, fails=fails, becomes_base=model.t1 - model.t0 >= _BASE_S)
    if active is not None and twin.models.active_verdict is not None:
        twin.models.update_verdict(verify_since_identification(twin.models.active_verdict, active, window, twin.name))
    if _replaces_active(twin, verdict):
        twin.models.activate_rotors(model, verdict)
    twin.identification.conclude(verdict)
    message = rotor_message(twin, window)
    twin.identification.publish(message, float(window.t[-1]))
    return [message]


def _replaces_active(twin: Twin, verdict: Verdict) -> bool:
    """Return whether the newest model becomes the active one: accepted, and verified where the active one is."""
    active = twin.models.active_verdict
    is_verified = active is not None and active.outcome is Outcome.VERIFIED
    return verdict.outcome is Outcome.VERIFIED or (verdict.outcome.is_accepted and not is_verified)


def _window(twin: Twin) -> RotorWindow | None:
    ground_mm = float(twin.home.alt_mm) if twin.home is not None else -np.inf
    return rotor_window(twin.telemetry.history, twin.received_params, seconds=_WINDOW_S, ground_mm=ground_mm)


def _insufficient_data(twin: Twin, window: RotorWindow | None) -> Verdict:
    """Return a verdict with the reason why identification is not possible yet."""
    missing = missing_telemetry(twin.telemetry.history, twin.received_params)
    available = format_below(0.0 if window is None else window.seconds, MIN_WINDOW_S)
    sentence = (
        f"{twin.name}: {available} s of complete flight data, {MIN_WINDOW_S:.0f} s are needed; {missing or 'wait'}"
    )
    return Verdict(outcome=Outcome.INSUFFICIENT_DATA, sentence=f"{sentence}; {twin.models.multirotor}")


def rotor_message(twin: Twin, window: RotorWindow) -> Model:
    """Build the message with the newest verdict and the active rotor model."""
    model = twin.models.rotors.active
    return Model(
        uav=twin.config.uav,
        t=float(window.t[-1]),
        method=twin.config.method,
        verdict=twin.identification.verdict,
        active_verdict=twin.models.active_verdict,
        rotors=rotor_dynamics(model) if model is not None else None,
        window_t0=float(window.t[0]),
        window_s=window.duration,
        wind_n=float(model.wind[0]) if model is not None else 0.0,
        wind_e=float(model.wind[1]) if model is not None else 0.0,
    )


def rotor_dynamics(model: RotorModel) -> RotorDynamics:
    """Return the parameters with their covariance, and the share of each that the flight determined."""
    covariance = model.covariance
    reduction = 1.0 - np.diag(covariance) / np.diag(np.linalg.inv(model.prior_precision))
    return RotorDynamics(
        names=PARAMETERS,
        value=Array.of(model.par, "<f8"),
        covariance=Array.of(covariance, "<f8"),
        variance_reduction=Array.of(np.clip(reduction, 0.0, 1.0)),
        hover_input=model.hover,
        airspeed=model.speed,
        has_command=model.has_command,
        window_t0=model.t0,
        window_s=model.t1 - model.t0,
        sentence=str(model),
    )
