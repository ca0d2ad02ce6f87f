"""Derivatives model of a fixed wing: stability and control derivatives and mean wind, identified from one window.

Exact kinematics and the mean wind in body axes couple both axes; the linearised model has a much lower fit.
The information of the last verified model, partly discounted, is the prior of the next window.
"""

from dataclasses import dataclass

import numpy as np

from fleet.airframes import Airframe
from fleet.physics.actuators import TAU, lagged
from fleet.physics.dynamics import free_runs
from fleet.physics.wrench import N_PAR, OFFSETS, WIND
from fleet.window import Window
from twin_worker.identification.fixed_wing.derivatives_prior import prior
from twin_worker.identification.fixed_wing.output_error import Found, Problem, search, segments_of

DISCOUNT = 0.12  # effective fraction of residuals, one in four samples: gusts correlate them [-]
COLD, WARM = 8, 1  # maximum steps of a first and of a repeated search
# retained fraction of earlier information per window [-]
_FORGET, _FORGET_OFFSETS, _FORGET_WIND = 0.7, 0.5, 0.7


@dataclass(frozen=True)
class Coupled:
    """Identified derivatives model of one aircraft.

    Attributes:
        par: parameters of `fleet.physics.wrench`, (37,)
        trim_velocity: U0, W0 of the parameters, (2,) [m/s]
        fisher_information: information from the data, (37, 37)
        prior_mean, prior_precision: prior of this window, (37,) and (37, 37)
        weight: inverse residual variances, (9,)
        airframe_prior: mean and precision from the airframe alone
        t0, t1: identification window [s since 1970]
        steps: search steps
    """

    par: np.ndarray
    at: np.ndarray
    information: np.ndarray
    mean: np.ndarray
    precision: np.ndarray
    weight: np.ndarray
    airframe: tuple[np.ndarray, np.ndarray]
    t0: float
    t1: float
    steps: int

    @property
    def covariance(self) -> np.ndarray:
        """Return the covariance of the parameters, (37, 37)."""
        return np.linalg.inv(self.information + self.precision)

    def fly(self, x0: np.ndarray, delta: np.ndarray, dt: float) -> np.ndarray:
        """Simulate from x0 with actuator states, (n, 4); return states, (n, 9), nan after leaving the envelope."""
        return self.fly_each(x0[None], np.zeros(1, np.int64), len(delta), delta, dt)

    def fly_each(self, starts: np.ndarray, begins: np.ndarray, length: int, delta: np.ndarray, dt: float) -> np.ndarray:
        """Simulate from several rows, `length` rows each; arguments as for `fleet.physics.dynamics.free_runs`."""
        out = np.empty((len(delta), 9))
        free_runs(starts, begins, length, delta, self.par, self.at, dt, out)
        return out


def identify(
    window: Window, wind: np.ndarray, airframe: Airframe, last: Coupled | None = None, near: Coupled | None = None
) -> Coupled:
    """Identify a derivatives model from one window.

    Args:
        window: identification data
        wind: mean wind, NED, the direction it blows to, (2,) or (3,) [m/s]
        airframe: prior of the aircraft or of its class
        prior_model: the last verified model; its information from before this window is the prior
        warm_start: model of a similar window that starts the search; not a prior
    Raises:
        ValueError: if the window has too few gap-free rows, or the search fails; wait for more data.
    """
    segments = segments_of(window.ok, window.dt)
    if not len(segments):
        raise ValueError("identify: found no 2 s of unbroken data, needs them; wait")
    y, delta = window.over_ground, lagged(window.u, window.dt, TAU)
    mean, precision, at, nominal = _held(window, wind, airframe, last)
    problem = Problem(y, delta, segments, at, window.dt, DISCOUNT)
    if near is not None:
        found = search(problem, near.par, (mean, precision), WARM, near.weight)
    else:
        found = search(problem, mean, (mean, precision), COLD, None)
    if near is not None and not _good(found):
        found = search(problem, mean, (mean, precision), COLD, None)
    if last is not None and not _good(found):  # the earlier model misleads: restart without it
        return identify(window, wind, airframe)
    if not _good(found):
        raise ValueError("identify: found no free run that stays in its envelope, needs one; wait for calmer flight")
    t = window.t
    return Coupled(
        found.par, at, found.information, mean, precision, found.weight, nominal, float(t[0]), float(t[-1]), found.steps
    )


def _good(found: Found) -> bool:
    return bool(np.isfinite(found.par).all() and np.isfinite(found.information).all() and np.isfinite(found.cost))


def _held(
    window: Window, wind: np.ndarray, airframe: Airframe, last: Coupled | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return prior mean and precision of the parameters, U0 W0, and the prior from the airframe alone.

    Only the information of the last model from before this window counts, discounted, so that no data count twice.
    """
    if last is None:
        ok = window.ok
        air = window.x[ok, :3].mean(axis=0)
        at = np.array([max(np.linalg.norm(window.x[ok, :3], axis=1).mean(), 1.0), air[2]])
        mean, sigma = prior(airframe, at, window.u[ok].mean(axis=0), wind)
        precision = np.diag(sigma**-2.0)
        return mean, precision, at, (mean, precision)
    nominal, firm = last.airframe
    moved = float(np.clip((window.t[0] - last.t0) / (last.t1 - last.t0), 0.0, 1.0))
    root = np.sqrt(_KEEP**moved)
    before, told = (root[:, None] * each * root for each in (last.precision, moved * last.information))
    fresh = (1.0 - _FORGET**moved) * firm
    precision = before + told + fresh
    mean = np.linalg.solve(precision, before @ last.mean + told @ last.par + fresh @ nominal)
    return mean, precision, last.at, last.airframe


_KEEP = np.full(N_PAR, _FORGET)
_KEEP[list(OFFSETS)] *= _FORGET_OFFSETS
_KEEP[WIND:] *= _FORGET_WIND
