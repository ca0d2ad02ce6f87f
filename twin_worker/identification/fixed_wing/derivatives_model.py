"""The coupled model of a fixed wing: derivatives and mean wind, identified from one window of flight.

Exact kinematics and the mean wind in body axes couple both axes; linearising the same model loses most of its worth.
What a verified model said of an earlier stretch holds the parameters of the next, partly forgotten.
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

DISCOUNT = 0.12  # information in a residual, one of every four samples: gusts colour them [-]
COLD, WARM = 8, 1  # most steps of a first and of a repeated search
_FORGET, _FORGET_OFFSETS, _FORGET_WIND = 0.7, 0.5, 0.7  # share of earlier information that is kept, per stretch [-]


@dataclass(frozen=True)
class Coupled:
    """One identified aircraft.

    Attributes:
        par: parameters of `fleet.physics.wrench`, (37,)
        at: U0, W0 they belong to, (2,) [m/s]
        information: what the data said of them, (37, 37)
        mean, precision: what was held before, (37,) and (37, 37)
        weight: inverse residual variances, (9,)
        airframe: mean and precision of what was known before any flight
        t0, t1: the stretch it came from [s since 1970]
        steps: of the search
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
        """Run free from x0 with inputs as they act, (n, 4); give the states, (n, 9), nan once it left its envelope."""
        return self.fly_each(x0[None], np.zeros(1, np.int64), len(delta), delta, dt)

    def fly_each(self, starts: np.ndarray, begins: np.ndarray, length: int, delta: np.ndarray, dt: float) -> np.ndarray:
        """Run free from several rows, `length` rows each; arguments as for `fleet.physics.dynamics.free_runs`."""
        out = np.empty((len(delta), 9))
        free_runs(starts, begins, length, delta, self.par, self.at, dt, out)
        return out


def identify(
    window: Window, wind: np.ndarray, airframe: Airframe, last: Coupled | None = None, near: Coupled | None = None
) -> Coupled:
    """Identify an aircraft from one window.

    Args:
        window: the stretch
        wind: mean wind, NED, the direction it blows to, (2,) or (3,) [m/s]
        airframe: what is known of the aircraft before it has flown, or a class
        last: the last verified model; it holds the parameters by what it knows from before this window
        near: a model of nearly this stretch, where the search starts; it holds nothing
    Raises:
        ValueError: when too little of the window is whole, or nothing descends; wait for more.
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
    if last is not None and not _good(found):  # what an earlier flight said misleads: begin anew
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
    """Return mean and precision the parameters are held by, U0 W0, and what the airframe alone says.

    Of what the last model's data said, the share from before this window counts, and fades: none is counted twice.
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
