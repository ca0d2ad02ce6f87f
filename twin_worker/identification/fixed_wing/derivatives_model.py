"""Derivatives model of a fixed wing: prior, stability and control derivatives and mean wind from a window.

Exact kinematics and the mean wind in body axes couple both axes; the linearised model has a much lower fit.
The information of the last verified model, partly discounted, is the prior of the next window.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import cos
from typing import NamedTuple

import numpy as np
import scipy.linalg

from fleet.airframes import Airframe, derivatives
from fleet.contract import LinearModel
from fleet.frames import G, ned_to_body
from fleet.physics.dynamics import free_runs, jacobian, rates_of_change
from fleet.physics.simulate import TAU, lagged
from fleet.physics.wrench import N_AERO, N_PAR, NAMES, OFFSETS, WIND
from fleet.window import INPUTS, STATES, Window
from twin_worker.identification.fixed_wing.output_error import (
    EstimationProblem,
    EstimationResult,
    estimate,
    unbroken_segments,
)
from twin_worker.identification.linear.linear_model import about_trim

_SIGMA_TABLE = {  # added to the derivative's magnitude; the sum is scaled by `doubt` of the airframe
    "X": {"0": 2.0, "u": 0.2, "w": 0.3, "de": 1.2, "dt": 1.0, "ww": 0.05},
    "Z": {"0": 3.0, "u": 0.3, "w": 0.3, "q": 0.3, "de": 1.0},
    "M": {"0": 3.0, "u": 0.05, "w": 0.01, "q": 0.1, "de": 0.1, "dt": 1.0},
    "Y": {"v": 0.05, "p": 0.3, "r": 0.3, "da": 0.4, "dr": 0.4, "0": 0.5},
    "L": {"v": 0.01, "p": 0.1, "r": 0.1, "da": 0.1, "dr": 0.1, "0": 2.0},
    "N": {"v": 0.01, "p": 0.1, "r": 0.1, "da": 0.1, "dr": 0.1, "0": 0.5},
}
_SIGMA_FLOOR = {f"{row}_{per}": sigma for row, row_sigmas in _SIGMA_TABLE.items() for per, sigma in row_sigmas.items()}
_CROSS_TERMS = {"L_r": ("L_p", 0.3), "N_p": ("L_p", 0.3), "L_dr": ("L_da", 0.1), "N_da": ("L_da", 0.1)}
_WIND_SIGMA = 2.0  # standard deviation of the wind estimate [m/s]
_SPAN_RANGE = 0.3, 20.0  # valid range [m]


def prior(
    airframe: Airframe, trim_velocity: np.ndarray, trim: np.ndarray, wind: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of the parameters of `fleet.physics.wrench`, each (37,).

    Args:
        airframe: the aircraft or its class; without a span it is scaled by its speed
        trim_velocity: U0, W0, mean air-relative velocity forward and down, (2,) [m/s]
        trim: mean inputs delta_a delta_e delta_r delta_t, (4,)
        wind: mean wind, NED, the direction it blows to, (2,) or (3,) [m/s]
    """
    mean = dict.fromkeys(NAMES, 0.0)
    floor = dict(_SIGMA_FLOOR)
    if airframe.scale:
        k = airframe.value["speed"] / trim_velocity[0]
        l = airframe.value["b"] / float(np.clip(airframe.span, *_SPAN_RANGE)) if airframe.span else k
        mean |= {n: v * _scale(n, k, l) for n, v in derivatives(airframe, airframe.value["speed"]).items()}
        floor |= {n: _SIGMA_FLOOR[n] * l for n in ("M_0", "M_dt", "L_0", "N_0")}
    else:
        mean |= derivatives(airframe, float(trim_velocity[0]))
    _set_offsets(mean, trim_velocity, trim)
    for name, (main, fraction) in _CROSS_TERMS.items():
        floor[name] += fraction * abs(mean[main])
    par = np.array([mean[name] for name in NAMES])
    magnitude = np.abs(par)
    magnitude[list(OFFSETS)] = 0.0
    sigma = airframe.value["doubt"] * (magnitude + [floor.get(name, 0.0) for name in NAMES])
    par[-2:], sigma[-2:] = wind[:2], _WIND_SIGMA
    return par, sigma


def _set_offsets(mean: dict[str, float], trim_velocity: np.ndarray, trim: np.ndarray) -> None:
    """Set the offsets such that level flight at trim is an equilibrium."""
    mean["X_0"] = G * trim_velocity[1] / trim_velocity[0] - mean["X_dt"] * trim[3] - mean["X_de"] * trim[1]
    mean["Z_0"] = -G * cos(trim_velocity[1] / trim_velocity[0]) - mean["Z_de"] * trim[1]
    mean["M_0"] = -mean["M_de"] * trim[1] - mean["M_dt"] * trim[3]


def _scale(name: str, k: float, l: float) -> float:
    """Return the scale factor from speed and span of the class to those of the aircraft."""
    force, per = name[0] in "XYZ", name[2:]
    if per in ("q", "p", "r"):
        return k * k / l if force else k
    if per == "ww":
        return k * k
    power = k if per in ("u", "v", "w") else 1.0
    return power if force else power * l


EFFECTIVE_FRACTION = 0.12  # effective fraction of residuals, one in four samples: gusts correlate them [-]
COLD_STEPS, WARM_STEPS = 8, 1  # maximum steps of a first and of a repeated search
# retained fraction of earlier information per window [-]
_RETENTION, _RETENTION_OFFSETS, _RETENTION_WIND = 0.7, 0.5, 0.7
_RETENTION_VECTOR = np.full(N_PAR, _RETENTION)
_RETENTION_VECTOR[list(OFFSETS)] *= _RETENTION_OFFSETS
_RETENTION_VECTOR[WIND:] *= _RETENTION_WIND


@dataclass(frozen=True)
class DerivativesModel:
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
        siblings: aircraft of its type that the prior was learnt from; 0: none
    """

    par: np.ndarray
    trim_velocity: np.ndarray
    fisher_information: np.ndarray
    prior_mean: np.ndarray
    prior_precision: np.ndarray
    weight: np.ndarray
    airframe_prior: tuple[np.ndarray, np.ndarray]
    t0: float
    t1: float
    steps: int
    siblings: int = 0

    @property
    def covariance(self) -> np.ndarray:
        """Return the covariance of the parameters, (37, 37)."""
        return np.linalg.inv(self.fisher_information + self.prior_precision)

    def free_run_segments(
        self, starts: np.ndarray, start_rows: np.ndarray, length: int, delta: np.ndarray, dt: float
    ) -> np.ndarray:
        """Simulate from several rows, `length` rows each, nan after leaving the envelope, (n, 9).

        Arguments as for `fleet.physics.dynamics.free_runs`.
        """
        out = np.empty((len(delta), 9))
        free_runs(starts, start_rows, length, delta, self.par, self.trim_velocity, dt, out)
        return out


class TypePrior(NamedTuple):
    """Prior learnt from aircraft of one type.

    Attributes:
        siblings: number of aircraft
        at: returns indices, mean and covariance of some parameters at an airspeed [m/s], (k,), (k,), (k, k)
    """

    siblings: int
    at: Callable[[float], tuple[np.ndarray, np.ndarray, np.ndarray]]


def identify(
    window: Window,
    wind: np.ndarray,
    airframe: Airframe,
    prior_model: DerivativesModel | None = None,
    warm_start: DerivativesModel | None = None,
    *,
    of_type: TypePrior | None = None,
) -> DerivativesModel:
    """Identify a derivatives model from one window.

    Args:
        window: identification data
        wind: mean wind, NED, the direction it blows to, (2,) or (3,) [m/s]
        airframe: prior of the aircraft or of its class
        prior_model: the last verified model; its information from before this window is the prior
        warm_start: model of a similar window that starts the search; not a prior
        of_type: prior learnt from other aircraft of its type, where `prior_model` is None
    Raises:
        ValueError: if the window has too few gap-free rows, or the search fails; wait for more data.
    """
    segments = unbroken_segments(window.ok, window.dt)
    if not len(segments):
        raise ValueError("identify: found no 2 s of unbroken data, needs them; wait")
    y, delta = window.over_ground, lagged(window.u, window.dt, TAU)
    if prior_model is None:
        mean, precision, trim_velocity = _first_prior(window, wind, airframe, of_type)
        nominal = mean, precision
    else:
        mean, precision, trim_velocity, nominal = _continued_prior(window, prior_model)
    problem = EstimationProblem(y, delta, segments, trim_velocity, window.dt, EFFECTIVE_FRACTION)
    result = None
    if warm_start is not None:
        result = estimate(problem, warm_start.par, (mean, precision), WARM_STEPS, warm_start.weight)
    if result is None or not _is_finite(result):
        result = estimate(problem, mean, (mean, precision), COLD_STEPS, None)
    if not _is_finite(result):
        if prior_model is not None:  # the earlier model misleads: restart without it
            return identify(window, wind, airframe)
        raise ValueError("identify: found no free run that stays in its envelope, needs one; wait for calmer flight")
    t = window.t
    return DerivativesModel(
        result.par,
        trim_velocity,
        result.fisher_information,
        mean,
        precision,
        result.weight,
        nominal,
        float(t[0]),
        float(t[-1]),
        result.steps,
        prior_model.siblings if prior_model is not None else of_type.siblings if of_type is not None else 0,
    )


def _is_finite(result: EstimationResult) -> bool:
    return bool(
        np.isfinite(result.par).all() and np.isfinite(result.fisher_information).all() and np.isfinite(result.cost)
    )


def _first_prior(
    window: Window, wind: np.ndarray, airframe: Airframe, of_type: TypePrior | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return prior mean and precision of the parameters from the airframe and from aircraft of its type, and U0 W0."""
    ok = window.ok
    air, trim = window.x[ok, :3].mean(axis=0), window.u[ok].mean(axis=0)
    trim_velocity = np.array([max(np.linalg.norm(window.x[ok, :3], axis=1).mean(), 1.0), air[2]])
    mean, sigma = prior(airframe, trim_velocity, trim, wind)
    precision = np.diag(sigma**-2.0)
    if of_type is not None:
        rows, values, covariance = of_type.at(float(trim_velocity[0]))
        mean[rows], precision[np.ix_(rows, rows)] = values, np.linalg.inv(covariance)
        known = dict(zip(NAMES, mean, strict=True))
        _set_offsets(known, trim_velocity, trim)
        mean = np.array([known[name] for name in NAMES])
    return mean, precision, trim_velocity


def _continued_prior(
    window: Window, prior_model: DerivativesModel
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return prior mean and precision of the parameters, U0 W0, and the prior of the first window.

    Only the information of the last model from before this window counts, discounted, so that no data count twice.
    """
    nominal, nominal_precision = prior_model.airframe_prior
    elapsed = float(np.clip((window.t[0] - prior_model.t0) / (prior_model.t1 - prior_model.t0), 0.0, 1.0))
    root = np.sqrt(_RETENTION_VECTOR**elapsed)
    retained, from_data = (
        root[:, None] * matrix * root
        for matrix in (prior_model.prior_precision, elapsed * prior_model.fisher_information)
    )
    from_airframe = (1.0 - _RETENTION**elapsed) * nominal_precision
    precision = retained + from_data + from_airframe
    mean = np.linalg.solve(
        precision, retained @ prior_model.prior_mean + from_data @ prior_model.par + from_airframe @ nominal
    )
    return mean, precision, prior_model.trim_velocity, prior_model.airframe_prior


_AXES = (
    (("u", "w", "q", "theta"), ("delta_e", "delta_t")),
    (("phi", "psi", "p", "r", "v"), ("delta_a", "delta_r")),
)
_ZERO_AT_TRIM = ("p", "q", "r", "v", "phi")  # zero at the trim point
_INPUT_STEP = 1e-4  # step of the input derivatives, in which the model is linear [-]


def linearise(plant: DerivativesModel, window: Window) -> tuple[LinearModel, LinearModel]:
    """Return discrete matrices at the sample time of the window; u v w are through the air, on any heading.

    Args:
        plant: the derivatives model
        window: flight data; mean speed, attitude and inputs are the trim point
    """
    ok, dt = window.ok, window.dt
    x, u = window.x[ok].mean(axis=0), window.u[ok].mean(axis=0)
    wind = np.array([*plant.par[WIND:], 0.0])
    phi, theta, psi = window.x[ok, 6:].T
    x[:3] = ned_to_body(phi, theta, psi, window.v[ok] - wind).mean(axis=0)
    x[[STATES.index(name) for name in _ZERO_AT_TRIM]] = 0.0
    windless = plant.par.copy()
    windless[WIND:] = 0.0
    F, by_wind, term = np.empty((9, 9)), np.empty((9, 2)), np.empty(N_AERO)
    jacobian(x, u, windless, plant.trim_velocity, F, by_wind, term)
    rate, perturbed = np.empty(9), np.empty(9)
    rates_of_change(x, u, windless, plant.trim_velocity, rate)
    G = np.empty((9, 4))
    for k in range(4):
        rates_of_change(x, u + _INPUT_STEP * np.eye(4)[k], windless, plant.trim_velocity, perturbed)
        G[:, k] = (perturbed - rate) / _INPUT_STEP
    lon, lat = (_axis(np.hstack([F, G, rate[:, None]]), x, u, axis, dt) for axis in _AXES)
    return lon, lat


def _axis(slopes: np.ndarray, x: np.ndarray, u: np.ndarray, axis: tuple, dt: float) -> LinearModel:
    """Extract one axis from [F G x'] and discretise it, exp([[A B c] [0 0 0]] dt); c moves into the trim."""
    names, inputs = axis
    rows, columns = [STATES.index(name) for name in names], [INPUTS.index(name) for name in inputs]
    n, m = len(rows), len(columns)
    augmented = np.zeros((n + m + 1, n + m + 1))
    augmented[:n] = slopes[np.ix_(rows, [*rows, *(len(x) + k for k in columns), -1])]
    return about_trim(axis, scipy.linalg.expm(augmented * dt)[:n], (x[rows], u[columns]), dt)
