"""Output-error estimation of derivatives and mean wind from free runs of both axes.

    J = f sum e' W e + (par - par0)' Lambda (par - par0) + sum_s (x_s - x_bar_s)' K (x_s - x_bar_s)

over free-run segments; f is the effective fraction of residuals. The start states x_s are also unknown; every step
eliminates them by their Schur complement. Damped Gauss-Newton steps; W is estimated from the residuals.

Source: Jategaonkar 2015, chapter 4 (output error, multiple shots); Ljung 1999, section 10.2 (damping).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fleet.physics.wrench import N_PAR
from twin_worker.identification.fixed_wing.output_error_kernel import GROUP, N_COLUMN, sweep

SIGMA = np.array([0.08, 0.08, 0.08, 0.005, 0.005, 0.005, 0.004, 0.004, 0.008])  # minimum residual of each state
SEGMENT_S = 10.0  # free run [s]
LEAST_S = 2.0  # shorter segments between gaps are ignored [s]
LINE = 6  # samples of the line fit of a segment's start state [-]
_DONE = 1e-3  # relative descent that stops the search [-]
_TRIES = 6  # maximum damping values per step


@dataclass(frozen=True)
class Problem:
    """Data of one estimation.

    Attributes:
        y: states, u v w over the ground, (n, 9)
        delta: actuator states, (n, 4)
        segments: first and last row of each, (m, 2)
        trim_velocity: U0, W0, (2,) [m/s]
        dt: sample time [s]
        effective_fraction: effective fraction of residuals, which gusts correlate [-]
    """

    y: np.ndarray
    delta: np.ndarray
    segments: np.ndarray
    at: np.ndarray
    dt: float
    discount: float


@dataclass(frozen=True)
class Found:
    """Result of an estimation.

    Attributes:
        par: parameters, (37,)
        fisher_information: information from the data, start states eliminated, (37, 37)
        weight: inverse residual variances, (9,)
        steps: Gauss-Newton steps that descended
        cost: final cost; nan if the start or its sensitivities left the envelope
    """

    par: np.ndarray
    information: np.ndarray
    weight: np.ndarray
    steps: int
    cost: float


def segments_of(ok: np.ndarray, dt: float) -> np.ndarray:
    """Split gap-free rows into free runs of an integer number of groups, (m, 2)."""
    longest, least = (int(seconds / dt) // GROUP * GROUP for seconds in (SEGMENT_S, LEAST_S))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], ok, [False]]).astype(int)))
    pieces = []
    for start, stop in edges.reshape(-1, 2):
        n = max(-(-(stop - start) // longest), 1)
        length = (stop - start) // n // GROUP * GROUP
        if length >= least:
            pieces += [(start + k * length, start + (k + 1) * length) for k in range(n)]
    return np.array(pieces, dtype=np.int64).reshape(-1, 2)


def line_start(y: np.ndarray) -> np.ndarray:
    """Return the first state from a line fit through the first samples, (9,)."""
    n = min(LINE, len(y))
    return _line(n) @ y[:n]


@lru_cache(maxsize=LINE)
def _line(n: int) -> np.ndarray:
    return np.linalg.pinv(np.column_stack([np.ones(n), np.arange(n)]))[0]


class _Search:
    """Cost, residuals and normal equations at one point."""

    def __init__(self, problem: Problem, par0: np.ndarray, Lambda: np.ndarray) -> None:
        self.problem, self.par0, self.Lambda = problem, par0, Lambda
        flown = [problem.y[a:b] for a, b in problem.segments]
        self.prior, self.spread = np.array([line_start(y) for y in flown]), np.concatenate(flown).std(axis=0)
        self.K = 1.0 / SIGMA**2
        lengths = (problem.segments[:, 1] - problem.segments[:, 0]) // GROUP
        self.bounds = np.concatenate([[0], np.cumsum(lengths)])
        self.e, self.J = np.empty((self.bounds[-1], 9)), np.empty((self.bounds[-1], 9, N_COLUMN))
        self.trial, self.nothing = np.empty_like(self.e), np.empty((0, 9, N_COLUMN))

    def fly(self, par: np.ndarray, starts: np.ndarray, W: np.ndarray, slopes: bool) -> float:
        """Return the cost at a point; with `slopes` store residuals and sensitivities."""
        one = self.problem
        e, J = (self.e, self.J) if slopes else (self.trial, self.nothing)
        squares = sweep(par, starts, one.segments, one.y, one.delta, one.at, one.dt, np.sqrt(W), e, J)
        off, away = par - self.par0, starts - self.prior
        return one.discount * squares + float(off @ self.Lambda @ off + (self.K * away**2).sum())

    def weights(self, W: np.ndarray) -> np.ndarray:
        """Estimate W from the residuals; rescale residuals and sensitivities."""
        fresh = 1.0 / np.maximum((self.e**2).mean(axis=0) / W, SIGMA**2)
        ratio = np.sqrt(fresh / W)
        self.e *= ratio
        self.J *= ratio[:, None]
        return fresh

    def cost(self, par: np.ndarray, starts: np.ndarray) -> float:
        """Return the cost of the stored residuals."""
        off, away = par - self.par0, starts - self.prior
        return self.problem.discount * float((self.e**2).sum()) + float(
            off @ self.Lambda @ off + (self.K * away**2).sum()
        )

    def normal(self, par: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return information and gradient of the parameters, start states eliminated, and the back-substitution.

        The back-substitution is the step of each start state and its derivative by the parameter step, (m, 9, 37 + 1).
        """
        d = self.problem.discount
        m = len(starts)
        HH, gg = np.empty((m, N_COLUMN, N_COLUMN)), np.empty((m, N_COLUMN))
        for s in range(m):
            J, e = (rows[self.bounds[s] : self.bounds[s + 1]].reshape(-1, *rows.shape[2:]) for rows in (self.J, self.e))
            HH[s], gg[s] = J.T @ J, J.T @ e.ravel()
        HH *= d
        gg *= d
        inverse = np.linalg.inv(HH[:, N_PAR:, N_PAR:] + np.diag(self.K))
        cross, rest = HH[:, N_PAR:, :N_PAR], gg[:, N_PAR:] - self.K * (starts - self.prior)
        back = inverse @ np.concatenate([cross, rest[..., None]], axis=2)
        H = HH[:, :N_PAR, :N_PAR].sum(axis=0) - np.tensordot(cross, back[..., :-1], ((0, 1), (0, 1)))
        g = gg[:, :N_PAR].sum(axis=0) - np.tensordot(cross, back[..., -1], ((0, 1), (0, 1)))
        return H, g - self.Lambda @ (par - self.par0), back


def search(
    problem: Problem, par: np.ndarray, prior: tuple[np.ndarray, np.ndarray], steps: int, weight: np.ndarray | None
) -> Found:
    """Minimise the cost from `par` by at most `steps` damped Gauss-Newton steps.

    Args:
        problem: the data
        par: start, (37,)
        prior: prior mean, (37,), and inverse covariance, (37, 37)
        steps: maximum steps that descend
        weight: W of an earlier search on similar data; None: from the data, updated twice
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # sensitivities may overflow before the free run does
            return _descend(_Search(problem, *prior), par, steps, weight)
    except np.linalg.LinAlgError:
        return Found(par, np.zeros((N_PAR, N_PAR)), SIGMA**-2, 0, float("nan"))


def _descend(look: _Search, par: np.ndarray, steps: int, weight: np.ndarray | None) -> Found:
    cold = weight is None
    W = 1.0 / np.maximum(0.05 * look.spread**2, SIGMA**2) if weight is None else weight
    starts, mu, taken = look.prior.copy(), 1e-3 if cold else 1e-5, 0
    cost = look.fly(par, starts, W, True)
    H = np.zeros((N_PAR, N_PAR))
    for count in range(steps):
        if not np.isfinite(cost):
            break
        if cold and count in (1, 3):
            W = look.weights(W)
            cost = look.cost(par, starts)
        H, g, back = look.normal(par, starts)
        lhs = H + look.Lambda
        for _ in range(_TRIES):
            move = np.linalg.solve(lhs + np.diag(mu * np.diag(lhs)), g)
            to = par + move, starts + back[..., -1] - back[..., :-1] @ move
            trial = look.fly(*to, W, False)
            if trial < cost:
                break
            mu = max(8 * mu, 1e-3)
        else:
            break
        (par, starts), mu, taken = to, max(mu / 5, 1e-6), taken + 1
        fell, cost = cost - trial, trial
        if (not cold or count > 3) and fell < _DONE * cost:
            break
        if count < steps - 1:
            cost = look.fly(par, starts, W, True)
    if not cold and np.isfinite(cost):
        W = 1.0 / np.maximum(0.9 / W + 0.1 * (look.e**2).mean(axis=0) / W, SIGMA**2)
    return Found(par, H, W, taken, cost if np.isfinite(cost) else float("nan"))
