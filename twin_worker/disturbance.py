"""Gusts as states of their own: better one step ahead, and the long run is not touched.

What a free run leaves over is modelled as coloured noise, v' = A_v v + K e, rest = C_v v + e, and set beside the model:
the new states feel only the one-step error, so a free run from where they are zero is the old one.

Source: Ljung 1999, section 4.3 (Box-Jenkins structure); the noise model by PBSIDopt without inputs.
"""

from dataclasses import replace

import numpy as np
import scipy.linalg

from twin_worker.linear import StateSpace
from twin_worker.subspace import candidates

MOST = 8  # states tried for the noise [-]
_HELD = 0.3  # last share of the data, which decides on the number of states [-]


def with_disturbance(model: StateSpace, y: np.ndarray, u: np.ndarray, ok: np.ndarray | None = None) -> StateSpace:
    """Add the states of a disturbance to a model fitted to these data by output error.

    Args:
        model: with K = 0, its x0 the state at the first of these rows
        y, u: scaled outputs (N, l) and inputs (N, m)
        ok: rows that were measured, (N,) bool
    Returns:
        the larger model; the same one where no noise model predicts held-out rows better than none
    Raises:
        ValueError: when too few unbroken rows are left; wait for a longer window.
    """
    ok = np.ones(len(y), bool) if ok is None else ok
    rest = np.where(ok[:, None], y - model.run(u), 0.0)
    early = ok & (np.arange(len(y)) < (1 - _HELD) * len(y))
    judged = ok & ~early
    found = candidates(rest, rest[:, :0], early)
    orders = range(1, min(MOST, len(found.x)) + 1)
    missed = {order: _missed(found.model(order), rest, judged) for order in orders}
    best = min(missed, key=lambda order: missed[order])
    if not missed[best] < float((rest[judged] ** 2).sum()):
        return model
    return _beside(model, candidates(rest, rest[:, :0], ok).model(best))


def _missed(noise: StateSpace, rest: np.ndarray, rows: np.ndarray) -> float:
    return float(((rest - noise.one_step(rest, rest[:, :0]))[rows] ** 2).sum())


def _beside(model: StateSpace, noise: StateSpace) -> StateSpace:
    """Put the states of the noise under those of the model."""
    zeros = np.zeros(noise.order)
    return replace(
        model,
        A=scipy.linalg.block_diag(model.A, noise.A),
        B=np.vstack([model.B, np.zeros((noise.order, model.B.shape[1]))]),
        C=np.hstack([model.C, noise.C]),
        K=np.vstack([model.K, noise.K]),
        c=np.concatenate([model.c, zeros]),
        x0=np.concatenate([model.x0, zeros]),
    )
