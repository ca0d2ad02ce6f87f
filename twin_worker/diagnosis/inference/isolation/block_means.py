"""Block means of the raw residuals: evidence of lasting differences, which whitening nearly removes.

The covariance of the block means is the discrepancy of nominal flights that are left out: the variance of each channel,
and the nuisances with their spreads.
Source: Kennedy & O'Hagan 2001 (model discrepancy).
"""

from collections.abc import Sequence

import numpy as np

from twin_worker.diagnosis.data.card import FaultHypothesis
from twin_worker.diagnosis.data.flight import STEP_S
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals

BLOCK_S = 10.0  # longer than the correlation of whitened residuals
_CLIP = 6.0  # of block means, in standard deviations: one block does not decide
BLOCK_ROWS = round(BLOCK_S / STEP_S)
Change = tuple[int, np.ndarray]
"""Channel, and what is added to its residual, (n,)."""


def block_sums(x: np.ndarray, ok: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the means of the valid rows of x, (n, …), in blocks of 10 s, and the valid share of each block, (b,)."""
    labels = np.floor(t / BLOCK_S).astype(int)
    starts = np.searchsorted(labels, np.arange(labels[0], labels[-1] + 1))
    count = np.add.reduceat(ok.astype(float), starts)
    total = np.add.reduceat(np.where(ok.reshape(-1, *(1,) * (x.ndim - 1)), x, 0.0), starts, axis=0)
    return total / np.maximum(count, 1.0).reshape(-1, *(1,) * (x.ndim - 1)), count / BLOCK_ROWS


def block_sigma(whitened: WhitenedResiduals) -> np.ndarray:
    """Return the standard deviation of the block means of one nominal flight, the nuisances estimated, (c,)."""
    means = BlockMeans(whitened, np.ones(len(whitened.noise.sigma)))
    x = means.residuals(()) + means.slopes @ whitened.xn
    return np.asarray(np.sqrt((means.share[:, None] * x * x).sum(axis=0) / max(means.share.sum(), 1.0)))


class BlockMeans:
    """Cost of hypotheses in the block means of one flight, the nuisances profiled out.

    Args:
        whitened: residuals conditioned on the weather alone
        sigma: standard deviation of the mean of a full block, (c,)
    """

    def __init__(self, whitened: WhitenedResiduals, sigma: np.ndarray) -> None:
        self._whitened, self.conditions, self._sigma = whitened, whitened.conditions, sigma
        slopes = whitened.linearisation().slopes
        self.slopes, self.share = block_sums(slopes, whitened.ok, whitened.modelled.t)
        self._weight = np.sqrt(self.share)[:, None] / sigma
        self._J = (self.slopes * self._weight[:, :, None]).reshape(-1, slopes.shape[2])
        self._A = self._J.T @ self._J + np.diag(whitened.precision)

    def residuals(self, hypotheses: Sequence[FaultHypothesis], change: Change | None = None) -> np.ndarray:
        """Return the block means with these hypotheses and a further change of one channel, (b, c)."""
        modelled = self._whitened.modelled
        x = modelled.residuals((*self.conditions, *hypotheses))
        if change is not None:
            x = x.copy()
            x[:, change[0]] += change[1]
        return block_sums(x, self._whitened.ok, modelled.t)[0]

    def squares(self, hypotheses: Sequence[FaultHypothesis], nuisances: np.ndarray) -> np.ndarray:
        """Return the sum of squares of each block mean at these values of the nuisances, (b,)."""
        e = np.clip((self.residuals(hypotheses) + self.slopes @ nuisances) * self._weight, -_CLIP, _CLIP)
        return np.asarray((e * e).sum(axis=1))

    def cost(self, hypotheses: Sequence[FaultHypothesis], change: Change | None = None) -> float:
        """Return the sum of squares of the block means with these hypotheses, the nuisances profiled out."""
        e = np.clip(self.residuals(hypotheses, change) * self._weight, -_CLIP, _CLIP).ravel()
        b = self._J.T @ e
        return float(e @ e - b @ np.linalg.solve(self._A, b))
