"""Derivatives of one type of aircraft, learnt from its aircraft: random effects, and aircraft that differ from them.

    theta_i ~ N(mu, T),   data of aircraft i: exp(-(theta_i' Lambda_i theta_i) / 2 + eta_i' theta_i)
    mu ~ N(mu_0, P_0),    T ~ inverse Wishart with nu_0 degrees of freedom about the usual spread of a type

theta are the derivatives at one airspeed, without offsets and wind, which depend on trim and weather, and the excess
of thrust over drag at one airspeed and throttle. Lambda_i and eta_i are the information of the data alone: what an
aircraft took from the prior counts for nothing. EM iterates the means of theta_i, mu, and T of the largest posterior.

An aircraft differs where the estimate from its data alone deviates from mu of the others by more than chance:
F = d' cov(d)^-1 d / k of a group of k terms, with the degrees of freedom of T.

Source: Dempster, Laird & Rubin 1977 (EM); Laird & Ware 1982, "Random-effects models for longitudinal data",
Biometrics 38(4); Gelman et al. 2013, sec. 5.4 and 15 (hierarchical models, inverse Wishart).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite

import numpy as np
from scipy.stats import f as f_distribution

from fleet.airframes import Airframe
from fleet.contract import Array, SiblingData, SiblingDifference, SiblingType
from fleet.frames import G
from fleet.physics.wrench import N_AERO, NAMES, OFFSETS
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel, prior

MIN_SIBLINGS = 3  # aircraft without which nothing is learnt about a type
EXCESS = "excess"
TERMS = (*(name for k, name in enumerate(NAMES[:N_AERO]) if k not in OFFSETS), EXCESS)
"""What aircraft of one type share, (30,): derivatives, and specific thrust minus drag at trim [m/s2]."""
_SHARED = np.array([NAMES.index(name) for name in TERMS[:-1]])
_REST = np.array([k for k in range(len(NAMES)) if k not in _SHARED and k != 0])  # offsets but X_0, and wind
_X_0, _X_DT = NAMES.index("X_0"), NAMES.index("X_dt")
GROUPS: Mapping[str, tuple[str, ...]] = {
    "drag": (EXCESS,),
    "lift": ("Z_w",),
    "pitch": ("M_w", "M_q", "M_de"),
    "roll": ("L_p", "L_da"),
    "yaw": ("N_v", "N_r", "N_dr"),
}
"""Terms that are compared together; the first one is named."""
SIGNIFICANCE = 1e-3  # of a difference, of each group
_SPREAD = 0.07  # usual standard deviation between aircraft of one type, of each derivative [-]
_SPREAD_DRAG = 0.05  # the same of drag, of its magnitude [-]
_SPREAD_DOF = 6.0  # nu_0: aircraft that the usual spread is worth
_FLOOR = 0.02  # least spread, of the standard deviation of the airframe's prior [-]
_EXCESS_SIGMA = 2.0  # of the airframe's prior of the excess [m/s2]
_LAPSE = 2.5  # thrust lapse, so that X_u = -(2 + lapse) D / (m U), as in `fleet.airframes`
_STEPS = 40  # of EM
_SILENT = 1e-9  # share of the siblings' covariance, which keeps that of a deviation without any data regular
_WEAK = 100.0  # factor on the siblings' covariance in the estimate of one aircraft from its data


def sibling_data(model: DerivativesModel, throttle: float, airframe_type: str) -> SiblingData | None:
    """Return what the data of one aircraft alone say about the terms; None if they are not finite.

    Args:
        model: identified
        throttle: mean delta_t of its window [-]
        airframe_type: the type of aircraft, of which it tells
    """
    nominal, nominal_precision = model.airframe_prior
    total = model.fisher_information + model.prior_precision
    data, score = total - nominal_precision, total @ model.par - nominal_precision @ nominal
    back = np.eye(len(NAMES))  # par of (par with X at trim in place of X_0)
    back[_X_0, _X_DT] = -throttle
    data, score = back.T @ data @ back, back.T @ score
    terms = np.append(_SHARED, _X_0)
    rest = data[np.ix_(_REST, _REST)] + nominal_precision[np.ix_(_REST, _REST)]
    gain = np.linalg.solve(rest, data[np.ix_(_REST, terms)]).T
    score = score[terms] - gain @ (score[_REST] + nominal_precision[np.ix_(_REST, _REST)] @ nominal[_REST])
    information = data[np.ix_(terms, terms)] - gain @ data[np.ix_(_REST, terms)]
    score = score - information[:, -1] * G * model.trim_velocity[1] / model.trim_velocity[0]  # X at trim to the excess
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    information = (vectors * np.maximum(values, 0.0)) @ vectors.T
    if not (np.isfinite(information).all() and np.isfinite(score).all()):
        return None
    return SiblingData(
        airframe_type=airframe_type,
        airspeed=float(model.trim_velocity[0]),
        throttle=throttle,
        information=Array.of(information, "<f8"),
        score=Array.of(score, "<f8"),
    )


def data_defect(data: SiblingData) -> str:
    """Return why data received from the bus must not be used; empty if they may."""
    k = len(TERMS)
    try:
        information, score = data.information.numpy(), data.score.numpy()
    except ValueError as error:
        return str(error)
    if information.shape != (k, k) or score.shape != (k,):
        return f"found shapes {information.shape} and {score.shape}, expected {k} terms"
    if not (np.isfinite(information).all() and np.isfinite(score).all()):
        return "found numbers that are not finite"
    if not (isfinite(data.airspeed) and 1.0 < data.airspeed < 200.0 and 0.0 <= data.throttle <= 1.5):
        return f"found an airspeed of {data.airspeed:.3g} m/s and a throttle of {data.throttle:.3g}"
    scale = max(float(np.abs(information).max()), 1e-12)
    if not np.allclose(information, information.T, atol=1e-6 * scale):
        return "found information that is not symmetric"
    return "" if np.linalg.eigvalsh(information).min() > -1e-6 * scale else "found information that is not positive"


@dataclass(frozen=True)
class Population:
    """Distribution of one type at an airspeed and a throttle.

    Attributes:
        mean: mu, (30,)
        covariance: of a further aircraft: T and the uncertainty of mu, (30, 30)
        dof: degrees of freedom of T
        drag: specific drag, to which the excess is compared [m/s2]
    """

    mean: np.ndarray
    covariance: np.ndarray
    dof: float
    drag: float


@dataclass(frozen=True)
class _Type:
    """One type at its reference: data of its aircraft in units of `scale`, and the airframe's prior.

    Attributes:
        airspeed, throttle: reference [m/s, -]
        scale: standard deviations of the airframe's prior, (30,)
        prior_mean: in units of scale, (30,)
        spread: usual variances between aircraft, in units of scale^2, (30,)
        drag: specific drag of the airframe [m/s2]
        information, score: of each aircraft, (n, 30, 30), (n, 30)
    """

    airspeed: float
    throttle: float
    scale: np.ndarray
    prior_mean: np.ndarray
    spread: np.ndarray
    drag: float
    information: np.ndarray
    score: np.ndarray

    @classmethod
    def of(cls, data: list[SiblingData], airframe: Airframe) -> "_Type":
        airspeed = float(np.median([one.airspeed for one in data]))
        throttle = float(np.median([one.throttle for one in data]))
        mean, sigma = prior(airframe, np.array([airspeed, 0.0]), np.zeros(4), np.zeros(2))
        drag = -mean[NAMES.index("X_u")] * airspeed / (2.0 + _LAPSE)
        scale = np.append(sigma[_SHARED], _EXCESS_SIGMA)
        mean = np.append(mean[_SHARED], 0.0)
        spread = np.append(np.maximum(_SPREAD * np.abs(mean[:-1]), _FLOOR * scale[:-1]), _SPREAD_DRAG * drag)
        information, score = zip(*(_referred(one, airspeed, throttle) for one in data), strict=True)
        return cls(
            airspeed,
            throttle,
            scale,
            mean / scale,
            (spread / scale) ** 2,
            float(drag),
            scale[:, None] * np.array(information) * scale,
            np.array(score) * scale,
        )

    def without(self, k: int) -> "_Type":
        """Return the type without one aircraft."""
        rest = np.arange(len(self.score)) != k
        parts = (self.airspeed, self.throttle, self.scale, self.prior_mean, self.spread, self.drag)
        return _Type(*parts, self.information[rest], self.score[rest])

    def population(self) -> Population:
        """Estimate mu and T."""
        n, k = self.score.shape
        mu, T = self.prior_mean.copy(), np.diag(self.spread)
        for _ in range(_STEPS):
            inverse = np.linalg.inv(T)
            V = np.linalg.inv(inverse + self.information)
            theta = np.einsum("nij,nj->ni", V, inverse @ mu + self.score)
            mu = np.linalg.solve(n * inverse + np.eye(k), inverse @ theta.sum(axis=0) + self.prior_mean)
            d = theta - mu
            T = (_SPREAD_DOF * np.diag(self.spread) + d.T @ d + V.sum(axis=0)) / (_SPREAD_DOF + n)
        inverse = np.linalg.inv(T)
        V = np.linalg.inv(inverse + self.information)
        of_mean = np.linalg.inv(n * inverse - inverse @ V.sum(axis=0) @ inverse + np.eye(k))
        covariance = (T + of_mean) * self.scale[:, None] * self.scale
        return Population(mu * self.scale, covariance, _SPREAD_DOF + n - 1.0, self.drag)

    def deviation(self, k: int, of: Population) -> tuple[np.ndarray, np.ndarray]:
        """Return by how much an aircraft's own data deviate from a population, and the covariance of that."""
        mu, S = of.mean / self.scale, of.covariance / self.scale[:, None] / self.scale
        information, weak = self.information[k], np.linalg.inv(_WEAK * S)
        V = np.linalg.inv(weak + information)
        d, W = V @ (self.score[k] - information @ mu), V @ information
        covariance = W @ S @ W.T + W @ V + _SILENT * S
        return d * self.scale, 0.5 * (covariance + covariance.T) * self.scale[:, None] * self.scale


def _referred(data: SiblingData, airspeed: float, throttle: float) -> tuple[np.ndarray, np.ndarray]:
    """Return information and score of the terms at another airspeed [m/s] and throttle [-]."""
    back = np.diag([_power(name, data.airspeed / airspeed) for name in TERMS])
    u, t = TERMS.index("X_u"), TERMS.index("X_dt")
    back[-1, u] = -(airspeed - data.airspeed)
    back[-1, t] = -(throttle - data.throttle)
    information, score = data.information.numpy().astype(float), data.score.numpy().astype(float)
    return back.T @ information @ back, back.T @ score


def _power(name: str, ratio: float) -> float:
    """Return the factor of a derivative at `ratio` times the airspeed: forces grow with its square."""
    per = name[2:]
    if per in ("de", "da", "dr"):
        return ratio * ratio
    return ratio if per in ("u", "v", "w", "p", "q", "r") else 1.0


def estimate_type(data: Mapping[int, SiblingData], airframe: Airframe) -> SiblingType | None:
    """Return the distribution of a type and the aircraft that differ; None with fewer than `MIN_SIBLINGS`.

    Args:
        data: of the aircraft of one type, by id
        airframe: prior of the type
    """
    if len(data) < MIN_SIBLINGS:
        return None
    uavs = tuple(sorted(data))
    one = _Type.of([data[uav] for uav in uavs], airframe)
    population = one.population()
    differences = [difference for k, uav in enumerate(uavs) for difference in _differences(one, k, uav)]
    return SiblingType(
        airframe_type=data[uavs[0]].airframe_type,
        uavs=uavs,
        airspeed=one.airspeed,
        throttle=one.throttle,
        mean=Array.of(population.mean, "<f8"),
        covariance=Array.of(population.covariance, "<f8"),
        differences=tuple(differences),
    )


def _differences(one: _Type, k: int, uav: int) -> list[SiblingDifference]:
    """Return in what an aircraft differs from all others of its type."""
    others = one.without(k)
    population = others.population()
    d, covariance = one.deviation(k, population)
    differences = []
    for group, names in GROUPS.items():
        rows = [TERMS.index(name) for name in names]
        dg, cov = d[rows], covariance[np.ix_(rows, rows)]
        p = float(f_distribution.sf(dg @ np.linalg.solve(cov, dg) / len(rows), len(rows), population.dof))
        if p >= SIGNIFICANCE:
            continue
        ratio = -d[-1] / population.drag if group == "drag" else d[rows[0]] / population.mean[rows[0]]
        text = f"{group} {abs(ratio):.0%} {'above' if ratio > 0 else 'below'} its {len(others.score)} siblings"
        differences.append(
            SiblingDifference(uav=uav, group=group, ratio=float(ratio), p=p, sentence=f"uav-{uav}: {text}")
        )
    return differences


def type_defect(message: SiblingType) -> str:
    """Return why a type received from the bus must not be used; empty if it may."""
    k = len(TERMS)
    try:
        mean, covariance = message.mean.numpy(), message.covariance.numpy()
    except ValueError as error:
        return str(error)
    if mean.shape != (k,) or covariance.shape != (k, k) or len(message.uavs) < MIN_SIBLINGS:
        return f"found shapes {mean.shape} and {covariance.shape} of {len(message.uavs)} aircraft, expected {k} terms"
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all() and 1.0 < message.airspeed < 200.0):
        return "found numbers that are not finite"
    correlation = covariance / np.sqrt(np.outer(np.abs(np.diag(covariance)), np.abs(np.diag(covariance))) + 1e-300)
    symmetric = np.allclose(correlation, correlation.T, atol=1e-6)
    if not symmetric or np.linalg.eigvalsh(correlation).min() < 1e-9 or np.diag(covariance).min() <= 0.0:
        return "found a covariance that is not symmetric and positive definite"
    return ""


def prior_of_type(message: SiblingType, airspeed: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return indices, mean and covariance of the derivatives of a further aircraft at an airspeed [m/s], (29,)."""
    factor = np.array([_power(name, airspeed / message.airspeed) for name in TERMS[:-1]])
    mean, covariance = message.mean.numpy()[:-1], message.covariance.numpy()[:-1, :-1]
    return _SHARED, mean * factor, covariance * factor[:, None] * factor
