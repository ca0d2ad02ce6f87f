"""Output-error estimation of derivatives and mean wind from free runs of both axes.

    J = f sum e' W e + (par - par0)' Lambda (par - par0) + sum_s (x_s - x_bar_s)' K (x_s - x_bar_s)

over free-run segments; f is the effective fraction of residuals. The start states x_s are also unknown; every step
eliminates them by their Schur complement. Damped Gauss-Newton steps; W is estimated from the residuals.

Source: Jategaonkar 2015, chapter 4 (output error, multiple shots); Ljung 1999, section 10.2 (damping).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fleet.compiled_frames import assign
from fleet.physics.dynamics import N_X, is_diverged, jacobian, step
from fleet.physics.kernel import kernel, no_alloc_kernel
from fleet.physics.wrench import N_AERO, N_PAR, ROW, WIND
from twin_worker.numerics.gauss_newton import gauss_newton

GROUP = 4  # samples per residual; 2 ** _DOUBLINGS
_DOUBLINGS = 2
N_COLUMN = N_PAR + N_X


@no_alloc_kernel
def _matmul(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    """Compute a b, (9, n), of a (9, 9) and b (9, n); named elements of a row stay in registers, indexed ones do not."""
    for i in range(N_X):
        a0, a1, a2, a3, a4, a5, a6, a7, a8 = a[i]
        for j in range(b.shape[1]):
            low = a0 * b[0, j] + a1 * b[1, j] + a2 * b[2, j] + a3 * b[3, j]
            out[i, j] = low + a4 * b[4, j] + a5 * b[5, j] + a6 * b[6, j] + a7 * b[7, j] + a8 * b[8, j]


@kernel
def _transition(F: np.ndarray, dt: float, Phi: np.ndarray, Gamma: np.ndarray, work: np.ndarray) -> None:
    """Compute Phi = exp(F GROUP dt) and its integral: fourth-order Runge-Kutta over one sample, then doubling.

    Phi = I + F Gamma must be exact, otherwise the equilibrium S = -F^-1 G would drift.
    """
    square, cube, scratch = work[0], work[1], work[2]
    _matmul(F, F, square)
    _matmul(F, square, cube)
    for i in range(N_X):
        for j in range(N_X):
            Gamma[i, j] = dt**2 / 2 * F[i, j] + dt**3 / 6 * square[i, j] + dt**4 / 24 * cube[i, j]
        Gamma[i, i] += dt
    for doubling in range(_DOUBLINGS + 1):
        if doubling:
            _matmul(Phi, Gamma, scratch)
            Gamma += scratch
        _matmul(F, Gamma, Phi)
        for i in range(N_X):
            Phi[i, i] += 1.0


@no_alloc_kernel
def _propagate(
    S: np.ndarray, Phi: np.ndarray, Gamma: np.ndarray, term: np.ndarray, by_wind: np.ndarray, out: np.ndarray
) -> None:
    """Compute the sensitivities one group later."""
    _matmul(Phi, S, out)
    for i in range(N_X):
        for a in range(N_AERO):
            out[i, a] += Gamma[i, ROW[a]] * term[a]
        for k in range(6):
            out[i, WIND] += Gamma[i, k] * by_wind[k, 0]
            out[i, WIND + 1] += Gamma[i, k] * by_wind[k, 1]


@kernel
def residuals_and_jacobian(
    par: np.ndarray,
    starts: np.ndarray,
    segments: np.ndarray,
    y: np.ndarray,
    delta: np.ndarray,
    trim_velocity: np.ndarray,
    dt: float,
    weight: np.ndarray,
    e: np.ndarray,
    J: np.ndarray,
) -> float:
    """Simulate every segment; store residuals e = (y - y_hat) weight and, if J has rows, their sensitivities.

    Args:
        par: parameters, (37,)
        starts: start state of each segment, (m, 9)
        segments: first and last row of each, an integer number of groups apart, (m, 2)
        y: measured states, (n, 9)
        delta: actuator states, (n, 4)
        trim_velocity: U0, W0, (2,) [m/s]
        dt: sample time [s]
        weight: square roots of the weights, (9,)
        e: output, residuals by group, (groups, 9)
        J: output, d y_hat / d(par, x0) weight, (groups, 9, 46), or no rows
    Returns:
        the sum of squares; inf if a segment leaves the envelope
    """
    x, half = np.empty(N_X), np.empty(N_X)
    work, matrices = np.empty((3, N_X)), np.empty((5, N_X, N_X))
    F, Phi, Gamma, by_wind = np.empty((N_X, N_X)), matrices[3], matrices[4], np.empty((N_X, 2))
    mean = np.empty(4)
    S, S_next, term = np.empty((N_X, N_COLUMN)), np.empty((N_X, N_COLUMN)), np.empty(N_AERO)
    cost, row = 0.0, 0
    for m in range(len(segments)):
        assign(x, starts[m])
        S[:] = 0.0
        for i in range(N_X):
            S[i, N_PAR + i] = 1.0
        for k in range(segments[m, 0], segments[m, 1], GROUP):
            for i in range(N_X):
                e[row, i] = (y[k, i] - x[i]) * weight[i]
                cost += e[row, i] ** 2
                if len(J):
                    for a in range(N_COLUMN):
                        J[row, i, a] = S[i, a] * weight[i]
            row += 1
            for j in range(GROUP):
                if 2 * j == GROUP:
                    assign(half, x)
                step(x, delta[k + j], par, trim_velocity, dt, work)
            if is_diverged(x):
                return np.inf
            if len(J):
                for i in range(4):
                    mean[i] = delta[k : k + GROUP, i].mean()
                jacobian(half, mean, par, trim_velocity, F, by_wind, term)
                _transition(F, dt, Phi, Gamma, matrices)
                _propagate(S, Phi, Gamma, term, by_wind, S_next)
                S, S_next = S_next, S
    return cost


SIGMA = np.array([0.08, 0.08, 0.08, 0.005, 0.005, 0.005, 0.004, 0.004, 0.008])  # minimum residual of each state
SEGMENT_S = 10.0  # free run [s]
MIN_SEGMENT_S = 2.0  # shorter segments between gaps are ignored [s]
LINE_SAMPLES = 6  # samples of the line fit of a segment's start state [-]
_WEIGHT_UPDATES = (1, 3)  # steps before which a cold search updates the weights
Point = tuple[np.ndarray, np.ndarray]  # parameters (37,), start states (m, 9)


@dataclass(frozen=True)
class EstimationProblem:
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
    trim_velocity: np.ndarray
    dt: float
    effective_fraction: float


@dataclass(frozen=True)
class EstimationResult:
    """Result of an estimation.

    Attributes:
        par: parameters, (37,)
        fisher_information: information from the data, start states eliminated, (37, 37)
        weight: inverse residual variances, (9,)
        steps: Gauss-Newton steps that descended
        cost: final cost; nan if the start or its sensitivities left the envelope
    """

    par: np.ndarray
    fisher_information: np.ndarray
    weight: np.ndarray
    steps: int
    cost: float


def unbroken_segments(ok: np.ndarray, dt: float, longest_s: float = SEGMENT_S) -> np.ndarray:
    """Split gap-free rows into free runs of at most `longest_s` and an integer number of groups, (m, 2)."""
    longest, least = (int(seconds / dt) // GROUP * GROUP for seconds in (longest_s, MIN_SEGMENT_S))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], ok, [False]]).astype(int)))
    pieces = []
    for start, stop in edges.reshape(-1, 2):
        n = max(-(-(stop - start) // longest), 1)
        length = (stop - start) // n // GROUP * GROUP
        if length >= least:
            pieces += [(start + k * length, start + (k + 1) * length) for k in range(n)]
    return np.array(pieces, dtype=np.int64).reshape(-1, 2)


def line_fit_start(y: np.ndarray) -> np.ndarray:
    """Return the first state from a line fit through the first samples, (9,)."""
    n = min(LINE_SAMPLES, len(y))
    return _line_weights(n) @ y[:n]


@lru_cache(maxsize=LINE_SAMPLES)
def _line_weights(n: int) -> np.ndarray:
    return np.linalg.pinv(np.column_stack([np.ones(n), np.arange(n)]))[0]


class _GaussNewton:
    """Cost, residuals and normal equations at one point."""

    def __init__(self, problem: EstimationProblem, par0: np.ndarray, Lambda: np.ndarray) -> None:
        self.problem, self.par0, self.Lambda = problem, par0, Lambda
        measured = [problem.y[a:b] for a, b in problem.segments]
        self.start_prior = np.array([line_fit_start(y) for y in measured])
        self.state_std = np.concatenate(measured).std(axis=0)
        self.K = 1.0 / SIGMA**2
        lengths = (problem.segments[:, 1] - problem.segments[:, 0]) // GROUP
        self.bounds = np.concatenate([[0], np.cumsum(lengths)])
        self.e, self.J = np.empty((self.bounds[-1], 9)), np.empty((self.bounds[-1], 9, N_COLUMN))
        self.trial, self.no_sensitivities = np.empty_like(self.e), np.empty((0, 9, N_COLUMN))

    def simulate(self, par: np.ndarray, starts: np.ndarray, W: np.ndarray, slopes: bool) -> float:
        """Return the cost at a point; with `slopes` store residuals and sensitivities."""
        problem = self.problem
        e, J = (self.e, self.J) if slopes else (self.trial, self.no_sensitivities)
        squares = residuals_and_jacobian(
            par, starts, problem.segments, problem.y, problem.delta, problem.trim_velocity, problem.dt, np.sqrt(W), e, J
        )
        return self.cost(squares, par, starts)

    def update_weights(self, W: np.ndarray) -> np.ndarray:
        """Estimate W from the residuals; rescale residuals and sensitivities."""
        W_new = 1.0 / np.maximum((self.e**2).mean(axis=0) / W, SIGMA**2)
        ratio = np.sqrt(W_new / W)
        self.e *= ratio
        self.J *= ratio[:, None]
        return W_new

    def cost(self, squares: float, par: np.ndarray, starts: np.ndarray) -> float:
        """Return the cost for a sum of squared residuals."""
        par_offset, start_offset = par - self.par0, starts - self.start_prior
        return self.problem.effective_fraction * squares + float(
            par_offset @ self.Lambda @ par_offset + (self.K * start_offset**2).sum()
        )

    def normal_equations(self, par: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return information and gradient of the parameters, start states eliminated, and the back-substitution.

        The back-substitution is the step of each start state and its derivative by the parameter step, (m, 9, 37 + 1).
        """
        d = self.problem.effective_fraction
        m = len(starts)
        HH, gg = np.empty((m, N_COLUMN, N_COLUMN)), np.empty((m, N_COLUMN))
        for s in range(m):
            J, e = (rows[self.bounds[s] : self.bounds[s + 1]].reshape(-1, *rows.shape[2:]) for rows in (self.J, self.e))
            HH[s], gg[s] = J.T @ J, J.T @ e.ravel()
        HH *= d
        gg *= d
        inverse = np.linalg.inv(HH[:, N_PAR:, N_PAR:] + np.diag(self.K))
        cross, start_gradient = HH[:, N_PAR:, :N_PAR], gg[:, N_PAR:] - self.K * (starts - self.start_prior)
        start_moves = inverse @ np.concatenate([cross, start_gradient[..., None]], axis=2)
        H = HH[:, :N_PAR, :N_PAR].sum(axis=0) - np.tensordot(cross, start_moves[..., :-1], ((0, 1), (0, 1)))
        g = gg[:, :N_PAR].sum(axis=0) - np.tensordot(cross, start_moves[..., -1], ((0, 1), (0, 1)))
        return H, g - self.Lambda @ (par - self.par0), start_moves


def estimate(
    problem: EstimationProblem,
    par: np.ndarray,
    prior: tuple[np.ndarray, np.ndarray],
    steps: int,
    weight: np.ndarray | None,
) -> EstimationResult:
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
            return _descend(_GaussNewton(problem, *prior), par, steps, weight)
    except np.linalg.LinAlgError:
        return EstimationResult(par, np.zeros((N_PAR, N_PAR)), SIGMA**-2, 0, float("nan"))


def _descend(problem: _GaussNewton, par: np.ndarray, steps: int, weight: np.ndarray | None) -> EstimationResult:
    cold = weight is None
    W = 1.0 / np.maximum(0.05 * problem.state_std**2, SIGMA**2) if weight is None else weight
    H, start_moves = np.zeros((N_PAR, N_PAR)), np.empty(0)

    def linearise(x: Point, count: int) -> tuple[float, np.ndarray, np.ndarray]:
        nonlocal W, H, start_moves
        cost = problem.simulate(*x, W, True)
        if not np.isfinite(cost):
            return cost, H, H[0]
        if cold and count in _WEIGHT_UPDATES:
            W = problem.update_weights(W)
            cost = problem.cost(float((problem.e**2).sum()), *x)
        H, g, start_moves = problem.normal_equations(*x)
        return cost, H + problem.Lambda, g

    def move(x: Point, change: np.ndarray) -> tuple[Point, float]:
        candidate = x[0] + change, x[1] + start_moves[..., -1] - start_moves[..., :-1] @ change
        return candidate, problem.simulate(*candidate, W, False)

    start = par, problem.start_prior.copy()
    (par, _), cost, steps_taken = gauss_newton(
        start,
        linearise,
        move,
        steps=steps,
        mu=1e-3 if cold else 1e-5,
        converges_from=_WEIGHT_UPDATES[-1] + 1 if cold else 0,
    )
    if not cold and np.isfinite(cost):
        W = 1.0 / np.maximum(0.9 / W + 0.1 * (problem.e**2).mean(axis=0) / W, SIGMA**2)
    return EstimationResult(par, H, W, steps_taken, cost if np.isfinite(cost) else float("nan"))
