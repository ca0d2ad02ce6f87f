"""Identification step: requirements, window, identification, verification on held-out data, selection, publication."""

from functools import partial
from math import log2

import msgspec
import numpy as np

from fleet.contract import Array, Derivatives, LinearModel, Message, Model, Outcome, TwinState, Verdict
from fleet.frames import G
from fleet.physics.simulate import TAU
from fleet.physics.wrench import NAMES
from fleet.process.sanitise import format_below
from fleet.window import LONGEST_GAP, MAX_GAP_S, Window
from twin_worker.identification.fixed_wing import derivatives_model
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel, TypePrior, linearise
from twin_worker.identification.fixed_wing.plant import PAPER, Plant
from twin_worker.identification.fixed_wing.siblings import prior_of_type, sibling_data
from twin_worker.identification.linear.linear_model import AXES, identify_axis
from twin_worker.prediction.closed_loop import InitialCondition, fly_from, synchronise_controller
from twin_worker.prediction.replay_window import Rollout
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.telemetry.resample import DT
from twin_worker.telemetry.track import SETTLING_S, hovering_mask
from twin_worker.twin.state.budget import LONGEST_PERIOD_S
from twin_worker.twin.state.models import VerifiedModel
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps.kinematic_prediction import fit_kinematic_models
from twin_worker.twin.steps.point_mass_step import update_point_mass
from twin_worker.twin.steps.rotor_step import identify_rotors
from twin_worker.validation.held_out import HeldOut
from twin_worker.validation.verify import verify, verify_since_identification, with_consistency, with_diagnostics

SHRINKAGE_LOOKAHEAD_S = 10.0  # look-ahead of the published shrinkage weights [s]
_MIN_DATA_SHARE = 0.5  # reduction of the prior variance above which a parameter counts as determined by the data [-]


def model_message(twin: Twin, window: Window) -> Model:
    """Build the message with the newest verdict and the active model; a failed identification is never published."""
    plant, derivatives = twin.models.active_model, None
    axes: tuple[LinearModel | None, LinearModel | None] = (None, None)
    if isinstance(plant, DerivativesModel):
        axes, derivatives = linearise(plant, window), derivatives_message(plant, twin.config.airframe.name)
        kind, throttle = airframe_type(twin), float(window.u[window.ok, 3].mean())
        data = sibling_data(plant, throttle, kind) if kind else None
        derivatives = msgspec.structs.replace(derivatives, data=data, siblings=plant.siblings)
    elif plant is not None:
        axes = plant[0].linear(), plant[1].linear()
    return Model(
        uav=twin.config.uav,
        t=float(window.t[-1]),
        method=twin.config.method,
        verdict=twin.identification.verdict,
        active_verdict=twin.models.active_verdict,
        longitudinal=axes[0],
        lateral=axes[1],
        derivatives=derivatives,
        shrinkage_weights=twin.identification.shrinkage.kappa_at(SHRINKAGE_LOOKAHEAD_S) if derivatives else {},
        window_t0=float(window.t[0]),
        window_s=window.seconds,
        interpolated=float(window.filled.mean()),
        wind_n=float(twin.environment.wind.wind[0]),
        wind_e=float(twin.environment.wind.wind[1]),
        active_effect=str(twin.models.active_effect or ""),
    )


def derivatives_message(plant: DerivativesModel, airframe: str) -> Derivatives:
    """Return the parameters with their covariance, and the share of each determined by the data."""
    covariance = plant.covariance
    prior_covariance = np.linalg.inv(plant.prior_precision)
    data_share = 1.0 - np.diag(covariance) / np.diag(prior_covariance)
    return Derivatives(
        names=NAMES,
        value=Array.of(plant.par, "<f8"),
        covariance=Array.of(covariance),
        variance_reduction=Array.of(np.clip(data_share, 0.0, 1.0)),
        U0=float(plant.trim_velocity[0]),
        W0=float(plant.trim_velocity[1]),
        tau_s=Array.of(TAU),
        prior=airframe,
        window_t0=plant.t0,
        window_s=plant.t1 - plant.t0,
        sentence=_describe(data_share, airframe),
    )


def _describe(data_share: np.ndarray, airframe: str) -> str:
    """Describe which parameters come from the data and which from the prior."""
    by_data = int((data_share > _MIN_DATA_SHARE).sum())
    from_prior = [name for name, share in zip(NAMES, data_share, strict=True) if share <= _MIN_DATA_SHARE]
    suffix = f"; from the prior: {' '.join(from_prior)}" if from_prior else ""
    return f"{by_data} of {len(NAMES)} parameters determined by the data, prior {airframe}{suffix}"


_MASS_PARAMETERS = ("WEIGHT_GROSS", "WEIGHT_BASE")  # of PX4 [kg]
_MASS_CLASSES = 2.0  # per factor of 2 in mass
_MAX_AIRSPEED_RATIO = 1.25  # of aircraft of one type: another wing loading is another type


def airframe_type(twin: Twin) -> str:
    """Return the type of aircraft: vehicle, airframe parameter or file, mass class; empty: it is not known.

    An airframe file that describes a class of aircraft names no type, nor does an airframe parameter of 0.
    """
    airframe, params = twin.config.airframe, twin.received_params
    autostart = int(params.get("SYS_AUTOSTART", 0.0))
    if not twin.vehicle_class.has_wings or (airframe.scale and not autostart):
        return ""
    masses = [params[name] for name in _MASS_PARAMETERS if params.get(name, 0.0) > 0.0]
    mass = masses[0] if masses else 0.0 if airframe.scale else airframe.value["mass"]
    mass_class = (
        f"{2.0 ** (round(_MASS_CLASSES * log2(mass)) / _MASS_CLASSES):.1f} kg" if mass > 0.0 else "mass unknown"
    )
    return f"{twin.vehicle}, {airframe.name}, {autostart}, {mass_class}"


def _type_prior(twin: Twin, window: Window) -> TypePrior | None:
    """Return the prior that aircraft of its type have learnt, for a first model; None: there is none that fits."""
    siblings = twin.identification.siblings
    if siblings is None or twin.identification.prior_model is not None or twin.config.method == PAPER:
        return None
    if siblings.airframe_type != airframe_type(twin):
        return None
    airspeed = float(np.linalg.norm(window.x[window.ok, :3], axis=1).mean()) if window.ok.any() else 0.0
    if not 1.0 / _MAX_AIRSPEED_RATIO < airspeed / siblings.airspeed < _MAX_AIRSPEED_RATIO:
        return None
    return TypePrior(len(set(siblings.uavs) - {twin.config.uav}), partial(prior_of_type, siblings))


SELECTION_PERIOD_S = 6.0  # between closed-loop runs of the same models [s]
_HINDCAST_S = 20.0  # length of the closed-loop run over the newest data [s]
_MAX_MODELS = 3  # number of verified models kept
_NEW_MODEL_FACTOR = 1.2  # factor on the error of a new model, which has only one run so far [-]


def select_model(twin: Twin, window: Window, n_train: int, plant: Plant, verdict: Verdict) -> Verdict:
    """Run every verified model in closed loop over the newest data and activate the one with the lowest error.

    An active model that is older is verified anew, on all data since its identification.

    Args:
        twin: its list of verified models is updated
        window: flight; rows from `n_train` on are held out
        n_train: first held-out row
        plant: newest model
        verdict: open-loop verdict of `plant`
    Returns:
        the verdict, changed if the closed-loop result contradicts it
    """
    if not _selection_due(twin, window):
        return verdict
    twin.models.scored.restart(float(window.t[-1]))
    start = max(n_train, len(window) - 1 - int(_HINDCAST_S / window.dt))
    initial = synchronise_controller(twin.situation(window.part(0, start + 1))) if not twin.no_route_reason() else None
    for model in twin.models.verified_models:
        model.update_error(hindcast_error(initial, window, start, model.plant))
    if verdict.outcome.is_accepted:
        verdict = _add_verified(twin, window, plant, verdict, hindcast_error(initial, window, start, plant))
    best = twin.models.select(_MAX_MODELS)
    if best is None:
        return verdict
    if best.plant is not plant:
        twin.models.update_verdict(verify_since_identification(best.verdict, best.plant, window, twin.name))
    if verdict.outcome.is_accepted and best.plant is not plant:
        sentence = f"{verdict.sentence}; but an earlier model has a lower closed-loop error and stays active"
        return msgspec.structs.replace(verdict, outcome=Outcome.WORSE_THAN_LAST, sentence=sentence)
    return verdict


def _selection_due(twin: Twin, window: Window) -> bool:
    return not twin.models.verified_models or window.t[-1] - twin.models.scored.last >= SELECTION_PERIOD_S


def _add_verified(twin: Twin, window: Window, plant: Plant, verdict: Verdict, error: float) -> Verdict:
    """Add an accepted model, unless its closed-loop run on the route diverges."""
    if np.isinf(error):
        sentence = f"{verdict.sentence}; but the closed-loop run leaves the flight envelope; identification is repeated"
        return msgspec.structs.replace(verdict, outcome=Outcome.DIVERGED, sentence=sentence)
    twin.models.add(VerifiedModel(plant, verdict, float(window.t[-1]), _NEW_MODEL_FACTOR * error))
    return verdict


def hindcast_error(initial: InitialCondition | Rollout | None, window: Window, start: int, plant: Plant) -> float:
    """Return the mean closed-loop position error from row `start` to the end [m]; inf: diverged, nan: no route."""
    if not isinstance(initial, InitialCondition):
        return np.nan
    ahead = np.arange(0.0, int((len(window) - 1 - start) * window.dt) + 1.0)
    rollout = fly_from(initial, plant, ahead)
    if rollout.path is None:
        return np.inf
    rows = start + np.rint(ahead / window.dt).astype(int)
    return float(np.linalg.norm(rollout.path - window.p[rows], axis=1).mean())


_REQUIRED_HZ = dict.fromkeys(LONGEST_GAP, 1.0 / MAX_GAP_S)  # minimum rates: slower rows are gaps
_RATE_WINDOW_S = 20.0  # window of the rate [s]


def rate_hz(history: TelemetryHistory, kind: str) -> float:
    """Return the recent rate of one kind of row [Hz]; 0 without rows."""
    t, _ = history.rows_since(kind, history.newest - _RATE_WINDOW_S)
    if not len(t):
        return 0.0
    gaps = np.diff(t)
    return float(1.0 / np.median(gaps)) if len(gaps) else 1.0 / _RATE_WINDOW_S


def missing_telemetry(history: TelemetryHistory) -> str:
    """Describe which kinds of row are missing or too slow; empty if telemetry is sufficient."""
    absent = [kind for kind in (*_REQUIRED_HZ, "air") if not len(history.rows_since(kind)[0])]
    slow = {kind: rate_hz(history, kind) for kind in _REQUIRED_HZ if kind not in absent}
    problems = [f"no {', '.join(absent)} rows yet"] if absent else []
    problems += [
        f"{kind} at {rate:.1f} Hz, identification needs {_REQUIRED_HZ[kind]:g} Hz"
        for kind, rate in slow.items()
        if rate < 0.9 * _REQUIRED_HZ[kind]
    ]
    return "; ".join(problems)


MIN_WINDOW_S = 30.0  # shortest window for identification [s]
_MIN_SIBLING_WINDOW_S = 14.0  # the same with a prior learnt from aircraft of its type [s]
_SIBLING_TRAINING_S = 5.0  # of such a window that is not held out [s]
MIN_WING_SPEED = 6.0  # forward airspeed below which no flight on wings is possible [m/s]
_WINDOW_FACTOR = 17.0  # window length in U0 / g: faster aircraft have slower modes [-]
_WINDOW_LIMITS_S = 35.0, 95.0  # limits of the window length [s]
_PAPER_WINDOW_S = 120.0  # window length of `--method paper` [s]
_HOLD_OUT_S = 8.2, 20.0, 40.2  # hold-out length: minimum; maximum of `--method paper`; maximum [s]
_HOLD_OUT_FRACTION = 0.3, 0.5  # held-out share of the window: `--method paper`, others [-]
_FREE_RUN_S = (2.0, 4.0, 2.0, 8.0)  # free-run length of the n-th attempt of `--method paper` [s]
_WINDOW_FRACTION = (1.0, 1.0, 0.6, 1.0)  # share of the window used by the n-th attempt [-]
_RUN_S, _RUN_EVERY_S = 20.0, 5.0  # free runs for the forecast shrinkage: length, period [s]
_COLD_START_PERIOD_S = 4.0  # between identifications without a warm start [s]
_PUBLISH_PERIOD_S = 10.0  # between published models without a changed outcome [s]


def identify_and_verify(twin: Twin) -> list[Message]:
    """Identify and verify once; return the model with its verdict if it is due, nothing if data are insufficient."""
    fit_kinematic_models(twin)
    if twin.vehicle_class.is_rotorcraft:
        return identify_rotors(twin)
    if twin.vehicle_class.has_wings:
        update_point_mass(twin)
    window = _fixed_wing_part(twin, twin.window(_window_length_s(twin) + _max_hold_out_s(twin)))
    no_data_verdict = _insufficient_data(twin, window)
    if window is None or no_data_verdict is not None:
        if twin.models.active_model is None and no_data_verdict is not None:
            twin.identification.conclude(no_data_verdict)
            twin.prediction.set_learning_state(TwinState.WAITING)
        return []
    if twin.models.active_model is None:
        twin.prediction.set_learning_state(TwinState.IDENTIFYING)
    of_type = _type_prior(twin, window)
    fraction = _HOLD_OUT_FRACTION[twin.config.method != PAPER]
    held_out = fraction * len(window) if of_type is None else len(window) - _SIBLING_TRAINING_S / DT
    n_train = len(window) - int(np.clip(held_out, *_hold_out_limits(twin)))
    twin.identification.used(_regressors(window))
    try:
        plant = _identify(twin, window.part(0, n_train), of_type)
    except (ValueError, np.linalg.LinAlgError) as error:
        attempts, sentence = twin.identification.tries, f"{twin.name}: {error}"
        twin.identification.conclude(Verdict(outcome=Outcome.INSUFFICIENT_DATA, sentence=sentence, attempts=attempts))
        return []
    verdict = verify(
        plant, window, n_train, twin.config.omega, twin.models.active_model if twin.config.method != PAPER else None
    )
    verdict = msgspec.structs.replace(
        verdict, sentence=f"{twin.name}: {verdict.sentence}", attempts=twin.identification.tries
    )
    repeat = window.t[-1] - twin.identification.published.last >= _PUBLISH_PERIOD_S
    if repeat or _selection_due(twin, window) or _outcome_changed(verdict, twin.identification.verdict):
        verdict = with_consistency(verdict, plant, window, n_train)
    verdict = select_model(twin, window, n_train, plant, verdict)
    if verdict.outcome.is_accepted and isinstance(plant, derivatives_model.DerivativesModel):
        twin.identification.store_prior(plant)
    publish = _outcome_changed(verdict, twin.identification.verdict) or repeat
    twin.identification.conclude(verdict)
    if not publish:
        return []
    unseen = HeldOut(plant, window, n_train)
    twin.identification.conclude(with_diagnostics(verdict, unseen))
    shrinkage_sample = unseen.shrinkage_sample(_RUN_S, _RUN_EVERY_S)
    if shrinkage_sample is not None:
        twin.identification.shrinkage.update(*shrinkage_sample, window.dt)
    message = model_message(twin, window)
    twin.identification.publish(message, float(window.t[-1]))
    return [message]


def update_information(twin: Twin) -> None:
    """Compare telemetry since the last identification with its window, from the first verified model on."""
    since_s = twin.telemetry.last_step_t - twin.identification.timer.last
    if twin.models.active_model is None or not 0.0 < since_s < LONGEST_PERIOD_S:
        twin.identification.expect_news()
    elif (window := twin.window(since_s)) is not None:
        twin.identification.add_data(_regressors(window))


def _regressors(window: Window) -> np.ndarray:
    """Return what the derivatives multiply: airspeeds, rates and inputs of the measured rows, (n, 10)."""
    return np.hstack([window.x[:, :6], window.u])[window.ok]


def _outcome_changed(verdict: Verdict, previous: Verdict) -> bool:
    """Return whether the outcome changed; alternation between two valid outcomes does not count."""
    valid = (Outcome.VERIFIED, Outcome.PLAUSIBLE, Outcome.WORSE_THAN_LAST)
    return verdict.outcome is not previous.outcome and not (verdict.outcome in valid and previous.outcome in valid)


def _window_length_s(twin: Twin) -> float:
    if twin.config.method == PAPER:
        return _PAPER_WINDOW_S
    speed = float(twin.identification.warm_start.trim_velocity[0]) if twin.identification.warm_start else 0.0
    return float(np.clip(_WINDOW_FACTOR * speed / G, *_WINDOW_LIMITS_S))


def _max_hold_out_s(twin: Twin) -> float:
    return _HOLD_OUT_S[1 + (twin.config.method != PAPER)]


def _hold_out_limits(twin: Twin) -> tuple[float, float]:
    return _HOLD_OUT_S[0] / DT, _max_hold_out_s(twin) / DT


def _insufficient_data(twin: Twin, window: Window | None) -> Verdict | None:
    """Return a verdict with the reason if identification is not possible yet; None otherwise."""
    available_s = 0.0 if window is None else float(window.ok.sum() * DT)
    needed_s = MIN_WINDOW_S if window is None or _type_prior(twin, window) is None else _MIN_SIBLING_WINDOW_S
    if window is not None and available_s >= needed_s:
        return None
    condition = " on its wings" if twin.vehicle_class.is_vtol else ""
    missing = missing_telemetry(twin.telemetry.history) or "wait"
    sentence = (
        f"{twin.name}: {format_below(available_s, MIN_WINDOW_S)} s of complete data{condition}, "
        f"{MIN_WINDOW_S:.0f} s are needed; {missing}"
    )
    return Verdict(outcome=Outcome.INSUFFICIENT_DATA, sentence=sentence)


def _identify(twin: Twin, training: Window, of_type: TypePrior | None = None) -> Plant:
    """Identify the aircraft; each further attempt uses another initial value or another share of the window.

    What aircraft of its type have learnt is used in every other attempt, so that it cannot mislead for long.
    """
    attempt, t_end = twin.identification.tries % len(_WINDOW_FRACTION), float(training.t[-1])
    if twin.config.method != PAPER and not twin.identification.fresh_start.due(t_end, _COLD_START_PERIOD_S):
        attempt = 0  # a cold start on nearly the same window would return the same result
    else:
        twin.identification.count_try()
    of_type = None if attempt % 2 else of_type
    training = training.part(int(len(training) * (1 - _WINDOW_FRACTION[attempt])), len(training))
    if twin.config.method != PAPER:
        newest, prior_model = twin.identification.warm_start, twin.identification.prior_model
        warm_start = newest if attempt == 0 and newest and newest.t1 > training.t[0] else None
        if warm_start is None:
            twin.identification.fresh_start.restart(t_end)
        wind = twin.environment.wind.wind
        model = derivatives_model.identify(
            training, wind, twin.config.airframe, prior_model, warm_start, of_type=of_type
        )
        twin.identification.store(model)
        return model
    previous = twin.models.active_model if isinstance(twin.models.active_model, tuple) else (None, None)
    lon, lat = (
        identify_axis(axis, training, _FREE_RUN_S[attempt], prior_axis)[1]
        for axis, prior_axis in zip(AXES, previous, strict=True)
    )
    return lon, lat


def _fixed_wing_part(twin: Twin, window: Window | None) -> Window | None:
    """Return the rows flown on wings: all after the last row that was too slow or hovering."""
    if window is None:
        return None
    slow = window.ok & (window.columns(("u",))[:, 0] < MIN_WING_SPEED)
    start = max(_row_after(slow, 0), int(np.searchsorted(window.t, twin.identification.data_from)))
    if twin.vehicle_class.is_vtol:
        hovering = hovering_mask(
            window.t,
            twin.telemetry.history,
            twin.onboard.params.values if twin.onboard.params else {},
            twin.onboard.mode_changes,
        )
        start = max(start, _row_after(slow | hovering, int(SETTLING_S / DT)))
    return window.part(start, len(window)) if len(window) - start > 1 else None


def _row_after(mask: np.ndarray, margin: int) -> int:
    """Return the index `margin` rows after the last true row of `mask`; 0 if there is none."""
    rows = np.flatnonzero(mask)
    return int(rows[-1]) + 1 + margin if len(rows) else 0
