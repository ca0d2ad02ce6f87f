"""Second step, coupled: derivatives and mean wind of a whole aircraft from the error of free runs.

    J = discount sum e' W e + (par - par0)' Lambda (par - par0) + sum_s (x_s - x_bar_s)' K (x_s - x_bar_s)

over segments of free run, whose start states x_s are unknown, too, and are eliminated from every step by their Schur
complement. Gauss-Newton steps, damped; W from the residuals themselves.

Source: Jategaonkar 2015, chapter 4 (output error, multiple shots); Ljung 1999, section 10.2 (damping).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fleet.physics.wrench import N_PAR
from twin_worker.identification.fixed_wing.output_error_kernel import GROUP, N_COLUMN, sweep

SIGMA = np.array([0.08, 0.08, 0.08, 0.005, 0.005, 0.005, 0.004, 0.004, 0.008])  # least residual of each state
SEGMENT_S = 10.0  # free run [s]
LEAST_S = 2.0  # shorter pieces between gaps are left out [s]
LINE = 6  # samples of the line a segment's start state is read off [-]
_DONE = 1e-3  # relative descent that ends the search [-]
_TRIES = 6  # dampings tried for one step


@dataclass(frozen=True)
class Problem:
    """What a search starts from.

    Attributes:
        y: states, u v w over the ground, (n, 9)
        delta: inputs as they act, (n, 4)
        segments: first and last row of each, (m, 2)
        at: U0, W0, (2,) [m/s]
        dt: sample time [s]
        discount: information in a residual; gusts colour them [-]
    """

    y: np.ndarray
    delta: np.ndarray
    segments: np.ndarray
    at: np.ndarray
    dt: float
    discount: float


@dataclass(frozen=True)
class Found:
    """Where a search ended.

    Attributes:
        par: parameters, (37,)
        information: what the data said of them, start states eliminated, (37, 37)
        weight: inverse residual variances, (9,)
        steps: Gauss-Newton steps that descended
        cost: of the end point, nan where even the start left its envelope or its slopes did
    """

    par: np.ndarray
    information: np.ndarray
    weight: np.ndarray
    steps: int
    cost: float


def segments_of(ok: np.ndarray, dt: float) -> np.ndarray:
    """Cut unbroken rows into free runs of a whole number of groups, (m, 2)."""
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
    """Read the first state off a straight line through the first samples, (9,)."""
    n = min(LINE, len(y))
    return _line(n) @ y[:n]


@lru_cache(maxsize=LINE)
def _line(n: int) -> np.ndarray:
    return np.linalg.pinv(np.column_stack([np.ones(n), np.arange(n)]))[0]


class _Search:
    """The cost about one point, and the step down from it."""

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
        """Return the cost at a point; with `slopes` the residuals and sensitivities are kept."""
        one = self.problem
        e, J = (self.e, self.J) if slopes else (self.trial, self.nothing)
        squares = sweep(par, starts, one.segments, one.y, one.delta, one.at, one.dt, np.sqrt(W), e, J)
        off, away = par - self.par0, starts - self.prior
        return one.discount * squares + float(off @ self.Lambda @ off + (self.K * away**2).sum())

    def weights(self, W: np.ndarray) -> np.ndarray:
        """Take W from the residuals; they and their slopes are scaled along."""
        fresh = 1.0 / np.maximum((self.e**2).mean(axis=0) / W, SIGMA**2)
        ratio = np.sqrt(fresh / W)
        self.e *= ratio
        self.J *= ratio[:, None]
        return fresh

    def cost(self, par: np.ndarray, starts: np.ndarray) -> float:
        """Return the cost of the residuals that are kept."""
        off, away = par - self.par0, starts - self.prior
        return self.problem.discount * float((self.e**2).sum()) + float(
            off @ self.Lambda @ off + (self.K * away**2).sum()
        )

    def normal(self, par: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return information and slope of the parameters, start states eliminated, and what gives those back.

        That is of each segment the move of its start, less what a move of the parameters takes, (m, 9, 37 + 1).
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
    """Descend from `par` by at most so many damped Gauss-Newton steps.

    Args:
        problem: the data
        par: where to start, (37,)
        prior: where the parameters are held without data, (37,), and how firmly, inverse covariance (37, 37)
        steps: most steps that descend
        weight: W of an earlier search of like data; None: from the data, refreshed twice
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # slopes may explode where the free run does not yet
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
