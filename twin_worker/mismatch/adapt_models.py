"""Adapt the twin's models to diagnosed effects: restart before the onset, add the effects, identify on the newer data.

No data count twice: of the flight before the onset only the checkpoint is used, with the effects added. Models
identified on the data since then include the effects.
"""

from copy import copy, deepcopy
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from fleet.contract import Outcome
from fleet.physics.wrench import NAMES, WIND, L, M, N, X, Y, Z, terms
from fleet.window import Window
from twin_worker.estimation.wind_filter import WindFilter, update_from_history
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel
from twin_worker.identification.fixed_wing.point_mass_model import EffectIncrements, with_effects
from twin_worker.mismatch.effect_increments import EffectOutputs
from twin_worker.numerics.ridge_regression import solve_ridge
from twin_worker.prediction.closed_loop import synchronise_controller
from twin_worker.prediction.replay_window import Rollout
from twin_worker.telemetry.resample import Resampler
from twin_worker.twin.state.models import ActiveEffects, Checkpoint, VerifiedModel, latest_before
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps.rollouts import method_paths

_CHECKPOINT_MARGIN_S = 2.0  # a checkpoint nearer to the onset can contain the effect already [s]
_HINDCAST_S = (20.0, 15.0, 10.0)  # newest flight simulated with both models, from several starts [s]
_MAX_ERROR_RATIO = 0.95  # the adapted model is used if its mean error is below this share of the present one [-]
_EFFECT_UNCERTAINTY = 0.3  # relative uncertainty of an effect's increments: diagnosis and baseline are not exact [-]
_RIDGE = 0.02  # regularisation of an increment towards zero, as a share of its term's length
_PRIOR_SPAN_S = 60.0  # assumed data span of the adapted model; its weight fades as that of earlier data does [s]
_WRENCH_TERMS = (
    (0, X, Z),
    (2, Z, M),
    (4, M, Y),
    (1, Y, L),
    (3, L, N),
    (5, N, WIND),
)  # row of the wrench, its derivatives
_INPUT_LETTERS = {0: "da", 1: "de", 2: "dr", 3: "dt"}  # derivatives of each input


@dataclass(frozen=True)
class AdaptationResult:
    """Result of an adaptation: whether the adapted model is used, and the mean position errors compared [m]."""

    used: bool = False
    present_error: float = np.nan
    adapted_error: float = np.nan

    @property
    def message(self) -> str:
        """Describe the result."""
        if not np.isfinite(self.adapted_error):
            return "not used for predictions: there is no flight to compare the models on"
        errors = f"{self.adapted_error:.1f} m against {self.present_error:.1f} m over the last {_HINDCAST_S[0]:.0f} s"
        return f"predictions use it ({errors})" if self.used else f"the identified model is used unchanged ({errors})"


def adapt_models(twin: Twin, outputs: EffectOutputs, names: str) -> AdaptationResult:
    """Add diagnosed effects to the models of a twin if this lowers the error over the newest flight from every start.

    Args:
        twin: changed in place only if the error is lower
        outputs: of the effects
        names: of the effects
    """
    checkpoint = latest_before(twin.models.checkpoints, outputs.onset - _CHECKPOINT_MARGIN_S)
    if checkpoint is None:
        return AdaptationResult()
    adapted = _adapted_copy(twin, outputs, checkpoint)
    spans = [s for s in _HINDCAST_S if twin.telemetry.history.newest - s > outputs.onset]
    pairs = [(_hindcast_error(twin, s), _hindcast_error(adapted, s)) for s in spans]
    pairs = [pair for pair in pairs if np.isfinite(pair).all()]
    if not pairs:
        return AdaptationResult()
    present_error, adapted_error = np.mean(pairs, axis=0).tolist()
    is_lower_everywhere = all(adapted < present for present, adapted in pairs)
    if not (is_lower_everywhere and adapted_error < _MAX_ERROR_RATIO * present_error):
        return AdaptationResult(False, present_error, adapted_error)
    twin.environment.set_wind(adapted.environment.wind, adapted.environment.wind_t)
    twin.models.adopt(adapted.models, ActiveEffects(names, outputs.onset))
    twin.identification.restart(outputs.onset, adapted.identification.prior_model)
    twin.prediction.expire()
    twin.telemetry.resampler.clear()
    return AdaptationResult(True, present_error, adapted_error)


def _adapted_copy(twin: Twin, outputs: EffectOutputs, checkpoint: Checkpoint) -> Twin:
    """Return a copy of the twin that contains the effects, restarted from `checkpoint` at the onset."""
    adapted = msgspec.structs.replace(
        twin,
        telemetry=msgspec.structs.replace(twin.telemetry, resampler=Resampler()),
        environment=copy(twin.environment),
        identification=copy(twin.identification),
        models=copy(twin.models),
        prediction=msgspec.structs.replace(twin.prediction, selector=copy(twin.prediction.selector)),
    )
    adapted.environment.set_wind(*wind_with_effects(twin, outputs, checkpoint))
    window = adapted.window(_PRIOR_SPAN_S)
    assert window is not None
    after_onset = window.part(min(int(np.searchsorted(window.t, outputs.onset)), len(window) - 2), len(window))
    if checkpoint.derivatives_model is not None and twin.models.active_verdict is not None:
        plant = adapted_derivatives(checkpoint.derivatives_model, outputs, window)
        verdict = msgspec.structs.replace(twin.models.active_verdict, outcome=Outcome.PLAUSIBLE)
        adapted.identification.store_prior(plant)
        adapted.models.activate(VerifiedModel(plant, verdict, float(window.t[-1]), np.nan))
    if checkpoint.point_mass is not None:
        air = np.column_stack([_interpolated(outputs.t, window, c) for c in range(3)])
        faulty = (outputs.actual != outputs.command).any(axis=0)
        added = EffectIncrements(
            outputs.wrench[:, :3],
            air,
            _interpolated(outputs.t, window, 6),
            outputs.actual[:, 3],
            (bool(faulty[0]), bool(faulty[1])),
        )
        point_mass = with_effects(
            checkpoint.point_mass, after_onset, twin.telemetry.history, adapted.environment.wind.scale, added
        )
        adapted.models.store_point_mass(point_mass, verified=True)
    return adapted


def wind_with_effects(twin: Twin, outputs: EffectOutputs, checkpoint: Checkpoint) -> tuple[WindFilter, float]:
    """Return the wind filter rerun with the effects from their onset on, and the time of its newest row."""
    wind = deepcopy(checkpoint.wind_filter)
    last_t = update_from_history(wind, twin.telemetry.history, checkpoint.t, checkpoint.t, outputs.onset)
    wind.inflate_after_step(outputs.wind, 1.0 / outputs.airspeed_scale, _EFFECT_UNCERTAINTY)
    return wind, update_from_history(wind, twin.telemetry.history, last_t, outputs.onset)


def adapted_derivatives(plant: DerivativesModel, outputs: EffectOutputs, window: Window) -> DerivativesModel:
    """Return the model with the effects: derivatives by input scaled for servo faults, increments added.

    Increments are regressed on the terms of the wrench over the recent flight: their slopes about the present trim.
    """
    par, added = _apply_servo_faults(plant.par, outputs), np.zeros(len(NAMES))
    states = np.column_stack([_interpolated(outputs.t, window, c) for c in range(6)])
    A = np.empty((len(states), WIND))
    for row, x, delta in zip(A, states, outputs.actual, strict=True):
        terms(x[0], x[1], x[2], x[3:6], delta, plant.trim_velocity, row)
    for wrench_row, first, end in _WRENCH_TERMS:
        added[first:end] = solve_ridge(A[:, first:end], outputs.wrench[:, wrench_row], _RIDGE)
    added[WIND:] = outputs.wind[:2]
    change = par + added - plant.par
    covariance = plant.covariance + np.diag((_EFFECT_UNCERTAINTY * change) ** 2)
    no_information = np.zeros_like(plant.fisher_information)
    return replace(
        plant,
        par=par + added,
        prior_mean=par + added,
        prior_precision=np.linalg.inv(covariance),
        fisher_information=no_information,
        t0=outputs.onset,
        t1=outputs.onset + _PRIOR_SPAN_S,
    )


def _apply_servo_faults(par: np.ndarray, outputs: EffectOutputs) -> np.ndarray:
    """Return the derivatives by commands, for faulty servos with  delta = g delta_c + o."""
    out = par.copy()
    for column, letters in _INPUT_LETTERS.items():
        u, actual = outputs.command[:, column], outputs.actual[:, column]
        if np.array_equal(u, actual):
            continue
        g, o = np.polyfit(u, actual, 1) if np.ptp(u) > 1e-3 else (1.0, float((actual - u).mean()))
        for axis in "XYZLMN":
            if (name := f"{axis}_{letters}") in NAMES:
                index = NAMES.index(name)
                out[NAMES.index(f"{axis}_0")] += o * par[index]
                out[index] = g * par[index]
    return out


def _interpolated(t: np.ndarray, window: Window, column: int) -> np.ndarray:
    return np.interp(t, window.t, window.x[:, column])


def _hindcast_error(twin: Twin, seconds: float) -> float:
    """Return the mean position error of the active method over the newest seconds [m]; inf outside the envelope."""
    window = twin.window(62.0 + seconds)
    if window is None or twin.no_route_reason() or not window.ok[-round(seconds / window.dt) :].all():
        return np.nan
    start = len(window) - 1 - round(seconds / window.dt)
    situation = twin.situation(window.part(0, start + 1))
    initial = synchronise_controller(situation)
    if isinstance(initial, Rollout):
        return np.nan
    ahead = np.arange(0.0, seconds + 1e-9)
    by_method, _ = method_paths(twin, (situation, initial), ahead, False)
    if not by_method:
        return np.inf
    path = by_method[twin.prediction.selector.best(tuple(by_method))]
    rows = start + np.rint(ahead / window.dt).astype(int)
    return float(np.linalg.norm(path - window.p[rows], axis=1).mean())
