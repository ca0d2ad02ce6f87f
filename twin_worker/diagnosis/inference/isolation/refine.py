"""Refine one hypothesis: Gauss-Newton for the parameters, a search with halved steps for the onset."""

from functools import partial

import numpy as np

from fleet.effects import Onset, Stage
from twin_worker.diagnosis.data.card import FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.inference.isolation.isolate import BUMPS_S, ScoredHypothesis
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals, project

_ITERATIONS = 5
_MIN_GAIN = 0.5  # gain below which fitting stops
_ONSET_STEPS_S = (8.0, 4.0, 2.0, 1.0, 0.5, 0.2)
# search steps for the onset of a sensor jump
_COARSE_STEPS_S, _FINE_STEPS_S = np.arange(-2.0, 2.1, 0.2), np.arange(-0.16, 0.17, 0.04)
# the same of an effect with memory: its scan has the onset from the effect throughout, and the cost has many minima
_MEMORY_STEPS_S = np.arange(-12.0, 12.1, 0.4)
_ALTERNATIONS = {Onset.BUMP: 3}  # rounds of onset search and fit: a misplaced bump is fitted too small at first
_STRETCH_FACTORS = (1.5, 1.2, 1.1)


def refine(
    whitened: WhitenedResiduals, hypothesis: FaultHypothesis, iterations: int = _ITERATIONS, move_onset: bool = True
) -> ScoredHypothesis:
    """Return the fitted hypothesis with its gain; `move_onset` also fits its onset."""
    before = whitened.cost(())
    best_cost = whitened.cost((hypothesis,))
    if best_cost > before:
        half = hypothesis.with_parameters(0.5 * np.array(hypothesis.par))
        best_cost, hypothesis = min((best_cost, hypothesis), (whitened.cost((half,)), half), key=lambda pair: pair[0])
    hypothesis, best_cost = _gauss_newton(whitened, hypothesis, best_cost, iterations)
    for _ in range(_ALTERNATIONS.get(hypothesis.onset.kind, 1) if move_onset else 0):
        moved, cost = _search_onset(whitened, hypothesis, best_cost)
        if moved is hypothesis:
            break
        hypothesis, best_cost = _gauss_newton(whitened, moved, cost, 2)
    return ScoredHypothesis(before - best_cost, hypothesis)


def _gauss_newton(
    whitened: WhitenedResiduals, hypothesis: FaultHypothesis, best_cost: float, iterations: int
) -> tuple[FaultHypothesis, float]:
    for _ in range(iterations):
        A, b = normal_at(whitened, hypothesis)
        change = np.linalg.solve(A + 1e-6 * np.diag(np.diag(A)) + 1e-12 * np.eye(len(b)), b)
        gained = 0.0
        for share in (1.0, 0.5, 0.2):
            trial = hypothesis.with_parameters(np.array(hypothesis.par) + share * change)
            cost = whitened.cost((trial,))
            if cost < best_cost - 1e-6:
                hypothesis, gained, best_cost = trial, best_cost - cost, cost
                break
        if gained < _MIN_GAIN:
            break
    return hypothesis, best_cost


def slope_steps(hypothesis: FaultHypothesis) -> np.ndarray:
    """Return finite-difference steps at a hypothesis, (k,)."""
    return np.array(
        [0.3 * max(p.step, 0.1 * abs(x)) for p, x in zip(hypothesis.effect.parameters, hypothesis.par, strict=True)]
    )


def normal_at(whitened: WhitenedResiduals, hypothesis: FaultHypothesis) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal equations at a hypothesis, nuisances profiled out, (k, k) and (k,)."""
    J = whitened.slopes(hypothesis, slope_steps(hypothesis))
    e = whitened.clipped((hypothesis,))
    C = project(J, whitened.Jn)
    profiled = C @ whitened.nuisance_covariance
    A = project(J, J) - profiled @ C.T
    b = -project(J, e) + profiled @ whitened.project_nuisances(e)
    return A, b


def _is_scanned(onset: OnsetProfile, t: np.ndarray) -> bool:
    """Return whether a profile could come from the scan: a bump begins in the flight and passes in it."""
    return onset.kind is not Onset.BUMP or (onset.t0 >= t[0] and max(BUMPS_S) >= onset.T)


def _search_onset(
    whitened: WhitenedResiduals, hypothesis: FaultHypothesis, best_cost: float
) -> tuple[FaultHypothesis, float]:
    """Shift the onset and scale the duration while the cost decreases."""
    if hypothesis.onset.kind is Onset.ALWAYS:
        return hypothesis, best_cost
    best = hypothesis
    grids: tuple[np.ndarray, ...] = ()
    if hypothesis.onset.kind is Onset.STEP:
        if hypothesis.effect.stage is Stage.SENSOR:  # the slope of a jump is visible only at the exact sample
            grids = _COARSE_STEPS_S, _FINE_STEPS_S
        elif hypothesis.effect.initial_guesses:
            grids = (_MEMORY_STEPS_S,)
    for moves in grids:
        trials = [best.with_parameters(np.array(best.par), best.onset.shifted(dt)) for dt in moves]
        costs = [whitened.cost((trial,)) for trial in trials]
        k = int(np.argmin(costs))
        if costs[k] < best_cost:
            best, best_cost = trials[k], costs[k]
    changes = [partial(OnsetProfile.shifted, dt=dt) for move in _ONSET_STEPS_S for dt in (move, -move)]
    if hypothesis.onset.kind is not Onset.STEP:
        factors = (*_STRETCH_FACTORS, *(1 / s for s in _STRETCH_FACTORS))
        changes += [partial(OnsetProfile.stretched, by=by) for by in factors]
    for change in changes:
        trial = best.with_parameters(np.array(best.par), change(best.onset))
        if not _is_scanned(trial.onset, whitened.modelled.t):
            continue
        cost = whitened.cost((trial,))
        if cost < best_cost - 1e-9:
            best, best_cost = trial, cost
    return best, best_cost
