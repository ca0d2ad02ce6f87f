"""Standard deviations of fitted effects, from the residuals and from the variation between parts of the flight."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from fleet.effects import Onset
from twin_worker.diagnosis.data.fault_hypothesis import Guess
from twin_worker.diagnosis.inference.isolation.refine import refine, steps
from twin_worker.diagnosis.inference.isolation.whitened_residuals import Sight

_BLOCK = 50  # rows of a block of the sandwich, 10 s
_PARTS = 4  # parts of the jackknife
_WORKS = 0.01  # least gate value at which an effect is active
_FORM = 0.02  # relative model error of a parameter
_CLOCK_S = 0.01  # uncertainty of message time stamps [s]


def covariances(sight: Sight, weather: tuple[Guess, ...], guesses: Sequence[Guess]) -> list[np.ndarray]:
    """Return the parameter covariance of each fitted hypothesis, (k, k).

    Sum of a sandwich estimate over blocks of 10 s (effects joint, nuisances profiled out), a jackknife that leaves out
    each quarter of the active time, and a floor.
    Source: White 1982 (sandwich); Efron & Tibshirani 1993, section 11.5.
    """
    sight.grant(weather)
    sandwich = _sandwich(sight, guesses)
    out, at = [], 0
    for i, guess in enumerate(guesses):
        k = len(guess.par)
        others = (*weather, *(g for n, g in enumerate(guesses) if n != i))
        own = sandwich[at : at + k, at : at + k] + _jackknife(sight, others, guess)
        out.append(own + np.diag(_floor(sight, guess)))
        at += k
    return out


def _floor(sight: Sight, guess: Guess) -> np.ndarray:
    """Return the least variance, (k,): time stamps, model error, and the nominal spread of the aircraft.

    An effect that is always present is not separable from the nominal spread.
    """
    times = np.array([p.unit == "s" for p in guess.effect.parameters])
    usual = np.zeros(len(times))
    for n in sight.nuisances:
        if guess.when.kind is Onset.ALWAYS and (n.effect.name, n.of) == (guess.effect.name, guess.of):
            usual[n.index] = sight.base.spread.get(n.name, n.floor)
    return times * _CLOCK_S**2 + (_FORM * np.array(guess.par)) ** 2 + usual**2


def told_sigma(guess: Guess, covariance: np.ndarray, body: object) -> dict[str, float]:
    """Propagate a parameter covariance to the standard deviations of the reported values."""
    effect, par = guess.effect, np.array(guess.par)
    here = effect.told(effect, par, body)  # type: ignore[arg-type]
    h = steps(guess) * 1e-2
    J: dict[str, np.ndarray] = {}
    for k in range(len(par)):
        moved = effect.told(effect, par + h[k] * np.eye(len(par))[k], body)  # type: ignore[arg-type]
        for name, x in moved.items():
            J.setdefault(name, np.zeros(len(par)))[k] = _turned(name, x - here[name]) / h[k]
    return {name: float(np.sqrt(max(row @ covariance @ row, 0.0))) for name, row in J.items()}


def _turned(name: str, difference: float) -> float:
    return (difference + 180.0) % 360.0 - 180.0 if name == "from_deg" else difference


def _sandwich(sight: Sight, guesses: Sequence[Guess]) -> np.ndarray:
    e = sight.clipped(guesses)
    columns = []
    for i, guess in enumerate(guesses):
        others = [g for n, g in enumerate(guesses) if n != i]
        par = np.array(guess.par)
        for k, h in enumerate(steps(guess)):
            moved = guess.at(par + h * np.eye(len(par))[k])
            moved = moved if moved.par[k] != par[k] else guess.at(par - h * np.eye(len(par))[k])
            columns.append((sight.clipped([*others, moved]) - e) / (moved.par[k] - par[k] or 1.0))
    J = np.stack(columns, axis=2)
    C = np.einsum("tci,tcj->ij", J, sight.Jn)
    inverse = np.linalg.pinv(np.einsum("tci,tcj->ij", J, J) - C @ np.linalg.solve(sight.Ann, C.T))
    free = J - sight.Jn @ np.linalg.solve(sight.Ann, C.T)
    score = np.einsum("tci,tc->ti", free, e)
    blocks = np.add.reduceat(score, np.arange(0, len(score), _BLOCK), axis=0)
    whole = inverse @ (blocks.T @ blocks) @ inverse
    grow = np.sqrt(np.maximum(np.diag(inverse) / np.maximum(np.diag(whole), 1e-300), 1.0))
    return whole * np.outer(grow, grow)


def _jackknife(sight: Sight, granted: tuple[Guess, ...], guess: Guess) -> np.ndarray:
    """Return the jackknife covariance over the quarters of the active time, (k, k)."""
    sight.grant(granted)
    t = sight.case.t
    at_work = t[(guess.when.gate(t) > _WORKS) & sight.ok]
    if len(at_work) < 4 * _BLOCK:
        return np.zeros((len(guess.par),) * 2)
    edges = np.quantile(at_work, np.linspace(0, 1, _PARTS + 1))
    fits = []
    for low, high in pairwise(edges):
        part = sight.part((t < low) | (t >= high))
        fits.append(refine(part, guess, rounds=2, move=False).guess.par)
    away = np.array(fits) - np.mean(fits, axis=0)
    return (_PARTS - 1) / _PARTS * away.T @ away
