"""Verify a model: free runs on held-out data against a threshold, persistence and the active model.

fit = 100 (1 - ||y - y_hat|| / ||y - mean(y)||).  Source: Huang 2021, eq. 22.
"""

import msgspec
import numba as nb
import numpy as np

from fleet.contract import Outcome, Verdict
from fleet.window import STATES, Window
from twin_worker.identification.fixed_wing.plant import Plant, finite
from twin_worker.validation.held_out import Unseen
from twin_worker.validation.whiteness import whiteness

HORIZONS_S = (40.0, 16.0, 8.0, 4.0)  # longest first: the longest that the data allow
TOLD_S = (40.0, 16.0, 4.0, 1.0)  # reported only; 1 s does not verify: feedback correlates inputs and noise
OMEGA = 0.0  # minimum mean fit over the nine states [%]; paper: "greater than 0 is acceptable"
AXES = {"lon": ("u", "w", "q", "theta"), "lat": ("phi", "psi", "p", "r", "v")}
_LOST = -99.0  # mean fit of a diverging run [%]
_QUIET = {"phi": 0.04, "theta": 0.04, "q": 0.05}  # steady flight below all [rad, rad, rad/s]
_NO_WORSE = 1.0  # allowed loss against the active model: chance [%]


def hold(y: np.ndarray, ok: np.ndarray, length: int) -> np.ndarray:
    """Predict the value of each start: the baseline of every model."""
    starts = (np.arange(len(y)) // length) * length
    return np.where(ok[:, None] & ok[starts][:, None], y[starts], np.nan)


@nb.njit(cache=True, nogil=True)
def fit_percent(y: np.ndarray, y_hat: np.ndarray) -> np.ndarray:
    """Return the fit of each column over the common rows, (n,) [%]; -100 without rows or after divergence."""
    rows, columns = y.shape
    good = np.ones(rows, np.bool_)
    for i in range(rows):
        for j in range(columns):
            good[i] &= np.isfinite(y_hat[i, j])
    fit = np.full(columns, -100.0)
    if good.sum() < 2:
        return fit
    for j in range(columns):
        mean, spread, error = 0.0, 0.0, 0.0
        for i in range(rows):
            mean += y[i, j] if good[i] else 0.0
        mean /= good.sum()
        for i in range(rows):
            if good[i]:
                spread += (y[i, j] - mean) ** 2
                error += (y[i, j] - y_hat[i, j]) ** 2
        fit[j] = min(max(100.0 * (1.0 - np.sqrt(error) / max(np.sqrt(spread), 1e-9)), -100.0), 100.0)
    return fit


def fits_at(unseen: Unseen, horizon_s: float) -> tuple[dict[str, float], dict[str, float]]:
    """Return the fit of free runs and of persistence per state [%]; an incomplete last run is excluded."""
    y, ok, length = _whole(unseen, horizon_s)
    return fit_at(unseen, horizon_s), _named(fit_percent(y, hold(y, ok, length)))


def fit_at(unseen: Unseen, horizon_s: float) -> dict[str, float]:
    """Return the fit of free runs per state [%]; an incomplete last run is excluded."""
    y, ok, length = _whole(unseen, horizon_s)
    return _named(fit_percent(y, np.where(ok[:, None], unseen.runs(length)[: len(y)], np.nan)))


def _whole(unseen: Unseen, horizon_s: float) -> tuple[np.ndarray, np.ndarray, int]:
    """Return states and mask of complete runs, and the length of a run in rows."""
    length = max(int(horizon_s / unseen.dt), 2)
    n = max(len(unseen.y) // length, 1) * length
    return unseen.y[:n], unseen.ok[:n], length


def _named(fit: np.ndarray) -> dict[str, float]:
    return dict(zip(STATES, fit.tolist(), strict=True))


def mean(fit: dict[str, float], states: tuple[str, ...] = STATES) -> float:
    """Return the mean fit over states, the paper's Fit_value [%]."""
    return float(np.add.reduce([fit[name] for name in states])) / len(states)


def by_axis(fit: dict[str, float], horizon_s: float) -> dict[str, float]:
    """Return the mean fit of both axes at a horizon, e.g. `lon16` and `lat16` [%]."""
    return {f"{axis}{horizon_s:.0f}": mean(fit, states) for axis, states in AXES.items()}


def verify(plant: Plant, window: Window, start: int, omega: float = OMEGA, last: Plant | None = None) -> Verdict:
    """Verify a model on held-out data: above the threshold, better than persistence, no worse than the active model.

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
    held = window.part(start, len(window))
    allowed = [h for h in HORIZONS_S if h <= held.seconds + held.dt]
    if not allowed:
        raise ValueError(f"verify: found {held.seconds:.1f} s held out, needs {HORIZONS_S[-1]:.0f} s; wait for more")
    unseen = Unseen(plant, window, start)
    for horizon in allowed:
        fit, still = fits_at(unseen, horizon)
        if not _missing(fit, still, omega):
            break
    outcome, said = _judge(fit, _missing(fit, still, omega), window.part(0, start))
    if last is not None:
        before = mean(fit_at(Unseen(last, window, start), horizon))
        if outcome is Outcome.VERIFIED and mean(fit) < before - _NO_WORSE:
            outcome, said = Outcome.WORSE_THAN_LAST, f"the active model has {before:.0f} % and stays active"
        elif outcome in (Outcome.BELOW_THRESHOLD, Outcome.DIVERGED) and before <= omega:
            outcome, said = Outcome.DRIFTING, f"active model {before:.0f} %: aircraft or air has changed"
    if not finite(plant):
        outcome, said = Outcome.DIVERGED, "the model is not finite; trying again"
    return Verdict(
        outcome=outcome,
        sentence=f"mean fit {mean(fit):.0f} % over {horizon:.0f} s of held-out data, {said}",
        fit=fit,
        fit_hold=still,
        horizon_s=horizon,
        threshold=omega,
    )


def told(verdict: Verdict, plant: Plant, window: Window, start: int) -> Verdict:
    """Add diagnostics to a verdict: the fit at other horizons and the whiteness of residuals."""
    unseen = Unseen(plant, window, start)
    seconds = unseen.dt * (len(unseen.y) - 1)
    fits = {h: fit_at(unseen, h) for h in TOLD_S if h <= seconds + unseen.dt}
    at = {name: value for h, fit in fits.items() for name, value in by_axis(fit, h).items()}
    white = _named(whiteness(unseen.y, unseen.one_step()))
    return msgspec.structs.replace(verdict, fit_at=at, whiteness=white)


def _missing(fit: dict[str, float], still: dict[str, float], omega: float) -> str:
    """Describe why the fit fails: below the threshold, or an axis no better than persistence; empty if it passes."""
    if mean(fit) <= omega:
        return f"more than {omega:.0f} % is needed"
    for states in AXES.values():
        model, held = mean(fit, states), mean(still, states)
        if model <= held:
            return f"{states[0]} {states[1]} … {model:.0f} % is no better than persistence, {held:.0f} %"
    return ""


def _steady(known: Window) -> str:
    """Describe the motion if it is too small to identify a model; empty otherwise or without measured rows."""
    rows = known.columns(tuple(_QUIET))[known.ok]
    if not len(rows) or ((moved := rows.std(axis=0)) >= list(_QUIET.values())).any():
        return ""
    phi, theta, q = np.degrees(moved)
    return f"steady flight (phi {phi:.1f} deg, theta {theta:.1f} deg, q {q:.1f} deg/s)"


def _judge(fit: dict[str, float], missing: str, known: Window) -> tuple[Outcome, str]:
    if mean(fit) <= _LOST:
        return Outcome.DIVERGED, "the free run diverges; trying again"
    if steady := _steady(known):
        return Outcome.NOT_IDENTIFIABLE, f"not identifiable: {steady} does not excite the dynamics; wait for a turn"
    if not missing:
        return Outcome.VERIFIED, "above the threshold and better than persistence"
    return Outcome.BELOW_THRESHOLD, f"{missing}; trying another window"
