"""Estimate the weather of a flight (wind and wind shear) and the scale of the airspeed sensor."""

import numpy as np
from scipy.optimize import least_squares

from fleet.effects import catalogue
from twin_worker.diagnosis.data.fault_hypothesis import Guess
from twin_worker.diagnosis.data.smooth import thinned
from twin_worker.diagnosis.model.baseline import is_weather
from twin_worker.diagnosis.model.residual import RHO_0, Case

CORRELATED = 50.0  # residual rows per independent sample
_SHEAR = 1.0  # prior standard deviation of the wind shear [m/s per 100 m]
_SIDE = 0.5  # weight of sideslip in the wind fit [-]
_CALM = np.array([0.0, 0.0, 1.0])  # no wind [m/s], true airspeed [-]
_STILL = np.array([0.5, 0.5, 100.0])  # prior weights: inverse standard deviations


def wind(w: np.ndarray) -> tuple[Guess, ...]:
    """Return weather (4,) as hypotheses: wind, (2,) [m/s], and wind shear, (2,) [m/s per 100 m]."""
    known = catalogue()
    return Guess(known["wind_steady"], "", tuple(w[:2].tolist())), Guess(known["wind_shear"], "", tuple(w[2:].tolist()))


def scale(cases: list[Case]) -> float:
    """Estimate reported over indicated airspeed first: circling flight separates wind and scale.

    Without this start value, the wind estimates would absorb the scale error and bias the sideslip.
    """
    found = []
    for case in cases:
        if "Va" not in case.flight.readings:
            return 1.0
        m, r, ok = case.terms(()), case.flight.readings, case.ok
        told = m.measured["airspeed"][ok] / np.sqrt(m.flow.rho[ok] / RHO_0)
        v = np.stack([thinned(r[name])[ok] for name in ("v_n", "v_e", "v_d")])

        def miss(x: np.ndarray, v: np.ndarray = v, told: np.ndarray = told) -> np.ndarray:
            speed = np.linalg.norm(v - np.array([x[0], x[1], 0.0])[:, None], axis=0)
            return np.concatenate([told - x[2] * speed, _STILL * (x - _CALM)])

        found.append(least_squares(miss, _CALM).x[2])
    return float(np.median(found))


def fit_wind(case: Case, w: np.ndarray) -> np.ndarray:
    """Fit the weather of a flight, (4,), robustly to airspeed (needs turns) and sideslip."""
    if "Va" not in case.flight.readings and "beta" not in case.base.coef:
        return w

    def miss(w: np.ndarray) -> np.ndarray:
        m = case.terms(wind(w))
        out = []
        if "Va" in case.flight.readings:
            out.append(m.measured["airspeed"] / case.base.airspeed - m.flow.Va * np.sqrt(m.flow.rho / RHO_0))
        if "beta" in case.base.coef:
            out.append(_SIDE * (m.flow.beta - case.base.coef["beta"] @ m.terms["beta"]) * m.flow.Va)
        return np.concatenate([x[case.ok] for x in out])

    for _ in range(8):
        r = miss(w)
        J = np.stack([(miss(w + 0.3 * e) - r) / 0.3 for e in np.eye(4)], axis=1)
        weight = 1.0 / (1.0 + r * r)
        pull = np.diag([1e-6, 1e-6, *(2 * [(weight * r * r).mean() * CORRELATED / _SHEAR**2])])
        change = -np.linalg.solve((J.T * weight) @ J + pull, (J.T * weight) @ r + pull @ w)
        w = w + np.clip(change, -4.0, 4.0)
        if np.abs(change).max() < 0.01:
            break
    return w


def own_weather(case: Case) -> tuple[Guess, ...]:
    """Return the fitted weather as hypotheses where wind is nominal, else none."""
    return wind(fit_wind(case, np.zeros(4))) if is_weather(case.base) else ()
