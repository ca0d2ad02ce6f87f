"""Search of effects and onsets: gains with nuisances eliminated, evidence, sets of up to two effects.

The gain of an effect with onset t0 is the drop of the penalised sum of squares. Its columns begin at t0, and their
products with the nuisances follow for all onsets from cumulative sums. With a Gaussian prior of precision P for m
coordinates and information H,

    log evidence = G / (2 chance) + log|P| / 2 - log|H + P| / 2 - log(number of onsets)   relative to no effect

Source: MacKay 2003, ch. 28 (Laplace's method, Occam factor).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin_worker.diagnosis.multirotor.baseline import RotorBaseline
from twin_worker.diagnosis.multirotor.effects import RotorEffect
from twin_worker.diagnosis.multirotor.flight import RotorFlight
from twin_worker.diagnosis.multirotor.linearise import ActiveEffect, LinearFlight, Solution, huber, solve
from twin_worker.diagnosis.multirotor.model import CHANNELS, STEP_S

_ONSET_STEP_S = 2.0
_MARGIN_S = 8.0  # of onsets from the ends of the flight
_BLOCK_S = 10.0
_REFINED, _EXTENDED = 6, 3  # single effects that are refined; of them, extended by a second one
_PRIOR_NONE, _PRIOR_SINGLE, _PRIOR_PAIR = 0.6, 0.3, 0.1
_MODEL_ERROR = 0.02  # share of a gain by which the model itself is uncertain [-]


@dataclass(frozen=True)
class Explanation:
    """A set of effects with its log evidence relative to none, prior included."""

    active: tuple[ActiveEffect, ...]
    evidence: float
    solution: Solution
    gain: float

    @property
    def names(self) -> tuple[str, ...]:
        """Return the labels of the effects."""
        return tuple(one.one.label for one in self.active)


@dataclass(frozen=True)
class _Scan:
    """Best onset of one effect in the linear search."""

    one: RotorEffect
    onset: float | None
    values: np.ndarray
    gain: float
    evidence: float


def search(linear: LinearFlight, baseline: RotorBaseline) -> list[Explanation]:
    """Return the explanations of a flight, best first; one of them is none."""
    start = linear.start(baseline.parameters)
    none = solve(linear, baseline.parameters, baseline.spread, start, iterations=4)
    linear.weights = np.maximum(_scales(none.white, linear) * linear.weights, 1.0)
    none = solve(linear, baseline.parameters, baseline.spread, none.fit, iterations=1)
    n = len(linear.catalogue)
    explanations = [Explanation((), np.log(_PRIOR_NONE), none, 0.0)]
    singles = []
    for scan in _best(scan_effects(linear, none, baseline.chance), _REFINED):
        found = _refined(linear, baseline, none, (), scan)
        singles.append(replace(found, evidence=found.evidence + np.log(_PRIOR_SINGLE / n)))
    singles.sort(key=lambda one: -one.evidence)
    explanations += singles
    for single in [one for one in singles if one.evidence > explanations[0].evidence][:_EXTENDED]:
        used = {one.one.effect.name for one in single.active}
        scans = [s for s in scan_effects(linear, single.solution, baseline.chance) if s.one.effect.name not in used]
        for scan in _best(scans, 2):
            found = _refined(linear, baseline, none, single.active, scan)
            explanations.append(replace(found, evidence=found.evidence + np.log(_PRIOR_PAIR / n**2)))
    return sorted(explanations, key=lambda one: -one.evidence)


def _best(scans: Sequence[_Scan], number: int) -> list[_Scan]:
    """Return the best onsets, at most one for each effect and place."""
    return sorted(scans, key=lambda one: -one.evidence)[:number]


def _scales(white: np.ndarray, linear: LinearFlight) -> np.ndarray:
    """Return the robust scale of the whitened residuals of each channel, (13,)."""
    rows = white[linear.valid]
    scales = np.median(np.abs(rows), axis=0) / 0.6745
    scales[~linear.channels] = 1.0
    return np.asarray(scales)


def scan_effects(linear: LinearFlight, solution: Solution, chance: float) -> list[_Scan]:
    """Return for every effect its best onset in the linear search."""
    columns = linear.effect_columns(solution.fit, solution.active, solution.base)
    nuisance = solution.columns
    rows = nuisance.shape[0]
    limited = np.clip(solution.white, -5.0, 5.0)
    A = nuisance.reshape(-1, nuisance.shape[2])
    H = A.T @ A + solution.precision
    active = _active_columns(linear, solution)
    gradient = np.einsum("ncp,nc->p", nuisance, limited)
    if active is not None:
        full = np.concatenate([nuisance, active], axis=2)
        A = full.reshape(-1, full.shape[2])
        precision = np.zeros((full.shape[2],) * 2)
        precision[: len(H), : len(H)] = solution.precision
        H, nuisance = A.T @ A + precision + 1e-9 * np.eye(full.shape[2]), full
        gradient = np.einsum("ncp,nc->p", nuisance, limited)
    inverse = np.linalg.inv(H)
    valid_t = linear.t[linear.valid]
    grid = np.arange(valid_t[0] + _MARGIN_S, valid_t[-1] - _MARGIN_S, _ONSET_STEP_S)
    starts = np.searchsorted(linear.t, grid)
    out = []
    for one in linear.catalogue:
        white = linear.whitened(np.stack([columns[name] for name in one.coordinates], axis=2))
        with_nuisance = _tails(np.einsum("ncm,ncp->nmp", white, nuisance))
        with_residual = _tails(np.einsum("ncm,nc->nm", white, limited))
        with_self = _tails(np.einsum("ncm,nck->nmk", white, white))
        onsets: list[tuple[float | None, int]] = list(zip(grid.tolist(), starts.tolist(), strict=True))
        if any(kind.value == "always" for kind in one.effect.onsets):
            onsets = [(None, 0), *onsets]
        best: _Scan | None = None
        for onset, row in onsets:
            cross = with_nuisance[min(row, rows - 1)]
            b = with_residual[min(row, rows - 1)] - cross @ inverse @ gradient
            information = with_self[min(row, rows - 1)] - cross @ inverse @ cross.T
            found = _scored(one, onset, b, information, chance, len(grid))
            if found is not None and (best is None or found.evidence > best.evidence):
                best = found
        if best is not None:
            out.append(best)
    return out


def _active_columns(linear: LinearFlight, solution: Solution) -> np.ndarray | None:
    from twin_worker.diagnosis.multirotor.linearise import _effect_derivatives

    if not solution.active:
        return None
    return _effect_derivatives(linear, solution.fit, solution.active, solution.base)


def _tails(x: np.ndarray) -> np.ndarray:
    """Return the sums from each row to the end."""
    return np.asarray(np.cumsum(x[::-1], axis=0)[::-1])


def _scored(
    one: RotorEffect, onset: float | None, b: np.ndarray, information: np.ndarray, chance: float, n_onsets: int
) -> _Scan | None:
    """Return the score of one onset; None where the value has the wrong sign or no information."""
    precision = np.eye(len(b)) / one.scale**2
    try:
        values = -np.linalg.solve(information + chance * precision, b)
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(values).all() or (values < one.low).any():
        return None
    gain = float(-b @ values)
    return _Scan(one, onset, values, gain, _evidence(one, onset, gain, information, chance, n_onsets))


def _evidence(
    one: RotorEffect, onset: float | None, gain: float, information: np.ndarray, chance: float, n_onsets: int
) -> float:
    precision = np.eye(len(information)) / one.scale**2
    ratio = np.eye(len(information)) + np.linalg.solve(precision, information / chance)
    occam = 0.5 * float(np.linalg.slogdet(ratio)[1])
    return gain / (2 * (chance + _MODEL_ERROR * gain / 100)) - occam - np.log(2.0 if onset is None else 2.0 * n_onsets)


def _refined(
    linear: LinearFlight,
    baseline: RotorBaseline,
    none: Solution,
    active: tuple[ActiveEffect, ...],
    scan: _Scan,
) -> Explanation:
    """Fit a set of effects by Gauss-Newton, with the onset of the last one moved to its best time."""
    trial = (*active, ActiveEffect(scan.one, scan.onset, scan.values))
    start = none.fit
    solution = solve(linear, baseline.parameters, baseline.spread, start, trial, iterations=3)
    if scan.onset is not None:
        solution = _with_onset(linear, baseline, solution)
    gain = max(none.cost - solution.cost, 0.0)
    n_onsets = max(int((linear.t[-1] - 2 * _MARGIN_S) / _ONSET_STEP_S), 2)
    evidence, k = 0.0, 0
    for one in solution.active:
        m = len(one.values)
        covariance = solution.covariance[k : k + m, k : k + m]
        precision = np.eye(m) / one.one.scale**2
        information = np.linalg.inv(covariance) - precision
        evidence += _evidence(one.one, one.onset, 0.0, information, baseline.chance, n_onsets)
        k += m
    penalty = sum(float((one.values**2).sum()) / one.one.scale**2 for one in solution.active)
    evidence += gain / (2 * baseline.chance) - 0.5 * penalty
    return Explanation(solution.active, evidence, solution, gain)


def _with_onset(linear: LinearFlight, baseline: RotorBaseline, solution: Solution) -> Solution:
    """Move the onset of the last effect on a finer grid, with the other unknowns held, then fit again."""
    last = solution.active[-1]
    assert last.onset is not None
    best, cost = last.onset, np.inf
    for onset in last.onset + np.arange(-3.0, 3.01, 0.5):
        moved = (*solution.active[:-1], replace(last, onset=float(onset)))
        trial = huber(linear.whitened(linear.residuals(solution.fit, moved)))
        if trial < cost:
            best, cost = float(onset), trial
    moved = (*solution.active[:-1], replace(last, onset=best))
    return solve(linear, baseline.parameters, baseline.spread, solution.fit, moved, iterations=2)


def block_squares(white: np.ndarray, linear: LinearFlight) -> np.ndarray:
    """Return the mean square of the whitened residuals over blocks of 10 s, (blocks, 13); nan without valid rows."""
    n = round(_BLOCK_S / STEP_S)
    blocks = []
    for begin in range(0, len(white), n):
        rows = slice(begin, begin + n)
        good = linear.valid[rows]
        enough = good.sum() > n // 2
        blocks.append((white[rows][good] ** 2).mean(axis=0) if enough else np.full(len(CHANNELS), np.nan))
    return np.array(blocks)


def nominal_gains(flight: RotorFlight, baseline: RotorBaseline) -> tuple[float, np.ndarray]:
    """Return the mean gain of one coordinate throughout, and the largest mean square over 10 s of each channel."""
    linear = LinearFlight(flight, baseline.noise)
    start = linear.start(baseline.parameters)
    none = solve(linear, baseline.parameters, baseline.spread, start, iterations=4)
    linear.weights = np.maximum(_scales(none.white, linear), 1.0)
    none = solve(linear, baseline.parameters, baseline.spread, none.fit, iterations=1)
    scans = scan_effects(linear, none, 1.0)
    gains = [scan.gain / len(scan.one.coordinates) for scan in scans]
    expected = 2 * np.log(1 + linear.t[-1] / _ONSET_STEP_S) / 2  # of the best of many onsets, roughly
    return float(np.mean(gains) / expected), np.nanmax(block_squares(none.white, linear), axis=0)
