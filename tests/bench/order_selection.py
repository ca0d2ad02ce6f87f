"""Selection of model order and structure by three-fold cross-validation.

Every order starts from subspace identification with several horizons. B is fitted to the free run, and the best start
is refined by output error, with and without a state bias, with and without feedthrough. The structures with the best
fit on held-out folds are refitted to all data. They form an ensemble, whose median run has less variance than a single
model on short or noisy data. The selected model is the smallest member close to the median run.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from tests.bench.black_box import estimate_x0, refine_black_box
from twin_worker.identification.linear.state_space import StateSpace
from twin_worker.identification.linear.subspace import check_excitation, fit_inputs, subspace_states

PAST_HORIZONS = (6, 10, 15, 25)  # tried past horizons [samples]
_FOLDS = 3
_ENSEMBLE_SIZE = 20  # members of the ensemble
_DISTANCE_RATIO = 2.0  # largest squared distance, relative to the nearest member [-]
_MIN_START_SAMPLES = 30  # minimum samples to estimate the start state of a fold


@dataclass(frozen=True)
class ModelStructure:
    """Structure of a model.

    Attributes:
        order: number of states
        feedthrough: the input acts on the output of the same sample
        with_bias: with a constant state bias
        refined: refined by output error; otherwise only B is fitted
    """

    order: int
    feedthrough: bool
    with_bias: bool
    refined: bool


@dataclass(frozen=True)
class OrderSelection:
    """Result of the order selection.

    Attributes:
        model: the smallest member close to the median run of the ensemble
        structure: structure of that model
        ensemble: the models with the best fit on held-out data, refitted to all data
    """

    model: StateSpace
    structure: ModelStructure
    ensemble: tuple[StateSpace, ...]


def select_order(
    y: np.ndarray, u: np.ndarray, *, orders: Iterable[int] = range(1, 11), feedthrough: bool = False
) -> OrderSelection:
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
    check_excitation(y, u, np.ones(n, bool))
    feedthroughs = (False, True) if feedthrough else (False,)
    ranking = _rank_structures(y, u, orders, feedthroughs)
    best = set(ranking[:_ENSEMBLE_SIZE])
    refitted = {r: m for r, m in _fit_structures(y, u, np.ones(n, bool), orders, feedthroughs) if r in best}
    runs = np.array([model.run(u) for model in refitted.values()])
    distances = ((runs - np.median(runs, axis=0)) ** 2).sum(axis=(1, 2))
    close = [
        structure for structure, d in zip(refitted, distances, strict=True) if d <= _DISTANCE_RATIO * distances.min()
    ]
    recipe = min(close, key=lambda r: (r.order, ranking.index(r)))
    return OrderSelection(refitted[recipe], recipe, tuple(refitted.values()))


def _rank_structures(
    y: np.ndarray, u: np.ndarray, orders: tuple[int, ...], feedthroughs: tuple[bool, ...]
) -> list[ModelStructure]:
    """Rank the structures by the fit of free runs on held-out folds, best first."""
    n = len(y)
    fits: dict[ModelStructure, list[float]] = {}
    for fold in range(_FOLDS):
        fold_rows = slice(fold * n // _FOLDS, (fold + 1) * n // _FOLDS)
        ok = np.ones(n, bool)
        ok[fold_rows] = False
        for structure, model in _fit_structures(y, u, ok, orders, feedthroughs):
            fits.setdefault(structure, []).append(_fold_fit(model, y[fold_rows], u[fold_rows]))
    complete = [recipe for recipe, scores in fits.items() if len(scores) == _FOLDS]
    if not complete:
        raise ValueError(f"order: found {n} samples, too few for order {min(orders)}; record for longer")
    return sorted(complete, key=lambda recipe: -float(np.mean(fits[recipe])))


def _fit_structures(
    y: np.ndarray, u: np.ndarray, ok: np.ndarray, orders: tuple[int, ...], feedthroughs: tuple[bool, ...]
) -> Iterator[tuple[ModelStructure, StateSpace]]:
    """Fit a model of every structure to the rows marked ok."""
    for feedthrough in feedthroughs:
        w = np.vstack([u[1:], u[-1:]]) if feedthrough else u  # D is B of the input advanced by one sample
        subspaces = []
        for past in PAST_HORIZONS:
            try:
                subspaces.append(subspace_states(y, w, ok, past=past, future=max(past - 2, 6)))
            except ValueError:  # too few rows for this past horizon
                continue
        for order in orders:
            starts = [subspace.model(order).stabilised() for subspace in subspaces if order <= len(subspace.x)]
            if not starts:
                continue
            for with_bias in (False, True):
                fitted = [fit_inputs(start, y, w, ok=ok, with_bias=with_bias) for start in starts]
                first = min(fitted, key=lambda model: _square_error(model, y, w, ok))
                refined = refine_black_box(first, y, w, ok=ok, with_bias=with_bias)
                for model, is_refined in ((first, False), (refined, True)):
                    yield (
                        ModelStructure(order, feedthrough, with_bias, is_refined),
                        _undo_input_advance(model, u[0]) if feedthrough else model,
                    )


def _square_error(model: StateSpace, y: np.ndarray, u: np.ndarray, ok: np.ndarray) -> float:
    return float(((y - model.run(u))[ok] ** 2).sum())


def _undo_input_advance(model: StateSpace, u0: np.ndarray) -> StateSpace:
    """Convert a model of advanced inputs to a model with feedthrough: its state is x(k) - B u(k)."""
    return replace(model, B=model.A @ model.B, D=model.C @ model.B, x0=model.x0 - model.B @ u0)


def _fold_fit(model: StateSpace, y: np.ndarray, u: np.ndarray) -> float:
    """Return the mean fit of the outputs over a held-out fold, at least -100 [%]."""
    first = min(max(_MIN_START_SAMPLES, len(y) // 10), len(y))
    y_hat = model.run(u, estimate_x0(model, y[:first], u[:first], len(y)))
    relative_error = np.linalg.norm(y - y_hat, axis=0) / np.maximum(np.linalg.norm(y - y.mean(axis=0), axis=0), 1e-9)
    return float(np.mean(np.maximum(100 * (1 - relative_error), -100.0)))
