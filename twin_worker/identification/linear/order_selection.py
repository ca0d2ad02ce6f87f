"""Selection of model order and structure by three-fold cross-validation.

Every order starts from subspace identification with several horizons. B is fitted to the free run, and the best start
is refined by output error, with and without a state bias, with and without feedthrough. The structures with the best
fit on held-out folds are refitted to all data. They form an ensemble, whose median run has less variance than a single
model on short or noisy data. The selected model is the smallest member close to the median run.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from twin_worker.identification.linear.black_box_prediction_error import fit_inputs, refine_black_box
from twin_worker.identification.linear.state_space import StateSpace
from twin_worker.identification.linear.subspace import candidates, instructive

PASTS = (6, 10, 15, 25)  # tried past horizons [samples]
_THIRDS = 3
_SCORE = 20  # members of the ensemble
_AS_NEAR = 2.0  # largest squared distance, relative to the nearest member [-]
_LEAST = 30  # minimum samples to estimate the start state of a fold


@dataclass(frozen=True)
class Recipe:
    """Structure of a model.

    Attributes:
        order: number of states
        feedthrough: the input acts on the output of the same sample
        with_bias: with a constant state bias
        refined: refined by output error; otherwise only B is fitted
    """

    order: int
    feedthrough: bool
    pushed: bool
    refined: bool


@dataclass(frozen=True)
class Choice:
    """Result of the order selection.

    Attributes:
        model: the smallest member close to the median run of the ensemble
        structure: structure of that model
        ensemble: the models with the best fit on held-out data, refitted to all data
    """

    model: StateSpace
    recipe: Recipe
    committee: tuple[StateSpace, ...]


def choose(y: np.ndarray, u: np.ndarray, *, orders: Iterable[int] = range(1, 11), feedthrough: bool = False) -> Choice:
    """Identify models and select their order by cross-validation.

    Args:
        y: outputs, zero mean and unit scale, (N, l)
        u: inputs, zero mean and unit scale, (N, m)
        orders: candidate orders
        feedthrough: also try models with D; not valid for closed-loop data
    Raises:
        ValueError: if the data are too short or not exciting enough for any order.
    """
    n, orders = len(y), tuple(orders)
    instructive(y, u, np.ones(n, bool))
    through = (False, True) if feedthrough else (False,)
    ranked = _ranked(y, u, orders, through)
    best = set(ranked[:_SCORE])
    whole = {r: m for r, m in _models(y, u, np.ones(n, bool), orders, through) if r in best}
    runs = np.array([model.run(u) for model in whole.values()])
    far = ((runs - np.median(runs, axis=0)) ** 2).sum(axis=(1, 2))
    near = [recipe for recipe, d in zip(whole, far, strict=True) if d <= _AS_NEAR * far.min()]
    recipe = min(near, key=lambda r: (r.order, ranked.index(r)))
    return Choice(whole[recipe], recipe, tuple(whole.values()))


def _ranked(y: np.ndarray, u: np.ndarray, orders: tuple[int, ...], through: tuple[bool, ...]) -> list[Recipe]:
    """Rank the structures by the fit of free runs on held-out folds, best first."""
    n = len(y)
    fits: dict[Recipe, list[float]] = {}
    for fold in range(_THIRDS):
        held = slice(fold * n // _THIRDS, (fold + 1) * n // _THIRDS)
        ok = np.ones(n, bool)
        ok[held] = False
        for recipe, model in _models(y, u, ok, orders, through):
            fits.setdefault(recipe, []).append(_fit(model, y[held], u[held]))
    whole = [recipe for recipe, each in fits.items() if len(each) == _THIRDS]
    if not whole:
        raise ValueError(f"order: found {n} samples, too few for order {min(orders)}; record for longer")
    return sorted(whole, key=lambda recipe: -float(np.mean(fits[recipe])))


def _models(
    y: np.ndarray, u: np.ndarray, ok: np.ndarray, orders: tuple[int, ...], through: tuple[bool, ...]
) -> Iterator[tuple[Recipe, StateSpace]]:
    """Fit a model of every structure to the rows marked ok."""
    for feedthrough in through:
        w = np.vstack([u[1:], u[-1:]]) if feedthrough else u  # D is B of the input advanced by one sample
        found = []
        for past in PASTS:
            try:
                found.append(candidates(y, w, ok, past=past, future=max(past - 2, 6)))
            except ValueError:  # too few rows for this past horizon
                continue
        for order in orders:
            starts = [states.model(order).stabilised() for states in found if order <= len(states.x)]
            if not starts:
                continue
            for pushed in (False, True):
                fitted = [fit_inputs(start, y, w, ok=ok, pushed=pushed) for start in starts]
                first = min(fitted, key=lambda model: _squares(model, y, w, ok))
                refined = refine_black_box(first, y, w, ok=ok, pushed=pushed)
                for model, done in ((first, False), (refined, True)):
                    yield Recipe(order, feedthrough, pushed, done), _through(model, u[0]) if feedthrough else model


def _squares(model: StateSpace, y: np.ndarray, u: np.ndarray, ok: np.ndarray) -> float:
    return float(((y - model.run(u))[ok] ** 2).sum())


def _through(model: StateSpace, u0: np.ndarray) -> StateSpace:
    """Convert a model of advanced inputs to a model with feedthrough: its state is x(k) - B u(k)."""
    return replace(model, B=model.A @ model.B, D=model.C @ model.B, x0=model.x0 - model.B @ u0)


def _fit(model: StateSpace, y: np.ndarray, u: np.ndarray) -> float:
    """Return the mean fit of the outputs over a held-out fold, at least -100 [%]."""
    first = min(max(_LEAST, len(y) // 10), len(y))
    y_hat = model.run(u, model.begin(y[:first], u[:first], len(y)))
    miss = np.linalg.norm(y - y_hat, axis=0) / np.maximum(np.linalg.norm(y - y.mean(axis=0), axis=0), 1e-9)
    return float(np.mean(np.maximum(100 * (1 - miss), -100.0)))
