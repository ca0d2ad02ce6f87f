"""Estimate the weather of a flight (wind and wind shear) and the scale of the airspeed sensor."""

import numpy as np
from scipy.optimize import least_squares

from fleet.effects import catalogue
from twin_worker.diagnosis.data.card import FaultHypothesis
from twin_worker.diagnosis.data.flight import decimated
from twin_worker.diagnosis.model.baseline import wind_is_nominal
from twin_worker.diagnosis.model.equations import RHO_0
from twin_worker.diagnosis.model.residual import ModelledFlight

RAW_ROWS_PER_SAMPLE = 50.0  # residual rows per independent sample
_SHEAR = 1.0  # prior standard deviation of the wind shear [m/s per 100 m]
_SIDE = 0.5  # weight of sideslip in the wind fit [-]
_PRIOR_MEAN = np.array([0.0, 0.0, 1.0])  # no wind [m/s], true airspeed [-]
_PRIOR_WEIGHT = np.array([0.5, 0.5, 100.0])  # prior weights: inverse standard deviations


def weather_hypotheses(w: np.ndarray) -> tuple[FaultHypothesis, ...]:
    """Return weather (4,) as hypotheses: wind, (2,) [m/s], and wind shear, (2,) [m/s per 100 m]."""
    effects = catalogue()
    return (
        FaultHypothesis(effects["wind_steady"], "", tuple(w[:2].tolist())),
        FaultHypothesis(effects["wind_shear"], "", tuple(w[2:].tolist())),
    )


def airspeed_scale(modelled_flights: list[ModelledFlight]) -> float:
    """Estimate reported over indicated airspeed first: circling flight separates wind and scale.

    Without this start value, the wind estimates would absorb the scale error and bias the sideslip.
    """
    scales = []
    for modelled in modelled_flights:
        if "Va" not in modelled.flight.readings:
            return 1.0
        m, r, ok = modelled.equation_terms(()), modelled.flight.readings, modelled.ok
        reported = m.measured["airspeed"][ok] / np.sqrt(m.flow.rho[ok] / RHO_0)
        v = np.stack([decimated(r[name])[ok] for name in ("v_n", "v_e", "v_d")])

        def residuals(x: np.ndarray, v: np.ndarray = v, reported: np.ndarray = reported) -> np.ndarray:
            speed = np.linalg.norm(v - np.array([x[0], x[1], 0.0])[:, None], axis=0)
            return np.concatenate([reported - x[2] * speed, _PRIOR_WEIGHT * (x - _PRIOR_MEAN)])

        scales.append(least_squares(residuals, _PRIOR_MEAN).x[2])
    return float(np.median(scales))


def fit_wind(modelled: ModelledFlight, w: np.ndarray) -> np.ndarray:
    """Fit the weather of a flight, (4,), robustly to airspeed (needs turns) and sideslip."""
    if "Va" not in modelled.flight.readings and "beta" not in modelled.base.coef:
        return w

    def residuals(w: np.ndarray) -> np.ndarray:
        m = modelled.equation_terms(weather_hypotheses(w))
        out = []
        if "Va" in modelled.flight.readings:
            out.append(m.measured["airspeed"] / modelled.base.airspeed - m.flow.Va * np.sqrt(m.flow.rho / RHO_0))
        if "beta" in modelled.base.coef:
            out.append(_SIDE * (m.flow.beta - modelled.base.coef["beta"] @ m.regressors["beta"]) * m.flow.Va)
        return np.concatenate([x[modelled.ok] for x in out])

    for _ in range(8):
        r = residuals(w)
        J = np.stack([(residuals(w + 0.3 * e) - r) / 0.3 for e in np.eye(4)], axis=1)
        weight = 1.0 / (1.0 + r * r)
        prior_precision = np.diag([1e-6, 1e-6, *(2 * [(weight * r * r).mean() * RAW_ROWS_PER_SAMPLE / _SHEAR**2])])
        change = -np.linalg.solve((J.T * weight) @ J + prior_precision, (J.T * weight) @ r + prior_precision @ w)
        w = w + np.clip(change, -4.0, 4.0)
        if np.abs(change).max() < 0.01:
            break
    return w


def own_weather(modelled: ModelledFlight) -> tuple[FaultHypothesis, ...]:
    """Return the fitted weather as hypotheses where wind is nominal, else none."""
    return weather_hypotheses(fit_wind(modelled, np.zeros(4))) if wind_is_nominal(modelled.base) else ()
