"""Residuals of one flight, whitened by the noise of nominal flights, with their derivatives.

Unknowns beside the effects: the rotor parameters with the spread of nominal flights, the wind as an
Ornstein-Uhlenbeck process at knots, and the biases of the sensors within data-sheet limits. All have Gaussian priors,
so that the gain of an effect is a difference of penalised sums of squares.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_toeplitz
from scipy.signal import lfilter

from twin_worker.diagnosis.multirotor.effects import RotorEffect, coordinate_steps, rotor_effects
from twin_worker.diagnosis.multirotor.flight import RotorFlight
from twin_worker.diagnosis.multirotor.model import CHANNELS, PARAMETERS, STEP, residuals

ORDER = 8  # of the autoregression of the residuals
_KNOT_S = 5.0  # between the knots of the wind [s]
_WIND_STD, _GUST_STD, _GUST_S = 6.0, 1.0, 25.0  # of the mean wind and of its changes [m/s]; correlation time [s]
_UNKNOWN_STD = np.array([*[1e4] * 7, *[0.1] * 3, *[1e4] * 9, *[0.03] * 3])  # of parameters before any flight
_MOST_STEP = np.array([2.0, 0.2, 0.02, *[np.inf] * 19])  # of k, expo, tau in one iteration
_LOW = np.array([0.5, 0.0, 0.005, *[-np.inf] * 19])  # least k, expo, tau: without lag there is no derivative by it
_HIGH = np.array([200.0, 1.5, 0.5, *[np.inf] * 19])
_DERIVATIVES = 6  # iterations with new derivatives by the nuisances
_ENOUGH = 0.5  # drop of the cost
_SHARES = 0.5 ** np.arange(6)  # of a step
_LIMIT = 5.0  # standard deviations at which a whitened residual is limited (Huber)
_STEPS = np.array(
    [0.05, 0.02, 0.005, 0.02, 0.001, 0.005, 0.002, *[0.01] * 3, *[0.5] * 3, *[0.05] * 5, 0.05, *[0.01] * 3]
)


@dataclass(frozen=True)
class ResidualNoise:
    """Noise of the channels on nominal flights.

    Attributes:
        filters: prediction error filter of each channel, 1 - a_1 z^-1 ..., over its standard deviation, (13, ORDER + 1)
    """

    filters: np.ndarray


@dataclass(frozen=True)
class ActiveEffect:
    """An effect with its onset [s], None: throughout, and the values of its coordinates."""

    one: RotorEffect
    onset: float | None
    values: np.ndarray

    def profiles(self, t: np.ndarray) -> dict[str, np.ndarray]:
        """Return the value of each coordinate at the times (n,) [s]."""
        share = np.ones(len(t)) if self.onset is None else (t >= self.onset).astype(float)
        return {name: x * share for name, x in zip(self.one.coordinates, self.values.tolist(), strict=True)}


def combined(active: Sequence[ActiveEffect], biases: Mapping[str, float], t: np.ndarray) -> dict[str, np.ndarray]:
    """Return the value of each coordinate from effects and biases."""
    out = {name: np.full(len(t), x) for name, x in biases.items()}
    for one in active:
        for name, x in one.profiles(t).items():
            out[name] = out[name] + x if name in out else x
    return out


@dataclass
class FlightFit:
    """State of the unknowns of one flight: rotor parameters, wind at the knots (K, 2) [m/s], biases."""

    parameters: np.ndarray
    wind: np.ndarray
    biases: dict[str, float] = field(default_factory=dict)


class LinearFlight:
    """One flight and the linearisation of its residuals."""

    def __init__(self, flight: RotorFlight, noise: ResidualNoise | None, weights: np.ndarray | None = None) -> None:
        """Place the wind knots.

        Args:
            flight: measurements
            noise: None: white noise of the flight itself, for the first fit
            weights: scale of the noise of each channel in this flight over that of nominal flights, (13,)
        """
        self.flight = flight
        self.catalogue = rotor_effects(flight.inputs.shape[1])
        self.nominal = {n: e.nominal for e in self.catalogue if e.nominal for n in e.coordinates}
        self.noise, self.weights = noise, np.ones(len(CHANNELS)) if weights is None else weights
        begin, end = flight.t[flight.ok][[0, -1]]
        n_knots = max(int(np.ceil((end - begin) / _KNOT_S)) + 1, 2)
        self.knots = np.linspace(begin, end, n_knots)
        self.hats = np.stack([np.interp(flight.t, self.knots, row) for row in np.eye(n_knots)], axis=1)
        self.t = flight.t[::STEP]
        self.ok = flight.ok[::STEP].copy()
        self.used = np.isfinite(flight.height).all()
        self.channels = np.array([name != "baro" or bool(self.used) for name in CHANNELS])

    def start(self, parameters: np.ndarray) -> FlightFit:
        """Return the fit before any iteration."""
        return FlightFit(parameters.copy(), np.zeros((len(self.knots), 2)), dict.fromkeys(self.nominal, 0.0))

    def residuals(self, fit: FlightFit, active: Sequence[ActiveEffect] = ()) -> np.ndarray:
        """Return the residuals, (N, 13)."""
        return residuals(self.flight, fit.parameters, self.hats @ fit.wind, combined(active, fit.biases, self.flight.t))

    def whitened(self, x: np.ndarray) -> np.ndarray:
        """Whiten the rows of each channel, (N, 13, ...), to (N', 13, ...); invalid rows and channels become 0."""
        filters = np.ones((len(CHANNELS), 1)) if self.noise is None else self.noise.filters
        out = np.empty_like(x)
        for c, taps in enumerate(filters):
            out[:, c] = lfilter(taps / self.weights[c], [1.0], x[:, c], axis=0)
        out[~self.valid] = 0.0
        out[:, ~self.channels] = 0.0
        return out

    @property
    def valid(self) -> np.ndarray:
        """Return the rows whose predecessors in the whitening filter are valid too, (N,) bool."""
        count = np.convolve(self.ok, np.ones(ORDER + 1, int))[: len(self.ok)]
        return np.asarray(count == ORDER + 1)

    def nuisance_columns(self, fit: FlightFit, active: Sequence[ActiveEffect], base: np.ndarray) -> np.ndarray:
        """Return the derivatives of the residuals by parameters, wind and biases, (N, 13, p)."""
        columns = []
        for k, step in enumerate(_STEPS):
            moved = replace_parameter(fit, k, step)
            columns.append((self.residuals(moved, active) - base) / step)
        for axis in range(2):
            moved = FlightFit(fit.parameters, fit.wind + 0.5 * np.eye(2)[axis], fit.biases)
            by_wind = (self.residuals(moved, active) - base) / 0.5
            columns += [by_wind * hat[:, None] for hat in self.hats[::STEP].T]
        steps = coordinate_steps(self.catalogue)
        for name in self.nominal:
            biases = fit.biases | {name: fit.biases[name] + steps[name]}
            columns.append((self.residuals(FlightFit(fit.parameters, fit.wind, biases), active) - base) / steps[name])
        return np.stack(columns, axis=2)

    def effect_columns(self, fit: FlightFit, active: Sequence[ActiveEffect], base: np.ndarray) -> dict[str, np.ndarray]:
        """Return the derivatives of the residuals by every effect coordinate throughout, (N, 13) each."""
        out, ones = {}, np.ones(len(self.flight.t))
        current = combined(active, fit.biases, self.flight.t)
        wind = self.hats @ fit.wind
        for name, step in coordinate_steps(self.catalogue).items():
            moved = dict(current) | {name: current.get(name, 0.0) + step * ones}
            out[name] = (residuals(self.flight, fit.parameters, wind, moved) - base) / step
        return out

    def prior_precision(self, spread: np.ndarray | None) -> np.ndarray:
        """Return the precision of the nuisances, (p, p); `spread`: covariance of the parameters, None: unknown."""
        n, K = len(PARAMETERS), len(self.knots)
        out = np.zeros((n + 2 * K + len(self.nominal),) * 2)
        out[:n, :n] = np.diag(_UNKNOWN_STD**-2.0) if spread is None else np.linalg.inv(spread)
        lags = np.abs(self.knots[:, None] - self.knots)
        wind = np.linalg.inv(_WIND_STD**2 + _GUST_STD**2 * np.exp(-lags / _GUST_S) + 1e-6 * np.eye(K))
        for axis in range(2):
            rows = slice(n + axis * K, n + (axis + 1) * K)
            out[rows, rows] = wind
        out[n + 2 * K :, n + 2 * K :] = np.diag([1 / s**2 for s in self.nominal.values()])
        return out

    def vector(self, fit: FlightFit, mean: np.ndarray) -> np.ndarray:
        """Return the nuisances as deviations from their prior means, (p,)."""
        return np.concatenate([fit.parameters - mean, fit.wind.T.ravel(), list(fit.biases.values())])

    def moved(self, fit: FlightFit, step: np.ndarray) -> FlightFit:
        """Return the fit after a step of the nuisances, (p,)."""
        n, K = len(PARAMETERS), len(self.knots)
        biases = {name: x + d for (name, x), d in zip(fit.biases.items(), step[n + 2 * K :].tolist(), strict=True)}
        limited = np.clip(step[:n], -_MOST_STEP, _MOST_STEP)
        parameters = np.clip(fit.parameters + limited, _LOW, _HIGH)
        return FlightFit(parameters, fit.wind + step[n : n + 2 * K].reshape(2, K).T, biases)


def replace_parameter(fit: FlightFit, k: int, step: float) -> FlightFit:
    """Return the fit with one parameter changed."""
    parameters = fit.parameters.copy()
    parameters[k] += step
    return replace(fit, parameters=parameters)


@dataclass(frozen=True)
class FlightSolution:
    """Result of the Gauss-Newton iterations.

    Attributes:
        fit: unknowns; active: effects with their values, and their covariance
        cost: penalised sum of squares, without the priors of the effects
        white: whitened residuals, (N, 13); columns: whitened derivatives by the nuisances, (N, 13, p)
        precision: prior precision of the nuisances
        base: residuals, (N, 13)
    """

    fit: FlightFit
    active: tuple[ActiveEffect, ...]
    covariance: np.ndarray
    cost: float
    white: np.ndarray
    columns: np.ndarray
    precision: np.ndarray
    base: np.ndarray


def solve(
    linear: LinearFlight,
    mean: np.ndarray,
    spread: np.ndarray | None,
    start: "FlightFit | FlightSolution",
    active: Sequence[ActiveEffect] = (),
    *,
    iterations: int = 3,
) -> FlightSolution:
    """Fit nuisances and the values of the active effects by Gauss-Newton with Huber weights.

    Args:
        linear: flight
        mean, spread: prior of the rotor parameters
        start: a fit, or a solution whose derivatives by the nuisances are used again
        active: effects with their first values
        iterations: most steps; it ends before where the cost falls by less than `_ENOUGH`
    """
    known = start if isinstance(start, FlightSolution) else None
    fit = start.fit if isinstance(start, FlightSolution) else start
    active = tuple(active)
    precision = linear.prior_precision(spread)
    p = len(precision)
    base = linear.residuals(fit, active)
    white, cost = _cost(linear, base, linear.vector(fit, mean), precision)
    columns = known.columns if known is not None else np.zeros(0)
    drop = np.inf
    for k in range(iterations + 1):
        is_last = k == iterations or (k > 1 and drop < _ENOUGH)
        if known is None and k < _DERIVATIVES:
            columns = linear.whitened(linear.nuisance_columns(fit, active, base))
        effects = effect_derivatives(linear, fit, active, base)
        A = np.concatenate([columns, effects], axis=2).reshape(-1, p + effects.shape[2])
        r = white.reshape(-1)
        weight = np.minimum(1.0, _LIMIT / np.maximum(np.abs(r), 1e-9))
        prior = np.zeros((A.shape[1],) * 2)
        prior[:p, :p] = precision
        scales = [one.one.scale for one in active for _ in one.values]
        prior[p:, p:] = np.diag([1 / s**2 for s in scales])
        values = np.concatenate([one.values for one in active]) if active else np.zeros(0)
        H = A.T @ (weight[:, None] * A) + prior
        factor = cho_factor(H + 1e-9 * np.diag(np.diag(H)))
        if is_last:
            covariance = cho_solve(factor, np.eye(len(H)))[p:, p:]
            break
        unknowns = np.concatenate([linear.vector(fit, mean), values])
        step = -cho_solve(factor, A.T @ (weight * r) + prior @ unknowns)
        for share in _SHARES:  # of the step, until the cost falls
            moved, moved_effects = linear.moved(fit, share * step[:p]), _moved_effects(active, share * step[p:])
            moved_base = linear.residuals(moved, moved_effects)
            moved_white, moved_cost = _cost(linear, moved_base, linear.vector(moved, mean), precision)
            if k == 0 or moved_cost < cost:  # the first step may leave a start with values of the linear search
                break
        drop = cost - moved_cost
        if k == 0 or drop > 0:
            fit, active, base, white, cost = moved, moved_effects, moved_base, moved_white, moved_cost
    return FlightSolution(fit, active, covariance, cost, white, columns, precision, base)


def _cost(
    linear: LinearFlight, base: np.ndarray, nuisance: np.ndarray, precision: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the whitened residuals and the penalised sum of squares."""
    white = linear.whitened(base)
    return white, huber(white) + float(nuisance @ precision @ nuisance)


def huber(white: np.ndarray) -> float:
    """Return the sum of squares, linear beyond `_LIMIT` standard deviations."""
    a = np.abs(white)
    return float(np.where(a < _LIMIT, a**2, 2 * _LIMIT * a - _LIMIT**2).sum())


def effect_derivatives(
    linear: LinearFlight, fit: FlightFit, active: Sequence[ActiveEffect], base: np.ndarray
) -> np.ndarray:
    """Return the whitened derivatives by the values of the active effects, (N, 13, m)."""
    columns = []
    for k, one in enumerate(active):
        for i in range(len(one.values)):
            moved = replace(one, values=one.values + one.one.step * np.eye(len(one.values))[i])
            others = (*active[:k], moved, *active[k + 1 :])
            columns.append((linear.residuals(fit, others) - base) / one.one.step)
    if not columns:
        return np.zeros((*base.shape, 0))
    return linear.whitened(np.stack(columns, axis=2))


def _moved_effects(active: Sequence[ActiveEffect], step: np.ndarray) -> tuple[ActiveEffect, ...]:
    out, k = [], 0
    for one in active:
        n = len(one.values)
        out.append(replace(one, values=np.maximum(one.values + step[k : k + n], one.one.low)))
        k += n
    return tuple(out)


def autoregression(r: np.ndarray) -> np.ndarray:
    """Return the prediction error filter of a series over its standard deviation, (ORDER + 1,), by Yule-Walker."""
    n = len(r)
    covariance = np.array([r[: n - lag] @ r[lag:] for lag in range(ORDER + 1)]) / n
    covariance[0] *= 1 + 1e-6
    a = solve_toeplitz(covariance[:-1], covariance[1:])
    std = np.sqrt(max(covariance[0] - a @ covariance[1:], 1e-12))
    return np.concatenate([[1.0], -a]) / std
