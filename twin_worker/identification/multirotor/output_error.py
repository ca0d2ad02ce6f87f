"""Identification of the rotor model: output errors of short free runs, with the priors of all parameters.

Velocities and attitude are two problems of one form: velocities follow from motor inputs and the measured attitude,
the attitude from its command. Each run has its own start state. Source: Ljung 1999, ch. 7 and section 10.2.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from twin_worker.identification.multirotor.rotor_model import (
    HIGH,
    LOW,
    N_PAR,
    N_START,
    N_VELOCITY,
    STATES,
    RotorModel,
    free_run,
    prior,
    start_states,
)
from twin_worker.identification.multirotor.rotor_window import DT, RotorWindow
from twin_worker.numerics.gauss_newton import gauss_newton

RUN_S = 4.0  # free run [s]
EFFECTIVE_FRACTION = 0.075  # effective share of the residuals: three in four seconds, as on wings; gusts correlate them
MIN_RUNS = 4
COLD_STEPS, WARM_STEPS = 10, 2  # most steps of a first and of a repeated search
# of the measured start states and of gusts [m/s, rad, rad/s]
START_STD = np.array([0.3, 0.3, 0.3, 0.01, 0.01, 0.2, 0.2, 1.0, 1.0])
FIRST_STD = np.array([0.3, 0.3, 0.3, 0.03, 0.03])  # of the residuals before the first run
_LEAST_STD = np.array([0.05, 0.05, 0.05, 0.003, 0.003])
_STEPS = np.array([0.05, 0.02, 0.02, 5e-4, 0.01, 1e-3, 0.1, 0.1, 2e-3, 2e-3, 0.1, 0.02, 2e-3, 0.1, 0.02, 2e-3])
_START_STEPS = np.array([0.05, 0.05, 0.05, 2e-3, 2e-3, 0.02, 0.02, 0.1, 0.1])


class RotorProblem(NamedTuple):
    """Free runs of one part of the model.

    Attributes:
        window: flight
        rows: first row of each run, (k,)
        length: steps of a run
        commanded: the attitude is simulated, else the velocities with the measured attitude
    """

    window: RotorWindow
    rows: np.ndarray
    length: int
    commanded: bool

    @property
    def parameters(self) -> slice:
        """Return the parameters of this part."""
        return slice(N_VELOCITY, N_PAR) if self.commanded else slice(0, N_VELOCITY)

    @property
    def outputs(self) -> slice:
        """Return the states compared."""
        return slice(3, 5) if self.commanded else slice(0, 3)

    @property
    def start(self) -> np.ndarray:
        """Return the start states that act on them."""
        return np.array([3, 4, 5, 6] if self.commanded else [0, 1, 2, 7, 8])

    def measured(self) -> np.ndarray:
        """Return the measured states of the runs, (k, length + 1, c)."""
        rows = self.rows[:, None] + np.arange(self.length + 1)
        return self.window.states[rows][..., self.outputs]

    def simulated(self, par: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Return the simulated states of the runs, (k, length + 1, c)."""
        run = free_run(par, self.window, self.rows, starts, self.length, commanded=self.commanded)
        return run[..., self.outputs]

    def jacobian(self, par: np.ndarray, starts: np.ndarray, base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives by parameters and start states, (k, length + 1, c, p) and (k, length + 1, c, s)."""
        by_par, by_start = [], []
        for i in range(self.parameters.start, self.parameters.stop):
            moved = par.copy()
            moved[i] += _STEPS[i]
            by_par.append((self.simulated(moved, starts) - base) / _STEPS[i])
        for i in self.start:
            moved = starts.copy()
            moved[:, i] += _START_STEPS[i]
            by_start.append((self.simulated(par, moved) - base) / _START_STEPS[i])
        return np.stack(by_par, axis=-1), np.stack(by_start, axis=-1)


def identify(
    window: RotorWindow,
    params: Mapping[str, float],
    base: RotorModel | None = None,
    warm_start: RotorModel | None = None,
) -> RotorModel:
    """Identify the rotor model from one window of flight.

    Args:
        window: flight
        params: autopilot parameters: thrust curve
        base: model of the flight before the window, the prior; None: none yet
        warm_start: an earlier model; the search begins there
    Raises:
        ValueError: if there are too few runs without a gap, or a run leaves the flight envelope.
    """
    length = round(RUN_S / DT)
    rows = window.runs(length)
    if len(rows) < MIN_RUNS:
        raise ValueError(
            f"rotor model: found {len(rows)} runs of {RUN_S:.0f} s without a gap, needs {MIN_RUNS}; wait for more"
        )
    mean, precision = prior(window, params, base)
    par = mean.copy() if warm_start is None else warm_start.par.copy()
    information, weight, steps = precision.copy(), FIRST_STD**-2.0, 0
    for commanded in (False, True) if window.has_command else (False,):
        problem = RotorProblem(window, rows, length, commanded)
        most = COLD_STEPS if warm_start is None else WARM_STEPS
        values, H, part_weight, count = _search(problem, par, (mean, precision), most)
        used = problem.parameters
        par[used], information[used, used] = values[used], H
        weight[problem.outputs], steps = part_weight, max(steps, count)
    through_air = window.velocity[window.ok] - np.array([par[6], par[7], 0.0])
    return RotorModel(
        par=par,
        information=information,
        prior_precision=precision,
        weight=weight,
        has_command=window.has_command,
        hover=float(window.inputs[window.ok].mean()),
        speed=float(np.linalg.norm(through_air, axis=1).mean()),
        t0=float(window.t[0]),
        t1=float(window.t[-1]),
        steps=steps,
    )


def _search(
    problem: RotorProblem, par: np.ndarray, prior_of: tuple[np.ndarray, np.ndarray], most: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Return parameters, their information, the weights of the residuals and the number of steps."""
    mean, precision = prior_of[0][problem.parameters], prior_of[1][problem.parameters, problem.parameters]
    measured, first = problem.measured(), start_states(problem.window, problem.rows)
    used, start = problem.parameters, problem.start
    n_runs, p, s = len(first), len(mean), len(start)
    start_precision = START_STD[start] ** -2.0
    weights = [FIRST_STD[problem.outputs] ** -2.0]
    Point = tuple[np.ndarray, np.ndarray]

    def cost_of(point: Point, run: np.ndarray) -> float:
        e, off, moved = measured - run, point[0][used] - mean, (point[1] - first)[:, start]
        squares = EFFECTIVE_FRACTION * ((e**2).sum(axis=(0, 1)) @ weights[0])
        return float(0.5 * (squares + off @ precision @ off + ((moved**2) @ start_precision).sum()))

    def linearise(point: Point, count: int) -> tuple[float, np.ndarray, np.ndarray]:
        run = problem.simulated(*point)
        e = measured - run
        if count < 3:  # afterwards they stay, so that the search converges
            least = _LEAST_STD[problem.outputs] ** 2
            weights[0] = 1.0 / np.maximum((e[:, 1:] ** 2).mean(axis=(0, 1)), least)
        by_par, by_start = problem.jacobian(*point, run)
        w = EFFECTIVE_FRACTION * weights[0][:, None]
        n = p + n_runs * s
        H, g = np.zeros((n, n)), np.zeros(n)
        H[:p, :p] = np.einsum("klcp,klcq->pq", w * by_par, by_par) + precision
        g[:p] = np.einsum("klcp,klc->p", w * by_par, e) - precision @ (point[0][used] - mean)
        cross = np.einsum("klcp,klcs->kps", w * by_par, by_start)
        square = np.einsum("klcs,klct->kst", w * by_start, by_start) + np.diag(start_precision)
        down = np.einsum("klcs,klc->ks", w * by_start, e) - (point[1] - first)[:, start] * start_precision
        for k in range(n_runs):
            own = slice(p + k * s, p + (k + 1) * s)
            H[:p, own], H[own, :p], H[own, own], g[own] = cross[k], cross[k].T, square[k], down[k]
        return cost_of(point, run), H, g

    def move(point: Point, dx: np.ndarray) -> tuple[Point, float]:
        moved, starts = point[0].copy(), point[1].copy()
        moved[used] = np.clip(moved[used] + dx[:p], LOW[used], HIGH[used])
        starts[:, start] += dx[p:].reshape(n_runs, s)
        run = problem.simulated(moved, starts)
        return (moved, starts), cost_of((moved, starts), run) if np.isfinite(run).all() else np.inf

    begin = par.copy()
    begin[used] = np.clip(begin[used], LOW[used], HIGH[used])
    point, cost, steps = gauss_newton((begin, first), linearise, move, steps=most, converges_from=3)
    if not np.isfinite(cost):
        raise ValueError("rotor model: found a run that leaves the flight envelope; it is repeated with more flight")
    _, H, _ = linearise(point, steps)
    reduced = H[:p, :p] - H[:p, p:] @ np.linalg.solve(H[p:, p:], H[p:, :p])
    return point[0], 0.5 * (reduced + reduced.T), weights[0], steps


assert len(_STEPS) == N_PAR and len(_START_STEPS) == N_START and len(FIRST_STD) == len(STATES)
