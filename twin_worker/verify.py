"""Does a model deserve belief? Free runs over data it has not seen, against a threshold, holding still and the last.

fit = 100 (1 - ||y - y_hat|| / ||y - mean(y)||).  Source: Huang 2021, eq. 22.
"""

import numpy as np

from fleet.contract import Outcome, Verdict
from fleet.window import STATES, Window
from twin_worker.plant import Plant, finite
from twin_worker.unseen import Unseen
from twin_worker.white import whiteness

HORIZONS_S = (40.0, 16.0, 8.0, 4.0)  # longest first: a model is verified at the longest its data allow
TOLD_S = (40.0, 16.0, 4.0, 1.0)  # told, too; 1 s is no ground for belief: inputs hold the noise of what they answered
OMEGA = 0.0  # least mean fit over the nine states [%]; the paper: "greater than 0 is acceptable"
AXES = {"lon": ("u", "w", "q", "theta"), "lat": ("phi", "psi", "p", "r", "v")}
_LOST = -99.0  # mean fit that only a diverging run has [%]
_QUIET_PHI, _QUIET_Q = 0.04, 0.02  # less than this is steady flight [rad, rad/s]
_NO_WORSE = 1.0  # points a new model may lie below the last: chance [%]


def hold(y: np.ndarray, ok: np.ndarray, length: int) -> np.ndarray:
    """Predict by holding the value at each fresh start: the least any model must beat."""
    starts = (np.arange(len(y)) // length) * length
    return np.where(ok[:, None] & ok[starts][:, None], y[starts], np.nan)


def fit_percent(y: np.ndarray, y_hat: np.ndarray) -> np.ndarray:
    """Give the fit of each column over the rows both have, (n,) [%]; -100 where nothing is left or it diverged."""
    good = np.isfinite(y_hat).all(axis=1)
    if good.sum() < 2:
        return np.full(y.shape[1], -100.0)
    spread = np.linalg.norm(y[good] - y[good].mean(axis=0), axis=0)
    nrmse = np.linalg.norm(y[good] - y_hat[good], axis=0) / np.maximum(spread, 1e-9)
    return np.clip(100.0 * (1.0 - nrmse), -100.0, 100.0)


def fits_at(unseen: Unseen, horizon_s: float) -> tuple[dict[str, float], dict[str, float]]:
    """Give the fit of the model's free runs, and of holding the last value, per state [%]; an odd end is left out."""
    length = max(int(horizon_s / unseen.dt), 2)
    n = max(len(unseen.y) // length, 1) * length
    y, ok = unseen.y[:n], unseen.ok[:n]
    made = np.where(ok[:, None], unseen.runs(length)[:n], np.nan)
    return _named(fit_percent(y, made)), _named(fit_percent(y, hold(y, ok, length)))


def _named(fit: np.ndarray) -> dict[str, float]:
    return dict(zip(STATES, fit.tolist(), strict=True))


def mean(fit: dict[str, float], states: tuple[str, ...] = STATES) -> float:
    """Give the mean fit over states, the paper's Fit_value [%]."""
    return float(np.mean([fit[name] for name in states]))


def by_axis(fit: dict[str, float], horizon_s: float) -> dict[str, float]:
    """Give the mean fit of both axes at a horizon, e.g. `lon16` and `lat16` [%]."""
    return {f"{axis}{horizon_s:.0f}": mean(fit, states) for axis, states in AXES.items()}


def verify(plant: Plant, window: Window, start: int, omega: float = OMEGA, last: Plant | None = None) -> Verdict:
    """Judge a model on data it has not seen: above the threshold, better than holding still, no worse than the last.

    Args:
        plant: the model
        window: flight; rows from `start` on it has not seen
        start: first row to predict
        omega: threshold on the mean fit [%]
        last: the model in force
    Returns:
        a verdict whose sentence does not yet say whose it is
    Raises:
        ValueError: when the data are shorter than the shortest horizon; wait for more.
    """
    held = window.part(start, len(window))
    allowed = [h for h in HORIZONS_S if h <= held.seconds + held.dt]
    if not allowed:
        raise ValueError(f"verify: found {held.seconds:.1f} s held out, needs {HORIZONS_S[-1]:.0f} s; wait for more")
    unseen = Unseen(plant, window, start)
    found = {h: fits_at(unseen, h) for h in TOLD_S if h <= allowed[0]}
    for horizon in allowed:
        if horizon not in found:
            found[horizon] = fits_at(unseen, horizon)
        if not _missing(*found[horizon], omega):
            break
    fit, still = found[horizon]
    outcome, said = _judge(fit, _missing(fit, still, omega), held)
    if last is not None:
        before = mean(fits_at(Unseen(last, window, start), horizon)[0])
        if outcome is Outcome.VERIFIED and mean(fit) < before - _NO_WORSE:
            outcome, said = Outcome.WORSE_THAN_LAST, f"the model in force has {before:.0f} % and stays"
        elif outcome in (Outcome.BELOW_THRESHOLD, Outcome.DIVERGED) and before <= omega:
            outcome, said = Outcome.DRIFTING, f"and {before:.0f} % by the model in force: aircraft or air have changed"
    if not finite(plant):
        outcome, said = Outcome.DIVERGED, "the model is not finite; trying again"
    at = {name: value for h, (each, _) in found.items() for name, value in by_axis(each, h).items()}
    return Verdict(
        outcome=outcome,
        sentence=f"mean fit {mean(fit):.0f} % over {horizon:.0f} s of unseen data, {said}",
        fit=fit,
        fit_hold=still,
        fit_at=at,
        whiteness=_named(whiteness(unseen.y, unseen.runs(2))),
        horizon_s=horizon,
        threshold=omega,
    )


def _missing(fit: dict[str, float], still: dict[str, float], omega: float) -> str:
    """Say what the fit lacks: the threshold over all states, and on either axis more than holding still; or nothing."""
    if mean(fit) <= omega:
        return f"more than {omega:.0f} % is needed"
    for states in AXES.values():
        model, held = mean(fit, states), mean(still, states)
        if model <= held:
            return f"{states[0]} {states[1]} … {model:.0f} % is no better than holding still, {held:.0f} %"
    return ""


def _judge(fit: dict[str, float], missing: str, held: Window) -> tuple[Outcome, str]:
    if mean(fit) <= _LOST:
        return Outcome.DIVERGED, "the free run diverges; trying again"
    if not missing:
        return Outcome.VERIFIED, "above the threshold and better than holding still"
    if held.columns(("phi",)).std() < _QUIET_PHI and held.columns(("q",)).std() < _QUIET_Q:
        return Outcome.NOT_IDENTIFIABLE, f"{missing}; steady flight excites nothing, wait for a turn"
    return Outcome.BELOW_THRESHOLD, f"{missing}; trying another window"
