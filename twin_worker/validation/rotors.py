"""Verify a rotor model on held-out data: free runs against a threshold and persistence; consistency with power.

The fit is that of the velocity and of the attitude as vectors, 100 (1 - |y - y_hat| / |y - mean(y)|): a single
component that hardly varies, as the climb rate in level flight, has no fit of its own.  Source: Huang 2021, eq. 22.
"""

import numpy as np

from fleet.contract import Outcome, Verdict
from twin_worker.identification.multirotor.output_error import EFFECTIVE_FRACTION, RUN_S, START_STD, RotorProblem
from twin_worker.identification.multirotor.rotor_model import PARAMETERS, RotorModel, free_run, start_states
from twin_worker.identification.multirotor.rotor_window import DT, RotorWindow
from twin_worker.validation.consistency import MIN_RUNS, Consistency, compare, solve
from twin_worker.validation.verify import FIT_THRESHOLD, concluded

HORIZONS_S = (10.0, 4.0)  # longest first: the longest that passes
_FIT_TOLERANCE = 1.0  # allowed loss against the active model: chance [%]
_DIVERGED_FIT = -99.0  # mean fit of a diverging run [%]
_HOVER_SPEED, _HOVER_TILT = 0.5, 0.02  # standard deviations of velocity and tilt below which flight is a hover
_PARTS = {"velocity": slice(0, 3), "attitude": slice(3, 5)}
_GROUPS = {"thrust": ("k",), "drag": ("d", "c")}
_AXIS_OF = {"thrust": "vertical", "drag": "horizontal"}
_NUISANCE = ("w_n", "w_e", "phi_0", "theta_0")


def rotor_fit(model: RotorModel, window: RotorWindow, seconds: float) -> tuple[dict[str, float], dict[str, float]]:
    """Return the fit of free runs of `seconds` and that of persistence, by part of the state [%]; empty: no run."""
    length = round(seconds / DT)
    rows = window.runs(length)
    if not len(rows):
        return {}, {}
    starts = start_states(window, rows)
    run = free_run(model.par, window, rows, starts, length, commanded=model.has_command)
    measured = window.states[rows[:, None] + np.arange(length + 1)]
    parts = _PARTS if model.has_command else {"velocity": _PARTS["velocity"]}
    last_value = np.broadcast_to(measured[:, :1], measured.shape)
    return (
        {name: _vector_fit(measured[..., part], run[..., part]) for name, part in parts.items()},
        {name: _vector_fit(measured[..., part], last_value[..., part]) for name, part in parts.items()},
    )


def _vector_fit(y: np.ndarray, y_hat: np.ndarray) -> float:
    error, total = float(((y - y_hat) ** 2).sum()), float(((y - y.mean(axis=(0, 1))) ** 2).sum())
    return (
        float(np.clip(100.0 * (1.0 - np.sqrt(error / max(total, 1e-12))), -100.0, 100.0)) if error < np.inf else -100.0
    )


def verify_rotors(
    model: RotorModel,
    window: RotorWindow,
    start: int,
    *,
    name: str,
    threshold: float = FIT_THRESHOLD,
    active: RotorModel | None = None,
) -> Verdict:
    """Verify a rotor model: above the threshold, better than persistence, no worse than the active one, consistent.

    Args:
        model: the model
        window: flight; rows from `start` on are held out
        start: first held-out row
        name: of the aircraft, for the sentence
        threshold: minimum mean fit [%]
        active: the active model
    """
    held_out = window.part(start, len(window))
    fits = {seconds: rotor_fit(model, held_out, seconds) for seconds in HORIZONS_S}
    passed = (seconds for seconds, pair in fits.items() if pair[0] and not _shortfall(*pair, threshold))
    horizon = next(passed, HORIZONS_S[-1])
    fit, persistence = fits[horizon]
    if not fit:
        sentence = f"{name}: {held_out.seconds:.0f} s held out without a run of {horizon:.0f} s; wait for more flight"
        return Verdict(outcome=Outcome.INSUFFICIENT_DATA, sentence=sentence)
    outcome, reason = _classify(fit, _shortfall(fit, persistence, threshold), window.part(0, start))
    mean = _mean(fit)
    if outcome is Outcome.PLAUSIBLE and active is not None:
        active_fit = _mean(rotor_fit(active, held_out, horizon)[0])
        if mean < active_fit - _FIT_TOLERANCE:
            outcome, reason = Outcome.WORSE_THAN_LAST, f"the active model has {active_fit:.0f} % and stays active"
    by_length = {f"{part}{seconds:.0f}": value for seconds, (one, _) in fits.items() for part, value in one.items()}
    verdict = Verdict(
        outcome=outcome,
        sentence=f"{name}: mean fit {mean:.0f} % over {horizon:.0f} s of held-out data, {reason}",
        fit=fit,
        fit_persistence=persistence,
        fit_by_length=by_length,
        horizon_s=horizon,
        threshold=threshold,
    )
    if outcome is not Outcome.PLAUSIBLE:
        return verdict
    return concluded(verdict, rotor_consistency(model, held_out), verdict.sentence)


def verify_since_identification(verdict: Verdict, model: RotorModel, window: RotorWindow, name: str) -> Verdict:
    """Test an accepted model for consistency with all flight since its identification.

    Args:
        verdict: the accepted verdict on the model
        model: the model
        window: flight up to now
        name: of the aircraft, for the sentence
    Returns:
        a newer verdict; the same where the data neither reject the model nor have power
    """
    since = window.part(int(np.searchsorted(window.t, model.t1, side="right")), len(window))
    errors = rotor_consistency(model, since)
    if errors is None or not (errors.failed() or errors.has_power):
        return verdict
    return concluded(verdict, errors, f"{name}: {since.seconds:.0f} s of flight since the identification")


def rotor_consistency(model: RotorModel, held_out: RotorWindow) -> Consistency | None:
    """Estimate the errors of thrust and drag on held-out data; None with too few free runs.

    The attitude has no such test: its autopilot's answer is stiff and depends on the amplitude, so that a large change
    of the natural frequency changes the path little. Its fit judges it.
    """
    length = round(RUN_S / DT)
    rows = held_out.runs(length)
    if len(rows) < MIN_RUNS:
        return None
    problem = RotorProblem(held_out, rows, length, commanded=False)
    grams = _grams(model, problem)
    return compare(grams, _AXIS_OF, _identified(model, problem)) if np.isfinite(grams).all() else None


def _columns(model: RotorModel) -> np.ndarray:
    """Return what the groups and the nuisances change, (16, groups + nuisances)."""
    columns = np.zeros((len(PARAMETERS), len(_GROUPS) + len(_NUISANCE)))
    for k, names in enumerate(_GROUPS.values()):
        rows = [PARAMETERS.index(name) for name in names]
        columns[rows, k] = model.par[rows]
    columns[[PARAMETERS.index(name) for name in _NUISANCE], range(len(_GROUPS), columns.shape[1])] = 1.0
    return columns


def _grams(model: RotorModel, problem: RotorProblem) -> np.ndarray:
    """Return the products of [sensitivities to groups and nuisances, residuals] of each run, (k, p, p).

    What start state and gust of the run explain is removed, as the identification does.
    """
    starts = start_states(problem.window, problem.rows)
    run = problem.simulated(model.par, starts)
    by_par, by_start = problem.jacobian(model.par, starts, run)
    root = np.sqrt(model.weight[problem.outputs])[:, None]
    sensitivity = by_par @ _columns(model)[problem.parameters]
    rows = np.concatenate([sensitivity, (problem.measured() - run)[..., None]], axis=-1) * root
    moved = (by_start * root).reshape(len(run), -1, by_start.shape[-1])
    rows = rows.reshape(len(run), -1, rows.shape[-1])
    square = np.swapaxes(moved, 1, 2) @ moved + np.diag(START_STD[problem.start] ** -2.0) / EFFECTIVE_FRACTION
    explained = moved @ np.linalg.solve(square, np.swapaxes(moved, 1, 2) @ rows)
    return np.asarray(np.swapaxes(rows, 1, 2) @ (rows - explained))


def _identified(model: RotorModel, problem: RotorProblem) -> np.ndarray:
    """Return the information on each group in the model, in the unit of held-out data, (groups,)."""
    used, columns, n = problem.parameters, _columns(model)[problem.parameters], len(_GROUPS)
    H = columns.T @ model.information[used, used] @ columns / EFFECTIVE_FRACTION
    return np.asarray(np.diag(H)[:n] - np.einsum("ng,ng->g", H[n:, :n], solve(H[n:, n:], H[n:, :n])))


def _mean(fit: dict[str, float]) -> float:
    return float(np.mean(list(fit.values()))) if fit else -np.inf


def _shortfall(fit: dict[str, float], persistence: dict[str, float], threshold: float) -> str:
    """Describe why the fit fails: below the threshold, or no better than persistence; empty if it passes."""
    if _mean(fit) <= threshold:
        return f"more than {threshold:.0f} % is needed"
    for name, value in fit.items():
        if value <= persistence[name]:
            return f"{name} {value:.0f} % is no better than persistence, {persistence[name]:.0f} %"
    return ""


def _classify(fit: dict[str, float], shortfall: str, training: RotorWindow) -> tuple[Outcome, str]:
    if _mean(fit) <= _DIVERGED_FIT:
        return Outcome.DIVERGED, "the free run diverges; it is repeated with newer flight"
    speed, tilt = training.velocity[training.ok].std(axis=0).max(), training.attitude[training.ok, :2].std(axis=0).max()
    if speed < _HOVER_SPEED and tilt < _HOVER_TILT:
        return Outcome.NOT_IDENTIFIABLE, "not identifiable: a hover does not excite drag or attitude; wait for a leg"
    if not shortfall:
        return Outcome.PLAUSIBLE, "above the threshold and better than persistence"
    return Outcome.BELOW_THRESHOLD, f"{shortfall}; it is repeated with newer flight"
