"""Fit the coefficients of the baseline to nominal flights, jointly with the wind of each flight."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from twin_worker.diagnosis.data.card import AircraftCard
from twin_worker.diagnosis.data.flight import FlightData
from twin_worker.diagnosis.model import equations as eq
from twin_worker.diagnosis.model.baseline import ActuatorTiming, Baseline
from twin_worker.diagnosis.model.residual import EquationTerms, ModelledFlight
from twin_worker.diagnosis.model.weather import RAW_ROWS_PER_SAMPLE, airspeed_scale, fit_wind, weather_hypotheses
from twin_worker.numerics.ridge_regression import solve_ridge

RIDGE = 3e-4  # ridge weight, as a share of the regressor norm
_ORDER = 3  # order of the residual autoregression
_WHITENINGS = {True: 2, False: 1}  # rounds with and without fast accelerometer, where terms are noisier
_ROUNDS = 2
_ROWS_PER_SAMPLE = 4.0  # whitened rows per independent sample: whitening is incomplete
_SERVO_LAGS = (0.0, 0.03, 0.06, 0.1, 0.14, 0.18, 0.22, 0.28, 0.35)  # [s]
_DELAYS = (0.0, 0.02, 0.04, 0.06)  # [s]
_ENGINE_LAGS = {  # by fast accelerometer; electric motors respond in 0.1 s, piston engines in seconds [s]
    True: (0.1, 0.14, 0.19, 0.27, 0.37, 0.51, 0.71, 0.98, 1.36, 1.88, 2.6, 3.61, 5.0),
    False: (0.1, 0.25, 0.5),
}


def fit(
    flights: Sequence[FlightData], card: AircraftCard, timing: ActuatorTiming, vane: bool, ridge_share: float = RIDGE
) -> tuple[Baseline, list[np.ndarray]]:
    """Fit every equation and the weather of each flight, (4,); short data need a larger `ridge_share`.

    Raises:
        ValueError: if the flights do not excite an equation at all.
    """
    speed = float(np.median(np.concatenate([np.hypot(f.readings["v_n"], f.readings["v_e"])[f.ok] for f in flights])))
    base = Baseline(card, {}, speed, timing=timing, vane=vane, flights=tuple(f.name for f in flights))
    winds = [np.zeros(4) for _ in flights]
    base = replace(base, airspeed=airspeed_scale([ModelledFlight(flight, base) for flight in flights]))
    modelled_flights = [ModelledFlight(flight, base) for flight in flights]
    for _ in range(_ROUNDS):
        winds = [fit_wind(modelled, w) for modelled, w in zip(modelled_flights, winds, strict=True)]
        all_terms = terms_in_wind(modelled_flights, winds)
        airspeed = _refit_airspeed_scale(all_terms)
        alpha = _solve(RegressionData(all_terms, "alpha", ridge_share), 0)[0]
        beta = _fit_sideslip(RegressionData(all_terms, "beta", ridge_share), all_terms, vane)
        base = replace(base, airspeed=airspeed, coef={"alpha": alpha, "beta": beta})
        modelled_flights = _with_baseline(modelled_flights, base)
        base = _fit_forces_and_moments(terms_in_wind(modelled_flights, winds), base, ridge_share)
        modelled_flights = _with_baseline(modelled_flights, base)
    return base, winds


def terms_in_wind(modelled_flights: Sequence[ModelledFlight], winds: Sequence[np.ndarray]) -> list[EquationTerms]:
    """Compute the equation terms of each flight in its own weather, (4,)."""
    pairs = zip(modelled_flights, winds, strict=True)
    return [modelled.equation_terms(weather_hypotheses(w)) for modelled, w in pairs]


def _with_baseline(modelled_flights: list[ModelledFlight], base: Baseline) -> list[ModelledFlight]:
    return [ModelledFlight(modelled.flight, base, template=modelled) for modelled in modelled_flights]


def _fit_forces_and_moments(all_terms: list[EquationTerms], base: Baseline, ridge_share: float) -> Baseline:
    """Fit forces and moments for known flow angles."""
    coef, r2 = dict(base.coef), {}
    coef_x_t, r2["X"] = _solve(axial_regression(all_terms, ridge_share), 0)
    coef["X"], coef["T"] = coef_x_t[: len(eq.X)], coef_x_t[len(eq.X) :]
    coef["M"], r2["M"] = _solve(pitch_regression(all_terms, coef, ridge_share))
    for name in ("L", "N"):
        coef[name], r2[name] = _solve(RegressionData(all_terms, name, ridge_share))
    for name in ("alpha", "beta"):
        data = RegressionData(all_terms, name)
        r2[name] = _r2(data.A[data.ok] @ coef[name], data.y[data.ok])
    return replace(base, coef=coef, r2=r2)


def _fit_sideslip(data: "RegressionData", all_terms: list[EquationTerms], vane: bool) -> np.ndarray:
    """Fit the sideslip equation; with a fast accelerometer, regress side force on sideslip and invert.

    Sideslip over the ground lacks the gusts in the side force: a regression on the force would be biased to zero.
    A side force derived from the velocity is itself noisy: there sideslip is regressed on the force.
    """
    if not vane:
        return _solve(data, 0)[0]
    force = data.A[:, 1].copy()
    data.A[:, 1] = np.concatenate([m.measured["beta"] for m in all_terms])
    data.y = force
    c = _solve(data)[0]
    return np.array([-c[0], 1.0, *(-c[2:])]) / c[1]


class RegressionData:
    """Regression data of one equation over all flights: dimensional regressors (n, k), measured side (n,), masks."""

    def __init__(
        self,
        all_terms: list[EquationTerms],
        name: str,
        ridge_share: float = RIDGE,
        extra_terms: Callable[[EquationTerms], np.ndarray] | None = None,
    ) -> None:
        self.ridge_share = ridge_share
        A, y, ok, lagged_ok = [], [], [], []
        for m in all_terms:
            regressors = m.regressors[name] * m.scale.get(name, 1.0)
            A.append((regressors if extra_terms is None else np.concatenate([regressors, extra_terms(m)])).T)
            y.append(m.measured[name])
            ok.append(m.modelled.ok)
            good = m.modelled.ok.copy()
            for k in range(1, _ORDER + 1):
                good[k:] &= m.modelled.ok[:-k]
            good[:_ORDER] = False
            lagged_ok.append(good)
        self.A, self.y = np.concatenate(A), np.concatenate(y)
        base = all_terms[0].modelled.base
        self.vane = base.vane
        unlimited = [np.inf] * self.A.shape[1]
        self.prior_std = np.array(
            eq.COEF_PRIOR_STD.get(name, unlimited) if base.card.known and base.vane else unlimited
        )
        self.ok, self.lagged_ok = np.concatenate(ok), np.concatenate(lagged_ok)

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Return measured less simulated on valid rows, (m,)."""
        return (self.y - self.A @ x)[self.ok]

    def whitener(self, x: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """Return the autoregressive filter that whitens the residuals of these coefficients."""
        e = self.y - self.A @ x
        lags = np.stack([np.roll(e, k) for k in range(1, _ORDER + 1)], axis=1)
        ar = np.linalg.lstsq(lags[self.lagged_ok], e[self.lagged_ok], rcond=None)[0]
        return lambda z: z - sum(a * np.roll(z, k + 1, axis=0) for k, a in enumerate(ar))


def _solve(data: RegressionData, whitenings: int | None = None) -> tuple[np.ndarray, float]:
    """Solve by generalised least squares; return coefficients and the share of variance explained.

    Residuals in gusts under feedback control are coloured, and ordinary least squares biases the derivatives to zero.
    The autoregression of the residuals therefore filters both sides.
    Source: Clarke 1967 (generalised least squares); Klein & Morelli 2006, section 5.2.
    """
    x = _regularised_fit(data.A[data.ok], data.y[data.ok], data, RAW_ROWS_PER_SAMPLE)
    r2 = _r2(data.A[data.ok] @ x, data.y[data.ok])
    for _ in range(_WHITENINGS[data.vane] if whitenings is None else whitenings):
        whiten = data.whitener(x)
        x = _regularised_fit(whiten(data.A)[data.lagged_ok], whiten(data.y)[data.lagged_ok], data, _ROWS_PER_SAMPLE)
    return x, r2


def _log_innovation_variance(data: RegressionData) -> float:
    """Return the logarithm of the innovations' variance after the fit."""
    x, _ = _solve(data, 1)
    return float(np.log(np.var(data.whitener(x)(data.y - data.A @ x)[data.lagged_ok])))


def _r2(fitted: np.ndarray, y: np.ndarray) -> float:
    return float(1.0 - ((y - fitted) ** 2).sum() / max(((y - y.mean()) ** 2).sum(), 1e-12))


def _regularised_fit(A: np.ndarray, y: np.ndarray, data: RegressionData, rows_per_sample: float) -> np.ndarray:
    """Solve by least squares with a ridge and the prior `data.prior_std` of the coefficients.

    `rows_per_sample` residual rows count as one independent sample.
    """
    x = solve_ridge(A, y, data.ridge_share)
    noise = np.sqrt(rows_per_sample * np.mean((y - A @ x) ** 2))
    length = np.linalg.norm(A, axis=0) + 1e-12
    return solve_ridge(A, y, np.maximum(data.ridge_share, noise / (data.prior_std * length)))


def drag_uncertainty(all_terms: list[EquationTerms]) -> dict[str, np.ndarray]:
    """Return the joint uncertainty of the drag coefficients that flight data do not separate: one standard deviation.

    The elevator coefficient, limited by its prior, changes by its standard deviation; correlated coefficients follow.
    """
    coef = all_terms[0].modelled.base.coef
    data = axial_regression(all_terms)
    A, k = data.A[data.ok], eq.X.index("delta_e")
    noise = RAW_ROWS_PER_SAMPLE * np.mean(data.residuals(stacked_coef(coef, "X")) ** 2)
    ridge_weight = data.ridge_share * np.linalg.norm(A, axis=0)
    covariance = np.linalg.inv((A.T @ A + np.diag(ridge_weight**2)) / noise + np.diag(data.prior_std**-2.0))
    return coef_change(coef, "X", covariance[:, k] / np.sqrt(covariance[k, k]))


def stacked_coef(coef: dict[str, np.ndarray], name: str) -> np.ndarray:
    """Return the coefficients of a separately fitted equation; `X` includes those of thrust."""
    return np.concatenate([coef["X"], coef["T"]]) if name == "X" else coef[name]


def coef_change(coef: dict[str, np.ndarray], name: str, change: np.ndarray) -> dict[str, np.ndarray]:
    """Return a change of one equation's `stacked_coef` as a change of all coefficients."""
    out = {equation: np.zeros_like(x) for equation, x in coef.items()}
    return out | ({"X": change[: len(eq.X)], "T": change[len(eq.X) :]} if name == "X" else {name: change})


def _refit_airspeed_scale(all_terms: list[EquationTerms]) -> float:
    """Fit the ratio of reported to indicated airspeed."""
    if any("Va" not in m.modelled.flight.readings for m in all_terms):
        return 1.0
    pairs = [np.stack([m.flow.Va * np.sqrt(m.flow.rho / eq.RHO_0), m.measured["airspeed"]]) for m in all_terms]
    x, y = np.concatenate([pair[:, m.modelled.ok] for pair, m in zip(pairs, all_terms, strict=True)], axis=1)
    return float((x @ y) / (x @ x))


def fit_timing(flights: Sequence[FlightData], card: AircraftCard, vane: bool) -> ActuatorTiming:
    """Fit the lags and the delay with the least innovation variance, lag and delay of the servos jointly.

    Pitch and yaw determine the servos: in roll, damping and lag are not separable within the band. Axial force
    determines the engine.
    """
    best = ActuatorTiming()
    base, winds = fit(flights, card, best, vane)
    modelled_flights = [ModelledFlight(flight, base) for flight in flights]

    def terms_with(timing: ActuatorTiming) -> list[EquationTerms]:
        return terms_in_wind(_with_baseline(modelled_flights, replace(base, timing=timing)), winds)

    def servo_variance(timing: ActuatorTiming) -> float:
        """Return the log innovation variance of pitch and yaw."""
        all_terms = terms_with(timing)
        pitch = pitch_regression(all_terms, {"T": _solve(axial_regression(all_terms), 0)[0][len(eq.X) :]})
        return _log_innovation_variance(pitch) + _log_innovation_variance(RegressionData(all_terms, "N"))

    def engine_variance(timing: ActuatorTiming) -> float:
        """Return the log innovation variance of axial force."""
        return _log_innovation_variance(axial_regression(terms_with(timing)))

    # lag and delay are strongly correlated: a search in turn would miss the best pair
    pairs = [replace(best, servo=servo, delay=delay) for servo in _SERVO_LAGS for delay in _DELAYS]
    best = min(pairs, key=servo_variance)
    return min([replace(best, engine=engine) for engine in _ENGINE_LAGS[vane]], key=engine_variance)


def pitch_regression(
    all_terms: list[EquationTerms], coef: dict[str, np.ndarray], ridge_share: float = RIDGE
) -> RegressionData:
    """Return the regression data of the pitching moment, with the moment of thrust as a term."""
    return RegressionData(all_terms, "M", ridge_share, lambda m: (coef["T"] @ m.regressors["T"])[None])


def axial_regression(all_terms: list[EquationTerms], ridge_share: float = RIDGE) -> RegressionData:
    """Return the regression data of axial force, drag terms before thrust terms."""
    return RegressionData(all_terms, "X", ridge_share, lambda m: m.regressors["T"])
