"""Which order, and is there more than A, B and C? Tried on held-out thirds of the data, never on anything else.

Every order is started by subspace identification with several horizons, its inputs are fitted to the free run, the
best start is refined by output error; with and without a constant push, with and without feedthrough. The score that
turn out best over the thirds they have not seen are made again from all data: a committee, whose median run is steadier
than any one of them where data are few and noisy. Where one model is wanted, it is the smallest member that is about as
near to that run as any: one lucky fold does not decide.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from twin_worker.identification.linear.black_box_prediction_error import fit_inputs, refine_black_box
from twin_worker.identification.linear.state_space import StateSpace
from twin_worker.identification.linear.subspace import candidates, instructive

PASTS = (6, 10, 15, 25)  # horizons tried [samples]
_THIRDS = 3
_SCORE = 20  # members of the committee
_AS_NEAR = 2.0  # squared distance, as a multiple of the nearest member's [-]
_LEAST = 30  # samples for the state at the start of a held-out third


@dataclass(frozen=True)
class Recipe:
    """How a model was made.

    Attributes:
        order: number of states
        feedthrough: the input acts on the output of its own sample (the state feels it a sample sooner)
        pushed: with a constant on the state
        refined: by output error; else only its inputs were fitted
    """

    order: int
    feedthrough: bool
    pushed: bool
    refined: bool


@dataclass(frozen=True)
class Choice:
    """What was chosen.

    Attributes:
        model: the smallest member about as near to the committee's median run as any
        recipe: how that was made
        committee: the models that did best on data they had not seen, refitted to all
    """

    model: StateSpace
    recipe: Recipe
    committee: tuple[StateSpace, ...]


def choose(y: np.ndarray, u: np.ndarray, *, orders: Iterable[int] = range(1, 11), feedthrough: bool = False) -> Choice:
    """Identify models whose order the data choose.

    Args:
        y: outputs, zero mean and unit scale, (N, l)
        u: inputs, likewise, (N, m)
        orders: orders to try
        feedthrough: also try models whose input acts at once, so that D is not zero; never for data from a closed loop
    Raises:
        ValueError: when the data are too short or too poor for any order.
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
    """Put the recipes in the order of how well they run over thirds they have not seen, the best first."""
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
    """Make a model of every recipe from the rows that are ok."""
    for feedthrough in through:
        w = np.vstack([u[1:], u[-1:]]) if feedthrough else u  # D is B of an input that comes a sample sooner
        found = []
        for past in PASTS:
            try:
                found.append(candidates(y, w, ok, past=past, future=max(past - 2, 6)))
            except ValueError:  # too long a past for so few rows
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
    """Return the same model for inputs that are not advanced: its state is x(k) - B u(k)."""
    return replace(model, B=model.A @ model.B, D=model.C @ model.B, x0=model.x0 - model.B @ u0)


def _fit(model: StateSpace, y: np.ndarray, u: np.ndarray) -> float:
    """Run over a held-out third: mean fit of the outputs, at least -100 [%]."""
    first = min(max(_LEAST, len(y) // 10), len(y))
    y_hat = model.run(u, model.begin(y[:first], u[:first], len(y)))
    miss = np.linalg.norm(y - y_hat, axis=0) / np.maximum(np.linalg.norm(y - y.mean(axis=0), axis=0), 1e-9)
    return float(np.mean(np.maximum(100 * (1 - miss), -100.0)))
