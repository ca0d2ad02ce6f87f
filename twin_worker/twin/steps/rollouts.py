"""Predict the route with every available method, and select the method used."""

from dataclasses import replace

import numpy as np

from fleet.autopilots.laws import remember
from fleet.window import Window
from twin_worker.confidence.calibration_table import error_growth
from twin_worker.confidence.tube_and_horizon import AHEAD
from twin_worker.identification.fixed_wing.plant import DYNAMICS, PAPER, method
from twin_worker.numerics.interpolation import interpolate_rows
from twin_worker.prediction.closed_loop import InitialCondition, fly_from, synchronise_controller
from twin_worker.prediction.failsafe_route import with_failsafe
from twin_worker.prediction.fixed_wing import ensemble
from twin_worker.prediction.fixed_wing.path_wind import FIELD_SPAN_S
from twin_worker.prediction.fixed_wing.point_mass_rollout import (
    fly_point_mass,
    in_field_wind,
    start_in_field,
)
from twin_worker.prediction.method_selection import SCORE_AHEAD
from twin_worker.prediction.replay_window import PredictionContext, Rollout
from twin_worker.telemetry.track import Track
from twin_worker.twin.state.budget import EARLY_FRACTION, Work
from twin_worker.twin.state.routes import ROUTE_MODES
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps.kinematic_prediction import (
    PathAlternative,
    PathForecast,
    continued_mission,
    mission_may_continue,
    no_prediction,
    predict_without_model,
)
from twin_worker.twin.steps.route_lines import SIMPLE_METHODS, simple_paths

HYBRID, BOTH, GREYBOX = "hybrid", "both", "greybox"
_MIN_PROBABILITY = 0.05  # of an alternative: half of what a prediction region misses [-]
_SAME_PATH_M = 1.0  # paths nowhere further apart are the same [m]
_DYNAMICS_SPAN_S = 60.0  # look-ahead of the identified dynamics; beyond it the point-mass path continues [s]


def predict_route(twin: Twin, window: Window, recent: Track, ahead: np.ndarray) -> PathForecast:
    """Predict the route, or return the reason why this is not possible.

    Args:
        twin: source of the models; its method selection and ensemble are updated
        window: newest telemetry
        recent: positions and velocities of the last minute
        ahead: look-ahead times from the end of `window`, rising, (k,) [s]
    """
    situation = twin.situation(window)
    initial = synchronise_controller(situation)
    if isinstance(initial, Rollout):
        return no_prediction(initial.sentence, initial.seq)
    _store_controller_state(twin, situation.onboard.law, initial)
    before = initial
    initial, failsafe_text, known_s = _with_failsafe(twin, situation, initial)
    t = float(window.t[-1])
    due = twin.prediction.selector.is_due(t)
    candidates, reason = method_paths(twin, (situation, initial), ahead, due)
    if not candidates:
        return no_prediction(reason or "no verified model yet", initial.seq)
    _update_ensemble(twin, (situation, initial))
    sentence, control = " ".join(filter(None, (failsafe_text, initial.sentence))), initial.controller
    forecasts = {
        name: PathForecast(path, name, control.law, initial.seq, sentence, control, known_s)
        for name, path in candidates.items()
    }
    if twin.config.method != PAPER and (due or twin.prediction.selector.best((*forecasts, GREYBOX)) == GREYBOX):
        kinematic = predict_without_model(
            twin, recent.with_attitude(twin.telemetry.history), ahead + (t - recent.t[-1])
        )
        if kinematic.path is not None and not twin.telemetry.link_lost:
            forecasts[GREYBOX] = kinematic
    chosen = select_method(twin, t, forecasts, recent, ahead)
    if chosen.method == GREYBOX:
        return chosen
    if known_s < np.inf or not mission_may_continue(twin, situation.onboard.failsafe):
        return replace(chosen, alternatives=_without_jump(twin, situation, chosen, ahead))
    paths, _ = method_paths(twin, (situation, before), ahead, due)
    return replace(chosen, alternatives=continued_mission(paths.get(chosen.method, next(iter(paths.values()), None))))


def _without_jump(
    twin: Twin, situation: PredictionContext, chosen: PathForecast, ahead: np.ndarray
) -> tuple[PathAlternative, ...]:
    """Return the path on which the next jump is not taken again, if its count is unknown."""
    skipped = twin.onboard.skipped_jump() if twin.mode in ROUTE_MODES and situation.onboard.override is None else None
    if skipped is None or skipped.probability < _MIN_PROBABILITY:
        return ()
    other = replace(situation, onboard=replace(situation.onboard, jumps=skipped.jumps))
    initial = synchronise_controller(other)
    if isinstance(initial, Rollout):
        return ()
    path = method_paths(twin, (other, initial), ahead, False)[0].get(chosen.method)
    if path is None or chosen.path is None or not np.isfinite(path).all():
        return ()
    if np.abs(path - chosen.path).max() < _SAME_PATH_M:
        return ()
    text = f"passes the jump of item {skipped.seq}: earlier jumps are unknown, each count is equally likely"
    return (PathAlternative(skipped.probability, path, text),)


def _store_controller_state(twin: Twin, law: str, initial: InitialCondition) -> None:
    """Store the synchronised state of the controller, from which it continues when its route changes."""
    if twin.telemetry.link_lost or twin.prediction.override is not None:
        return
    ctl, par, _ = initial.synchronised
    state = remember(ctl, par, -float(initial.window.p[-1, 2]))
    twin.prediction.store_controller_state(float(initial.window.t[-1]), law, state)


def select_method(
    twin: Twin, t: float, forecasts: dict[str, PathForecast], recent: Track, ahead: np.ndarray
) -> PathForecast:
    """Return the forecast of the method with the smallest expected error; simple methods compete in a mission.

    Args:
        twin: its method selection is updated
        t: start of the forecasts [s since 1970]
        forecasts: usable forecasts by method
        recent: positions and velocities of the last minute
        ahead: look-ahead times from `t`, rising, (k,) [s]
    """
    selector, newest = twin.prediction.selector, next(iter(forecasts.values()))
    due = not twin.telemetry.link_lost and selector.is_due(t)
    competes = newest.seq >= 0 and not twin.telemetry.link_lost and twin.prediction.override is None
    competes = competes and twin.config.method != PAPER  # which was selected
    track, offset = recent.unbroken_tail(), t - float(recent.t[-1])
    scored = ahead[: int(ahead.searchsorted(SCORE_AHEAD[-1])) + 1]
    if competes and (due or selector.best((*forecasts, *SIMPLE_METHODS)) in SIMPLE_METHODS):
        simple = simple_paths(twin, track, scored + offset)  # to the end only if it is chosen
        forecasts = forecasts | {
            name: PathForecast(path, name, SIMPLE_METHODS[name], newest.seq, "") for name, path in simple.items()
        }
    paths = {name: forecast.path for name, forecast in forecasts.items() if forecast.path is not None}
    if due and len(paths) > 1:
        scored_paths = {name: path[: len(scored)] for name, path in paths.items()}
        selector.add(t, float(np.linalg.norm(recent.v[-1])), scored, scored_paths)
    chosen = forecasts[selector.best(tuple(forecasts))]
    if chosen.method in SIMPLE_METHODS and len(scored) < len(ahead):
        chosen = replace(chosen, path=simple_paths(twin, track, ahead + offset)[chosen.method])
    return replace(chosen, sentence="; ".join(filter(None, (selector.describe(chosen.method), chosen.sentence))))


def _with_failsafe(
    twin: Twin, situation: PredictionContext, initial: InitialCondition
) -> tuple[InitialCondition, str, float]:
    """Return the start with the failsafe after a link loss, its description, and how far its route is known [s]."""
    plan = situation.onboard.failsafe
    if plan is None:
        return initial, "", np.inf
    ctl, par, legs = initial.synchronised

    def position_at(ctl: np.ndarray, legs: np.ndarray, times: np.ndarray) -> np.ndarray | None:
        start = replace(initial, synchronised=(ctl, par, legs))
        paths, _ = method_paths(twin, (situation, start), times, False)
        return next(iter(paths.values()), None)

    ctl, legs, text, known_s = with_failsafe(ctl, legs, plan, position_at, float(initial.window.t[-1]))
    return replace(initial, synchronised=(ctl, par, legs)), text, known_s


def method_paths(
    twin: Twin, initial: tuple[PredictionContext, InitialCondition], ahead: np.ndarray, due: bool
) -> tuple[dict[str, np.ndarray], str]:
    """Return the path of each method, NED (k, 3) [m], and the reason if another failed; `due`: run all methods."""
    by_method: dict[str, np.ndarray] = {}
    reason, in_field = "", None
    if twin.models.point_mass is not None:  # all methods compare both winds over the same path
        in_field = start_in_field(*initial, twin.models.point_mass, max(float(ahead[-1]), FIELD_SPAN_S))
    if twin.models.point_mass is not None and twin.config.method in (HYBRID, "auto"):
        rollout = fly_point_mass(*initial, twin.models.point_mass, ahead, in_field)
        by_method, reason = _with_path(by_method, HYBRID, rollout), rollout.sentence
    needed = not by_method or due or twin.prediction.selector.best((BOTH, HYBRID, DYNAMICS)) != HYBRID
    if twin.models.active_model is not None and twin.config.method != HYBRID and needed:
        dynamics_ahead = (
            ahead[: np.searchsorted(ahead, max(_DYNAMICS_SPAN_S, ahead[0]), side="right")] if by_method else ahead
        )
        start = initial[1] if in_field is None else in_field_wind(initial[1], in_field)
        rollout = fly_from(start, twin.models.active_model, dynamics_ahead)
        reason = reason if by_method else rollout.sentence
        if rollout.path is not None:
            path = _extend_path(rollout.path, by_method[HYBRID]) if by_method else rollout.path
            by_method = {**by_method, method(twin.models.active_model): path}
    if len(by_method) > 1 and twin.models.average_is_better:
        by_method[BOTH] = 0.5 * (by_method[HYBRID] + by_method[method(twin.models.active_model)])  # type: ignore[arg-type]
    return by_method, reason


def _with_path(paths: dict[str, np.ndarray], name: str, rollout: Rollout) -> dict[str, np.ndarray]:
    return paths if rollout.path is None else {**paths, name: rollout.path}


def _extend_path(path: np.ndarray, continuation: np.ndarray) -> np.ndarray:
    """Continue `path`, (m, 3), with the increments of `continuation`, (k, 3)."""
    end = len(path)
    return np.vstack([path, continuation[end:] + (path[-1] - continuation[end - 1])])


def _update_ensemble(twin: Twin, initial: tuple[PredictionContext, InitialCondition]) -> None:
    """Run the ensemble if it is due."""
    t = float(initial[1].window.t[-1])
    due = twin.prediction.ensemble_timer.due(t, EARLY_FRACTION * twin.config.schedule.ensemble)
    up_to_date = not due and twin.prediction.override is None
    twin.prediction.defer_ensemble(None)
    if twin.models.point_mass is None or up_to_date:
        return
    if not twin.budget_allows(Work.ENSEMBLE):
        twin.prediction.defer_ensemble(t)
        return
    _run_ensemble(twin, initial, t)


def run_deferred_ensemble(twin: Twin, seconds: float) -> None:
    """Run the deferred ensemble from the current state; the schedule of the next one is unchanged.

    The ensemble waited for other work; its spread applies from the next prediction on.
    """
    due = twin.prediction.deferred_ensemble_t
    twin.prediction.defer_ensemble(None)
    window = twin.window(seconds)
    if due is None or twin.models.point_mass is None or window is None or not window.ok[-1] or twin.no_route_reason():
        return
    situation = twin.situation(window)
    initial = synchronise_controller(situation)
    if not isinstance(initial, Rollout):
        _run_ensemble(twin, (situation, initial), due)


def _run_ensemble(twin: Twin, initial: tuple[PredictionContext, InitialCondition], t: float) -> None:
    """Run the ensemble of time `t`; beyond its span the spread continues by the growth law."""
    assert twin.models.point_mass is not None
    ahead = AHEAD[: AHEAD.searchsorted(twin.config.schedule.span, side="right")]
    rng = np.random.default_rng((twin.config.uav, int(t)))
    spread = ensemble.ensemble_std(*initial, twin.models.point_mass, ahead, rng, members=twin.config.schedule.members)
    if spread is not None and len(ahead) < len(AHEAD):
        growth = error_growth(HYBRID, AHEAD[len(ahead) - 1 :])
        spread = np.vstack([spread, spread[-1] * growth[1:] / growth[0]])
    twin.prediction.store_ensemble(spread, t)


def ensemble_spread(twin: Twin, method_name: str, ahead: np.ndarray) -> np.ndarray | None:
    """Return the spread of the newest ensemble at some look-aheads, (k, 3) [m]; None if it does not apply to `method`.

    Args:
        twin: source of the ensemble
        method: of the prediction
        ahead: rising; beyond the ensemble's end the spread stays constant (k,) [s]
    """
    if twin.prediction.ensemble_spread is None or method_name not in (HYBRID, BOTH, DYNAMICS):
        return None
    return interpolate_rows(ahead, AHEAD, twin.prediction.ensemble_spread)
