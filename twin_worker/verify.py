"""Does a model deserve belief? Free runs over data it has not seen, against a threshold and against holding still.

fit = 100 (1 - ||y - y_hat|| / ||y - mean(y)||).  Source: Huang 2021, eq. 22.
"""

import numpy as np

from fleet.contract import Outcome, Verdict
from fleet.window import Window
from twin_worker.identify import Axis
from twin_worker.refine import free_run

HORIZONS_S = (16.0, 8.0, 4.0)  # longest first: a model is verified at the longest its data allow
OMEGA = 0.0  # least mean fit over the nine states [%]; the paper: "greater than 0 is acceptable"
_LOST = -99.0  # mean fit that only a diverging run has [%]
_QUIET_PHI, _QUIET_Q = 0.04, 0.02  # less than this is steady flight [rad, rad/s]


def free_runs(D: np.ndarray, y: np.ndarray, u: np.ndarray, ok: np.ndarray, length: int) -> np.ndarray:
    """Predict y from a fresh start every `length` samples; nan where a run crosses unmeasured rows.

    Args:
        D: [A B c], scaled units, (n, n + m + 1)
        y, u, ok: held-out outputs (N, n), inputs (N, m), measured rows (N,)
        length: free-run length [samples]
    Returns:
        predictions, (N, n)
    """
    out = np.full_like(y, np.nan)
    for start in range(0, len(y), length):
        stop = min(start + length, len(y))
        if ok[start:stop].all() and stop - start > 1:
            free_run(D, y[start], np.ascontiguousarray(u[start:stop]), out[start:stop])
    return out


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


def fits_at(axes: tuple[Axis, Axis], held: Window, horizon_s: float) -> tuple[dict[str, float], dict[str, float]]:
    """Give the fit of both axes' free runs, and of holding the last value, per state [%].

    Args:
        axes: longitudinal and lateral model
        held: data neither has seen
        horizon_s: free-run length [s]
    """
    length = int(horizon_s / held.dt)
    whole = held.part(0, max(len(held) // length, 1) * length)
    fit: dict[str, float] = {}
    still: dict[str, float] = {}
    for axis in axes:
        y, u = axis.scaled(whole)
        fit |= dict(zip(axis.states, fit_percent(y, free_runs(axis.D, y, u, whole.ok, length)).tolist(), strict=True))
        still |= dict(zip(axis.states, fit_percent(y, hold(y, whole.ok, length)).tolist(), strict=True))
    return fit, still


def mean(fit: dict[str, float]) -> float:
    """Give the mean fit over the states, the paper's Fit_value [%]."""
    return float(np.mean(list(fit.values())))


def verify(axes: tuple[Axis, Axis], held: Window, omega: float = OMEGA) -> Verdict:
    """Judge a model on held-out data: above the threshold and, on either axis, better than holding still.

    Args:
        axes: longitudinal and lateral model
        held: data neither has seen
        omega: threshold on the mean fit [%]
    Returns:
        a verdict whose sentence does not yet say whose it is
    Raises:
        ValueError: when the data are shorter than the shortest horizon; wait for more.
    """
    allowed = [h for h in HORIZONS_S if h <= held.seconds + held.dt]
    if not allowed:
        raise ValueError(f"verify: found {held.seconds:.1f} s held out, needs {HORIZONS_S[-1]:.0f} s; wait for more")
    for horizon in allowed:
        fit, still = fits_at(axes, held, horizon)
        missing = _missing(axes, fit, still, omega)
        if not missing:
            break
    outcome, sentence = _judge(fit, missing, held)
    if not all(np.isfinite(axis.D).all() for axis in axes):
        outcome, sentence = Outcome.DIVERGED, "the model is not finite; trying again"
    return Verdict(
        outcome=outcome,
        sentence=f"mean fit {mean(fit):.0f} % over {horizon:.0f} s of unseen data, {sentence}",
        fit=fit,
        fit_hold=still,
        horizon_s=horizon,
        threshold=omega,
    )


def _missing(axes: tuple[Axis, Axis], fit: dict[str, float], still: dict[str, float], omega: float) -> str:
    """Say what the fit lacks: the threshold over all states, and on either axis more than holding still; or nothing."""
    if mean(fit) <= omega:
        return f"more than {omega:.0f} % is needed"
    for axis in axes:
        model, held = (mean({name: each[name] for name in axis.states}) for each in (fit, still))
        if model <= held:
            return f"{axis.states[0]} {axis.states[1]} … {model:.0f} % is no better than holding still, {held:.0f} %"
    return ""


def _judge(fit: dict[str, float], missing: str, held: Window) -> tuple[Outcome, str]:
    if mean(fit) <= _LOST:
        return Outcome.DIVERGED, "the free run diverges; trying again"
    if not missing:
        return Outcome.VERIFIED, "above the threshold and better than holding still"
    if held.columns(("phi",)).std() < _QUIET_PHI and held.columns(("q",)).std() < _QUIET_Q:
        return Outcome.NOT_IDENTIFIABLE, f"{missing}; steady flight excites nothing, wait for a turn"
    return Outcome.BELOW_THRESHOLD, f"{missing}; trying another window"
