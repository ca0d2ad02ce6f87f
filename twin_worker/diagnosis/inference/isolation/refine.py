"""Refine one hypothesis: Gauss-Newton for the parameters, a search with halved steps for the onset."""

import numpy as np

from fleet.effects import Onset, Stage
from twin_worker.diagnosis.data.fault_hypothesis import Guess
from twin_worker.diagnosis.inference.isolation.isolate import Found
from twin_worker.diagnosis.inference.isolation.whitened_residuals import Sight

_ROUNDS = 5
_ENOUGH = 0.5  # gain below which fitting stops
_MOVES_S = (8.0, 4.0, 2.0, 1.0, 0.5, 0.2)
# search steps for the onset of a sensor jump
_NEAR_S, _NEARER_S = np.arange(-2.0, 2.1, 0.2), np.arange(-0.16, 0.17, 0.04)
_TURNS = {Onset.BUMP: 3}  # rounds of onset search and fit: a misplaced bump is fitted too small at first
_STRETCH = (1.5, 1.2, 1.1)


def refine(sight: Sight, guess: Guess, rounds: int = _ROUNDS, move: bool = True) -> Found:
    """Return the fitted hypothesis with its gain; `move_onset` also fits its onset."""
    before = sight.cost(())
    now = sight.cost((guess,))
    if now > before:
        half = guess.at(0.5 * np.array(guess.par))
        now, guess = min((now, guess), (sight.cost((half,)), half), key=lambda found: found[0])
    guess, now = _newton(sight, guess, now, rounds)
    for _ in range(_TURNS.get(guess.when.kind, 1) if move else 0):
        moved, cost = _onset(sight, guess, now)
        if moved is guess:
            break
        guess, now = _newton(sight, moved, cost, 2)
    return Found(before - now, guess)


def _newton(sight: Sight, guess: Guess, now: float, rounds: int) -> tuple[Guess, float]:
    for _ in range(rounds):
        A, b = normal(sight, guess)
        change = np.linalg.solve(A + 1e-6 * np.diag(np.diag(A)) + 1e-12 * np.eye(len(b)), b)
        gained = 0.0
        for share in (1.0, 0.5, 0.2):
            trial = guess.at(np.array(guess.par) + share * change)
            cost = sight.cost((trial,))
            if cost < now - 1e-6:
                guess, gained, now = trial, now - cost, cost
                break
        if gained < _ENOUGH:
            break
    return guess, now


def steps(guess: Guess) -> np.ndarray:
    """Return finite-difference steps at a hypothesis, (k,)."""
    return np.array([0.3 * max(p.step, 0.1 * abs(x)) for p, x in zip(guess.effect.parameters, guess.par, strict=True)])


def normal(sight: Sight, guess: Guess) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal equations at a hypothesis, nuisances profiled out, (k, k) and (k,)."""
    J = sight.slopes(guess, steps(guess))
    e = sight.clipped((guess,))
    C = np.einsum("tci,tcj->ij", J, sight.Jn)
    A = np.einsum("tci,tcj->ij", J, J) - C @ np.linalg.solve(sight.Ann, C.T)
    bn = -np.einsum("tci,tc->i", sight.Jn, e)
    b = -np.einsum("tci,tc->i", J, e) - C @ np.linalg.solve(sight.Ann, bn)
    return A, b


def _jump(sight: Sight, guess: Guess, now: float) -> tuple[Guess, float]:
    """Search the onset of a sensor jump on a fine grid: its slope is visible only at the exact sample."""
    for moves in (_NEAR_S, _NEARER_S):
        trials = [guess.at(np.array(guess.par), guess.when.moved(dt)) for dt in moves]
        costs = [sight.cost((trial,)) for trial in trials]
        k = int(np.argmin(costs))
        if costs[k] < now:
            guess, now = trials[k], costs[k]
    return guess, now


def _onset(sight: Sight, guess: Guess, now: float) -> tuple[Guess, float]:
    """Shift the onset and scale the duration while the cost decreases."""
    if guess.when.kind is Onset.ALWAYS:
        return guess, now
    best = guess
    if guess.effect.stage is Stage.SENSOR and guess.when.kind is Onset.STEP:
        best, now = _jump(sight, guess, now)
    for move in _MOVES_S:
        for dt in (move, -move):
            trial = best.at(np.array(best.par), best.when.moved(dt))
            cost = sight.cost((trial,))
            if cost < now - 1e-9:
                best, now = trial, cost
    if guess.when.kind is not Onset.STEP:
        for by in (*_STRETCH, *(1 / s for s in _STRETCH)):
            trial = best.at(np.array(best.par), best.when.stretched(by))
            cost = sight.cost((trial,))
            if cost < now - 1e-9:
                best, now = trial, cost
    return best, now
