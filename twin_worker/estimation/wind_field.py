"""One wind field from the wind estimates of all aircraft, and the wind along a path in it: kriging in space and time.

    w(p, t) = g(h) beta + f(p, t),      g(h) = [(h / h_0)^(1/7), (h - h_0) / h_0],      beta ~ N(0, diag(15^2, 0.5^2))
    cov f = s_f^2 exp(-|p - p' - U (t - t')| / L) exp(-|t - t'| / T)
    cov a = s_a^2 exp(-|t - t'| / T_a),  cov gust = s_g^2 exp(-|t - t'| / T_g) of one aircraft,  0 between two
    estimate of an aircraft = w(p, t) + a(t) + gust(t) + noise of its filter's variance

Both horizontal components have these covariances. f drifts with the mean wind U; vertical distances count twice. a is
what an aircraft does not share with the others: wind of its own, and slow errors of its filter. The joint posterior of
beta, f at some nodes, and each a contains every estimate once; it replaces an aircraft's own estimate where it is surer
and is never multiplied with it. s_f, s_a, s_g and L are posterior means over hypotheses, weighted by their likelihood.

Source: Cressie 1993, sec. 3.4 (universal kriging with covariance of the errors); Rasmussen and Williams 2006, eq. 2.42
(trend with a prior), sec. 8.3.1 (posterior at nodes); Taylor 1938 (advection).
"""

from dataclasses import dataclass, field
from functools import lru_cache
from itertools import product
from math import hypot, inf, isfinite

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from fleet.contract import Array, WindEstimate, WindField
from fleet.frames import Origin, to_ned
from twin_worker.estimation.wind_filter import DRIFT_S, GUST_S, WindFilter

MIN_AIRCRAFT = 3  # a field of fewer aircraft tells nothing that they do not know themselves
MAX_AGE_S = 60.0  # an older field is not used [s]
PERSISTENCE_S = 300.0  # T: lifetime of structures that drift with the wind [s]
_PERIOD_S = 5.0  # shortest time between two estimates of one aircraft that are used [s]
_WINDOW_S = 240.0  # estimates used [s]
_MAX_ESTIMATES = 600  # of all aircraft; more are thinned, since the work grows with the third power
_MAX_NODES = 100
_NODE_GAIN = 0.05  # share of the variance of f that another node must add
_HYPOTHESES = tuple(
    product((0.05, 0.25, 0.5, 1.0, 2.0), (0.1, 0.25, 0.5, 1.0, 2.0), (0.1, 0.4, 0.7, 1.2), (150.0, 300.0, 600.0))
)
"""s_f, s_a, s_g [m/s] and L [m]."""
_EVIDENCE_ROWS = 150  # estimates in their likelihood
_EVIDENCE_PERIOD_S = 30.0  # between its evaluations [s]
_REFERENCE_M, _MIN_HEIGHT_M, _MAX_HEIGHT_M = 100.0, 5.0, 1_000.0  # h_0, bounds of h [m]
_PROFILE_SIGMA = np.array([15.0, 0.5])
_VERTICAL = 2.0  # weight of vertical distances: eddies are flat
_MAX_CLOCK_OFFSET_S = 30.0  # from the median: aircraft of another recording [s]
_MAX_WIND, _MAX_SIGMA, _MAX_ALTITUDE_M = 150.0, 20.0, 20_000.0  # of plausible estimates [m/s, m/s, m]


def estimate_defect(estimate: WindEstimate) -> str:
    """Return why an estimate is not plausible; empty if it is."""
    values = (estimate.t, *estimate.wind, estimate.sigma, estimate.height_m)
    if not all(map(isfinite, values)):
        return f"found {values}, expected finite numbers"
    lat_e7, lon_e7, alt_mm = estimate.position
    if abs(lat_e7) > 900_000_000 or abs(lon_e7) > 1_800_000_000 or abs(alt_mm) > _MAX_ALTITUDE_M * 1e3:
        return f"found the position {estimate.position}, expected one on Earth below {_MAX_ALTITUDE_M:.0f} m"
    if not (hypot(*estimate.wind) < _MAX_WIND and 0.0 < estimate.sigma < _MAX_SIGMA):
        return f"found a wind of {hypot(*estimate.wind):.3g} ± {estimate.sigma:.3g} m/s, expected below {_MAX_WIND:.0f}"
    return "" if abs(estimate.height_m) < _MAX_ALTITUDE_M else f"found a height of {estimate.height_m:.3g} m"


def field_defect(message: WindField) -> str:
    """Return why a field received from the bus must not be used; empty if it may."""
    try:
        profile, nodes, values, cov, drifts = (
            rows.numpy().astype(float)
            for rows in (message.profile, message.nodes, message.values, message.covariance, message.drifts)
        )
    except ValueError as error:
        return str(error)
    b, n = len(nodes), len(message.uavs)
    expected = ((2, 2), (b, 3), (b, 2), (b + 2, b + 2), (n, 3))
    shapes = tuple(rows.shape for rows in (profile, nodes, values, cov, drifts))
    if shapes != expected or not 1 <= b <= _MAX_NODES or n < MIN_AIRCRAFT:
        return f"found shapes {shapes}, expected {expected} of 1 to {_MAX_NODES} nodes and {MIN_AIRCRAFT} aircraft"
    numbers = (message.sigma, message.length_m, message.persistence_s, message.drift_sigma, message.drift_s)
    finite = all(np.isfinite(rows).all() for rows in (profile, nodes, values, cov, drifts))
    if not finite or not all(map(isfinite, (message.t, *message.wind, *numbers))):
        return "found numbers that are not finite"
    if min(numbers) <= 0.0 or max(message.sigma, message.drift_sigma) > _MAX_SIGMA or (drifts[:, 2] < 0.0).any():
        return f"found kernel parameters {numbers}, expected positive ones"
    winds = (profile[0], values, np.array(message.wind), drifts[:, :2])
    if max(np.abs(rows).max() for rows in winds) > _MAX_WIND or np.abs(profile[1]).max() > _MAX_SIGMA:
        return f"found winds above {_MAX_WIND:.0f} m/s"
    if not np.allclose(cov, cov.T, atol=1e-4) or np.linalg.eigvalsh(cov).min() < -1e-3 * max(cov.trace(), 1e-6):
        return "found a covariance that is not symmetric and positive semidefinite"
    return ""


def profile_basis(height: np.ndarray) -> np.ndarray:
    """Return g at heights above ground, (n,) [m], as (n, 2)."""
    h = np.clip(height, _MIN_HEIGHT_M, _MAX_HEIGHT_M)
    return np.column_stack([(h / _REFERENCE_M) ** (1 / 7), (h - _REFERENCE_M) / _REFERENCE_M])


def _distance(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the distances of positions, (n, 3) and (m, 3), vertical ones weighted, (n, m) [m]."""
    square = (p[:, :1] - q[:, 0]) ** 2 + (p[:, 1:2] - q[:, 1]) ** 2 + (_VERTICAL * (p[:, 2:] - q[:, 2])) ** 2
    return np.asarray(np.sqrt(square))


@dataclass
class WindFieldEstimator:
    """Estimate the field from the estimates of all aircraft, whichever worker publishes them.

    Attributes:
        estimates: of the last minutes by aircraft, oldest first
    """

    estimates: dict[int, list[WindEstimate]] = field(default_factory=dict)
    _kernel: tuple[float, float, float, float] = (0.5, 0.25, 0.5, 300.0)  # s_f, s_a, s_g, L
    _kernel_t: float = -inf

    def add(self, uav: int, estimate: WindEstimate) -> None:
        """Add an estimate; one that is not `_PERIOD_S` newer than the last of its aircraft is ignored.

        Raises:
            ValueError: when it is not plausible; its worker must correct it.
        """
        if defect := estimate_defect(estimate):
            raise ValueError(f"uav-{uav}, wind estimate: {defect}; it is ignored")
        rows = self.estimates.setdefault(uav, [])
        if rows and estimate.t < rows[-1].t - _MAX_CLOCK_OFFSET_S:
            rows.clear()  # the clock was set back
        if not rows or estimate.t - rows[-1].t >= _PERIOD_S - 0.5:
            rows.append(estimate)
        while rows[-1].t - rows[0].t > _WINDOW_S:
            del rows[0]

    def estimate(self) -> WindField | None:
        """Return the field at the time of the newest estimates; None with fewer than `MIN_AIRCRAFT` aircraft."""
        now = float(np.median([rows[-1].t for rows in self.estimates.values()])) if self.estimates else 0.0
        self.estimates = {uav: rows for uav, rows in self.estimates.items() if abs(rows[-1].t - now) < _WINDOW_S}
        usable = {u: rows for u, rows in self.estimates.items() if abs(rows[-1].t - now) < _MAX_CLOCK_OFFSET_S}
        if len(usable) < MIN_AIRCRAFT:
            return None
        step = max(1, -(-sum(map(len, usable.values())) // _MAX_ESTIMATES))
        used = {uav: rows[::-step][::-1] for uav, rows in sorted(usable.items())}
        return self._krige(used, max(rows[-1].t for rows in used.values()))

    def _krige(self, used: dict[int, list[WindEstimate]], t: float) -> WindField:
        index = np.repeat(np.arange(len(used)), [len(rows) for rows in used.values()])
        data = _Estimates.of(index, [one for rows in used.values() for one in rows], t)
        if not 0.0 <= t - self._kernel_t < _EVIDENCE_PERIOD_S:
            self._kernel, self._kernel_t = _likely_kernel(data), t
        s_f, s_a, _, length = self._kernel
        factor = cho_factor(_covariance(data, *self._kernel), lower=True, check_finite=False)
        nodes = _choose_nodes(data, length)
        shared = s_f**2 * np.exp(-_distance(nodes, data.moved) / length - data.age / PERSISTENCE_S)
        prior = np.zeros((2 + len(nodes),) * 2)
        prior[:2, :2] = np.diag(_PROFILE_SIGMA**2)
        prior[2:, 2:] = s_f**2 * np.exp(-_distance(nodes, nodes) / length)
        cross = np.vstack([(data.basis * _PROFILE_SIGMA**2).T, shared])
        theta = cross @ cho_solve(factor, data.wind, check_finite=False)
        cov = prior - cross @ cho_solve(factor, cross.T, check_finite=False)
        own = s_a**2 * np.exp(-data.age / DRIFT_S) * (data.aircraft == np.arange(len(used))[:, None])
        drift = own @ cho_solve(factor, data.wind, check_finite=False)
        drift_variance = s_a**2 - np.einsum("ij,ji->i", own, cho_solve(factor, own.T, check_finite=False))
        speed, spread = theta[0], float(np.sqrt(max(cov[0, 0], 0.0)))
        return WindField(
            t=t,
            origin=data.origin,
            uavs=tuple(used),
            wind=(float(speed[0]), float(speed[1])),
            wind_sigma=spread,
            sigma=s_f,
            length_m=length,
            persistence_s=PERSISTENCE_S,
            drift_sigma=s_a,
            drift_s=DRIFT_S,
            profile=Array.of(theta[:2]),
            nodes=Array.of(nodes),
            values=Array.of(theta[2:]),
            covariance=Array.of(0.5 * (cov + cov.T)),
            drifts=Array.of(np.column_stack([drift, np.maximum(drift_variance, 0.0)])),
        )


@dataclass(frozen=True)
class _Estimates:
    """Estimates of all aircraft as arrays.

    Attributes:
        origin: horizontal position of the first, altitude of the ground
        aircraft: index of the aircraft, (n,)
        age: time since them, (n,) [s]
        moved: positions moved with the mean wind to the present, NED from `origin`, (n, 3) [m]
        basis: g, (n, 2)
        wind: north and east, (n, 2) [m/s]
        variance: of their filters, (n,) [m2/s2]
    """

    origin: tuple[int, int, int]
    aircraft: np.ndarray
    age: np.ndarray
    moved: np.ndarray
    basis: np.ndarray
    wind: np.ndarray
    variance: np.ndarray

    @classmethod
    def of(cls, aircraft: np.ndarray, rows: list[WindEstimate], t: float) -> "_Estimates":
        position = np.array([one.position for one in rows], float)
        ground = float(np.median(position[:, 2] - 1e3 * np.array([one.height_m for one in rows])))
        origin = int(position[0, 0]), int(position[0, 1]), round(ground)
        p = to_ned(Origin(*origin), *position.T)
        wind, age = np.array([one.wind for one in rows]), t - np.array([one.t for one in rows])
        variance, basis = np.array([one.sigma for one in rows]) ** 2, profile_basis(-p[:, 2])
        mean = (wind / variance[:, None]).sum(axis=0) / (basis[:, 0] / variance).sum()
        return cls(origin, aircraft, age, p + age[:, None] * np.array([*mean, 0.0]), basis, wind, variance)

    def thinned(self, n: int) -> "_Estimates":
        """Return about n of them, evenly spread."""
        k = slice(None, None, max(1, -(-len(self.age) // n)))
        columns = (self.aircraft, self.age, self.moved, self.basis, self.wind, self.variance)
        return _Estimates(self.origin, *(column[k] for column in columns))


def _covariance(data: _Estimates, s_f: float, s_a: float, s_g: float, length: float) -> np.ndarray:
    """Return the covariance of the estimates of one component, (n, n) [m2/s2]."""
    lag, same = np.abs(data.age[:, None] - data.age), data.aircraft[:, None] == data.aircraft
    out = s_f**2 * np.exp(-_distance(data.moved, data.moved) / length - lag / PERSISTENCE_S)
    out += (s_a**2 * np.exp(-lag / DRIFT_S) + s_g**2 * np.exp(-lag / GUST_S)) * same
    out += (data.basis * _PROFILE_SIGMA**2) @ data.basis.T
    out[np.diag_indices_from(out)] += data.variance
    return np.asarray(out)


def _likely_kernel(data: _Estimates) -> tuple[float, float, float, float]:
    """Return the posterior root mean squares of s_f, s_a and s_g and mean of L over the hypotheses."""
    few, log_likelihood = data.thinned(_EVIDENCE_ROWS), np.empty(len(_HYPOTHESES))
    for k, hypothesis in enumerate(_HYPOTHESES):
        L = np.linalg.cholesky(_covariance(few, *hypothesis))
        white = np.linalg.solve(L, few.wind)
        log_likelihood[k] = -0.5 * (white**2).sum() - 2.0 * np.log(np.diag(L)).sum()
    weight = np.exp(log_likelihood - log_likelihood.max())
    *deviations, length = np.array(_HYPOTHESES).T
    s_f, s_a, s_g = np.sqrt(np.square(deviations) @ weight / weight.sum()).tolist()
    return s_f, s_a, s_g, float(length @ weight / weight.sum())


def _choose_nodes(data: _Estimates, length: float) -> np.ndarray:
    """Return the moved positions that explain most of f at all of them, (b, 3): pivoted Cholesky factorisation.

    Source: Harbrecht, Peters and Schneider 2012, algorithm 1.
    """
    rest, rows = np.ones(len(data.moved)), np.empty((0, len(data.moved)))
    chosen: list[int] = []
    while len(chosen) < _MAX_NODES and rest.max() > _NODE_GAIN:
        k = int(rest.argmax())
        correlation = np.exp(-_distance(data.moved[[k]], data.moved)[0] / length)
        row = (correlation - rows[:, k] @ rows) / np.sqrt(rest[k])
        rows, rest = np.vstack([rows, row]), np.maximum(rest - row**2, 0.0)
        rest[k] = 0.0
        chosen.append(k)
    return np.asarray(data.moved[chosen])


@dataclass(frozen=True)
class PathWind:
    """Wind without gusts along a path.

    Attributes:
        t: look-ahead, (k,) [s]
        mean: north and east, (k, 2) [m/s]
        cov: of each component between the look-aheads, (k, k) [m2/s2]
    """

    t: np.ndarray
    mean: np.ndarray
    cov: np.ndarray

    @property
    def path_sigma(self) -> float:
        """Return the standard deviation of the mean over the path: of the displacement, by time [m/s]."""
        return float(np.sqrt(max(self.cov.mean(), 0.0)))


class SharedWind:
    """A valid field, ready to be evaluated."""

    def __init__(self, message: WindField) -> None:
        """Read the message.

        Raises:
            ValueError: when it must not be used; its worker must correct it.
        """
        if defect := field_defect(message):
            raise ValueError(f"wind field: {defect}; it is ignored")
        self.message = message
        self._nodes = message.nodes.numpy().astype(float)
        self._theta = np.vstack([message.profile.numpy(), message.values.numpy()]).astype(float)
        self._cov = message.covariance.numpy().astype(float)
        correlation = np.exp(-_distance(self._nodes, self._nodes) / message.length_m)
        self._inverse = np.linalg.inv(correlation + 1e-6 * np.eye(len(correlation)))

    def along(self, uav: int, t_0: float, ahead: np.ndarray, path: np.ndarray, origin: Origin) -> PathWind | None:
        """Return the wind along the path of one aircraft; None when the field is not of about this time.

        Args:
            uav: its id: its own drift is part of the field
            t_0: start of the path [s since 1970]
            ahead: look-ahead of its points, rising, (k,) [s]
            path: NED from `origin`, (k, 3) [m]
            origin: of the path
        """
        m = self.message
        if not -_PERIOD_S < t_0 - m.t < MAX_AGE_S:
            return None
        offset = to_ned(Origin(*m.origin), *(np.array([x], float) for x in origin))[0]
        age, p = t_0 + ahead - m.t, path + offset
        moved = p - age[:, None] * np.array([*m.wind, 0.0])
        persistent = np.exp(-np.abs(age) / m.persistence_s)
        near = persistent[:, None] * np.exp(-_distance(moved, self._nodes) / m.length_m)
        weight = near @ self._inverse
        H, lag = np.hstack([profile_basis(-p[:, 2]), weight]), np.abs(ahead[:, None] - ahead)
        prior = np.exp(-_distance(moved, moved) / m.length_m - lag / m.persistence_s)
        cov = H @ self._cov @ H.T + m.sigma**2 * (prior - weight @ near.T)
        mean, own, variance = H @ self._theta, np.exp(-np.abs(age) / m.drift_s), m.drift_sigma**2
        remaining = np.outer(own, own)
        if uav in m.uavs:
            *drift, drift_variance = m.drifts.numpy()[m.uavs.index(uav)].tolist()
            mean = mean + own[:, None] * np.array(drift)
            cov = cov + remaining * drift_variance
        else:
            cov = cov + remaining * variance
        return PathWind(ahead, mean, cov + variance * (np.exp(-lag / m.drift_s) - remaining))


@lru_cache(maxsize=8)
def shared_wind(message: WindField) -> SharedWind:
    """Return the field of a valid message; the same object for the same message."""
    return SharedWind(message)


def own_wind(wind_filter: WindFilter, ahead: np.ndarray) -> PathWind:
    """Return the wind of an aircraft's own filter at look-aheads, (k,) [s], without its profile over height."""
    x, P = wind_filter.state
    decay, lag = np.exp(-ahead / DRIFT_S), np.abs(ahead[:, None] - ahead)
    mean = x[2:4] + decay[:, None] * x[4:6]
    m, d, c = ((P[i, j] + P[i + 1, j + 1]) / 2 for i, j in ((2, 2), (4, 4), (2, 4)))
    remaining = np.outer(decay, decay)
    cov = m + c * (decay[:, None] + decay) + d * remaining
    return PathWind(ahead, mean, cov + wind_filter.drift_sigma**2 * (np.exp(-lag / DRIFT_S) - remaining))
