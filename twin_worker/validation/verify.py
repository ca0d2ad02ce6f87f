"""Verify a model on held-out data: free runs against a threshold, persistence and the active model; consistency.

fit = 100 (1 - ||y - y_hat|| / ||y - mean(y)||).  Source: Huang 2021, eq. 22.
"""

import msgspec
import numba as nb
import numpy as np

from fleet.contract import Outcome, Verdict
from fleet.window import STATES, Window
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel
from twin_worker.identification.fixed_wing.plant import Plant, is_finite
from twin_worker.validation.consistency import (
    MAX_DETECTABLE,
    Consistency,
    error_text,
    estimate_errors,
)
from twin_worker.validation.held_out import HeldOut

LAGS = 20  # samples
_BOUND = 1.96  # 95 % bound of white noise, times the root of the count


def whiteness(y: np.ndarray, y_hat: np.ndarray) -> np.ndarray:
    """Return the fraction of autocorrelations of y - y_hat within the 95 % band of white noise, per column, 0..1.

    Args:
        y, y_hat: measured and predicted, (n, k); rows with nan, such as every start, are excluded
    """
    e = (y - y_hat)[np.isfinite(y_hat).all(axis=1)]
    e = e[np.abs(e).sum(axis=1) > 0]
    if len(e) < 3 * LAGS:
        return np.zeros(y.shape[1])
    e = e - e.mean(axis=0)
    sums = np.empty((LAGS + 1, e.shape[1]))
    _lagged_products(e, sums)
    rho = sums[1:] / np.maximum(sums[0], 1e-30)
    return (np.abs(rho) < _BOUND / np.sqrt(len(e))).mean(axis=0)


@nb.njit(cache=True, nogil=True, _nrt=False)  # type: ignore[call-overload]
def _lagged_products(e: np.ndarray, out: np.ndarray) -> None:
    """Compute the sums of products of rows, (n, k), with those `lag` rows earlier, by lag from 0 on, (lags, k)."""
    for lag in range(len(out)):
        for j in range(e.shape[1]):
            out[lag, j] = 0.0
        for i in range(lag, len(e)):
            for j in range(e.shape[1]):
                out[lag, j] += e[i, j] * e[i - lag, j]


HORIZONS_S = (40.0, 16.0, 8.0, 4.0)  # longest first: the longest that the data allow
REPORTED_S = (40.0, 16.0, 4.0, 1.0)  # reported only; 1 s does not verify: feedback correlates inputs and noise
FIT_THRESHOLD = 0.0  # minimum mean fit over the nine states [%]; paper: "greater than 0 is acceptable"
AXES = {"lon": ("u", "w", "q", "theta"), "lat": ("phi", "psi", "p", "r", "v")}
_DIVERGED_FIT = -99.0  # mean fit of a diverging run [%]
_STEADY_STD = {"phi": 0.04, "theta": 0.04, "q": 0.05}  # steady flight below all [rad, rad, rad/s]
_FIT_TOLERANCE = 1.0  # allowed loss against the active model: chance [%]


def persistence_forecast(y: np.ndarray, ok: np.ndarray, length: int) -> np.ndarray:
    """Predict the value of each start: the baseline of every model."""
    starts = (np.arange(len(y)) // length) * length
    return np.where(ok[:, None] & ok[starts][:, None], y[starts], np.nan)


@nb.njit(cache=True, nogil=True)
def fit_percent(y: np.ndarray, y_hat: np.ndarray) -> np.ndarray:
    """Return the fit of each column over the common rows, (n,) [%]; -100 without rows or after divergence."""
    rows, columns = y.shape
    valid = np.ones(rows, np.bool_)
    for i in range(rows):
        for j in range(columns):
            valid[i] &= np.isfinite(y_hat[i, j])
    fit = np.full(columns, -100.0)
    if valid.sum() < 2:
        return fit
    for j in range(columns):
        mean, total, error = 0.0, 0.0, 0.0
        for i in range(rows):
            mean += y[i, j] if valid[i] else 0.0
        mean /= valid.sum()
        for i in range(rows):
            if valid[i]:
                total += (y[i, j] - mean) ** 2
                error += (y[i, j] - y_hat[i, j]) ** 2
        fit[j] = min(max(100.0 * (1.0 - np.sqrt(error) / max(np.sqrt(total), 1e-9)), -100.0), 100.0)
    return fit


def fit_and_persistence(held_out: HeldOut, horizon_s: float) -> tuple[dict[str, float], dict[str, float]]:
    """Return the fit of free runs and of persistence per state [%]; an incomplete last run is excluded."""
    y, ok, length = _trim_to_runs(held_out, horizon_s)
    return free_run_fit(held_out, horizon_s), _by_state(fit_percent(y, persistence_forecast(y, ok, length)))


def free_run_fit(held_out: HeldOut, horizon_s: float) -> dict[str, float]:
    """Return the fit of free runs per state [%]; an incomplete last run is excluded."""
    y, ok, length = _trim_to_runs(held_out, horizon_s)
    return _by_state(fit_percent(y, np.where(ok[:, None], held_out.runs(length)[: len(y)], np.nan)))


def _trim_to_runs(held_out: HeldOut, horizon_s: float) -> tuple[np.ndarray, np.ndarray, int]:
    """Return states and mask of complete runs, and the length of a run in rows."""
    length = max(int(horizon_s / held_out.dt), 2)
    n = max(len(held_out.y) // length, 1) * length
    return held_out.y[:n], held_out.ok[:n], length


def _by_state(fit: np.ndarray) -> dict[str, float]:
    return dict(zip(STATES, fit.tolist(), strict=True))


def mean_fit(fit: dict[str, float], states: tuple[str, ...] = STATES) -> float:
    """Return the mean fit over states, the paper's Fit_value [%]."""
    return float(np.add.reduce([fit[name] for name in states])) / len(states)


def fit_by_axis(fit: dict[str, float], horizon_s: float) -> dict[str, float]:
    """Return the mean fit of both axes at a horizon, e.g. `lon16` and `lat16` [%]."""
    return {f"{axis}{horizon_s:.0f}": mean_fit(fit, states) for axis, states in AXES.items()}


def verify_free_run(
    y: np.ndarray, y_hat: np.ndarray, training: Window, threshold: float = FIT_THRESHOLD
) -> tuple[Outcome, str]:
    """Return the verdict on one free run and its reason: above the threshold, and better than persistence.

    Args:
        y, y_hat: measured and predicted states in the order of `fleet.window.STATES`, (n, 9)
        training: identification window
        threshold: minimum mean fit [%]
    """
    ok = np.ones(len(y), bool)
    fit, persistence = _by_state(fit_percent(y, y_hat)), _by_state(fit_percent(y, persistence_forecast(y, ok, len(y))))
    return _classify(fit, _shortfall(fit, persistence, threshold), training)


def verify(
    plant: Plant, window: Window, start: int, threshold: float = FIT_THRESHOLD, active: Plant | None = None
) -> Verdict:
    """Verify a model on held-out data: above the threshold, better than persistence, no worse than the active model.

    A derivatives model that passes is plausible; `with_consistency` verifies it. Linear axes have the threshold only.

    Args:
        plant: the model
        window: flight; rows from `start` on are held out
        start: first row to predict
        threshold: minimum mean fit [%]
        active: the active model
    Returns:
        a verdict whose sentence does not yet name the model
    Raises:
        ValueError: if the data are shorter than the shortest horizon; wait for more data.
    """
    test_window = window.part(start, len(window))
    allowed = [h for h in HORIZONS_S if h <= test_window.seconds + test_window.dt]
    if not allowed:
        raise ValueError(
            f"verify: found {test_window.seconds:.1f} s held out, needs {HORIZONS_S[-1]:.0f} s; wait for more"
        )
    held_out = HeldOut(plant, window, start)
    for horizon in allowed:
        fit, persistence = fit_and_persistence(held_out, horizon)
        if not _shortfall(fit, persistence, threshold):
            break
    outcome, reason = _classify(fit, _shortfall(fit, persistence, threshold), window.part(0, start))
    if active is not None:
        active_fit = mean_fit(free_run_fit(HeldOut(active, window, start), horizon))
        if outcome is Outcome.VERIFIED and mean_fit(fit) < active_fit - _FIT_TOLERANCE:
            outcome, reason = Outcome.WORSE_THAN_LAST, f"the active model has {active_fit:.0f} % and stays active"
        elif outcome in (Outcome.BELOW_THRESHOLD, Outcome.DIVERGED) and active_fit <= threshold:
            outcome, reason = Outcome.DRIFTING, f"active model {active_fit:.0f} %: aircraft or air has changed"
    if outcome is Outcome.VERIFIED and isinstance(plant, DerivativesModel):
        outcome = Outcome.PLAUSIBLE
    if not is_finite(plant):
        outcome, reason = Outcome.DIVERGED, "the model is not finite; trying again"
    return Verdict(
        outcome=outcome,
        sentence=f"mean fit {mean_fit(fit):.0f} % over {horizon:.0f} s of held-out data, {reason}",
        fit=fit,
        fit_persistence=persistence,
        horizon_s=horizon,
        threshold=threshold,
    )


def with_consistency(verdict: Verdict, plant: Plant, window: Window, start: int) -> Verdict:
    """Test a plausible model for consistency with held-out data; verified if it passes and its power is stated."""
    if verdict.outcome is not Outcome.PLAUSIBLE or not isinstance(plant, DerivativesModel):
        return verdict
    return concluded(verdict, estimate_errors(plant, window, start), verdict.sentence)


def verify_since_identification(verdict: Verdict, plant: Plant, window: Window, name: str) -> Verdict:
    """Test an accepted model for consistency with all data since its identification.

    The data were never used for this model, so their power grows as the flight goes on.

    Args:
        verdict: the accepted verdict on the model
        plant: the model
        window: flight up to now, which may begin before or after the end of the identification
        name: the UAV, for the sentence
    Returns:
        a newer verdict; the same where the data neither reject the model nor have power
    """
    if not isinstance(plant, DerivativesModel):
        return verdict
    start = int(np.searchsorted(window.t, plant.t1, side="right"))
    errors = estimate_errors(plant, window, start) if start < len(window) else None
    if errors is None or not (errors.failed() or errors.has_power):
        return verdict
    seconds = (len(window) - start) * window.dt
    return concluded(verdict, errors, f"{name}: {seconds:.0f} s of flight since the identification")


def concluded(verdict: Verdict, errors: Consistency | None, sentence: str) -> Verdict:
    """Return the verdict of a consistency test, with its reason added to the sentence; `errors` of None: no test."""
    failed = errors.failed() if errors is not None else {}
    verified = errors is not None and not failed and errors.has_power
    if failed:
        reason = f"plausible only: {error_text(failed)}"
    elif errors is None or not verified:
        reason = (
            f"plausible only: these data would not show an error of {100 * MAX_DETECTABLE:.0f} % in one of the axes"
        )
    else:
        reason = f"consistent, {errors.power_text()}"
    return msgspec.structs.replace(
        verdict,
        outcome=Outcome.VERIFIED if verified else Outcome.PLAUSIBLE,
        sentence=f"{sentence}; {reason}",
        derivative_error=failed,
        detectable_error=errors.power() if errors is not None else {},
    )


def with_diagnostics(verdict: Verdict, held_out: HeldOut) -> Verdict:
    """Add diagnostics to a verdict: the fit at other horizons and the whiteness of residuals."""
    seconds = held_out.dt * (len(held_out.y) - 1)
    fits = {h: free_run_fit(held_out, h) for h in REPORTED_S if h <= seconds + held_out.dt}
    axis_fits = {name: value for h, fit in fits.items() for name, value in fit_by_axis(fit, h).items()}
    white_share = _by_state(whiteness(held_out.y, held_out.one_step()))
    return msgspec.structs.replace(verdict, fit_by_length=axis_fits, whiteness=white_share)


def _shortfall(fit: dict[str, float], persistence: dict[str, float], threshold: float) -> str:
    """Describe why the fit fails: below the threshold, or an axis no better than persistence; empty if it passes."""
    if mean_fit(fit) <= threshold:
        return f"more than {threshold:.0f} % is needed"
    for states in AXES.values():
        model_fit, persistence_fit = mean_fit(fit, states), mean_fit(persistence, states)
        if model_fit <= persistence_fit:
            return f"{states[0]} {states[1]} … {model_fit:.0f} % is no better than persistence, {persistence_fit:.0f} %"
    return ""


def _steady_flight(training: Window) -> str:
    """Describe the motion if it is too small to identify a model; empty otherwise or without measured rows."""
    rows = training.columns(tuple(_STEADY_STD))[training.ok]
    if not len(rows) or ((std := rows.std(axis=0)) >= list(_STEADY_STD.values())).any():
        return ""
    phi, theta, q = np.degrees(std)
    return f"steady flight (phi {phi:.1f} deg, theta {theta:.1f} deg, q {q:.1f} deg/s)"


def _classify(fit: dict[str, float], shortfall: str, training: Window) -> tuple[Outcome, str]:
    if mean_fit(fit) <= _DIVERGED_FIT:
        return Outcome.DIVERGED, "the free run diverges; trying again"
    if steady := _steady_flight(training):
        return Outcome.NOT_IDENTIFIABLE, f"not identifiable: {steady} does not excite the dynamics; wait for a turn"
    if not shortfall:
        return Outcome.VERIFIED, "above the threshold and better than persistence"
    return Outcome.BELOW_THRESHOLD, f"{shortfall}; trying another window"
