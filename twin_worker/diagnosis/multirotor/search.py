"""Search of effects and onsets: gains with nuisances eliminated, evidence, sets of up to two effects.

The gain of an effect with onset t0 is the drop of the penalised sum of squares. Its columns begin at t0, and their
products with the nuisances follow for all onsets from cumulative sums. With a Gaussian prior of precision P for m
coordinates and information H,

    log evidence = G' / (2 T) + log|P| / 2 - log|H + P| / 2 - log(number of onsets)   relative to no effect,

where G' is the gain beyond that of this effect on nominal flights that are left out, and T the median over the effects
of that gain over the one in white noise, at least 1.

Source: MacKay 2003, ch. 28 (Laplace's method, Occam factor).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fleet.effects import Onset
from twin_worker.diagnosis.multirotor.baseline import RotorBaseline
from twin_worker.diagnosis.multirotor.effects import RotorEffect
from twin_worker.diagnosis.multirotor.flight import RotorFlight
from twin_worker.diagnosis.multirotor.linearise import (
    ActiveEffect,
    FlightSolution,
    LinearFlight,
    effect_derivatives,
    huber,
    solve,
)
from twin_worker.diagnosis.multirotor.model import CHANNELS, STEP_S

_ONSET_STEP_S = 2.0
_ONSET_GRIDS = (np.arange(-3.0, 3.01, 0.5), np.arange(-0.4, 0.41, 0.1))  # around the best onset so far [s]
_MARGIN_S = 8.0  # of onsets from the ends of the flight
_BLOCK_S = 20.0
_NOMINAL_SIGMAS = 2.0  # standard deviations within which an effect occurs on nominal flights
_QUIETER = 0.9  # noise with the best explanation over that without, below which the search is repeated
_ITERATIONS = 10  # at most: rows beyond the limit of Huber's function enter one after the other
_REFINED, _EXTENDED = 4, 2  # single effects that are refined; of them, extended by a second one
_PRIOR_NONE, _PRIOR_SINGLE, _PRIOR_PAIR = 0.6, 0.3, 0.1


@dataclass(frozen=True)
class EffectSet:
    """A set of effects with its log evidence relative to none, prior included."""

    active: tuple[ActiveEffect, ...]
    evidence: float
    solution: FlightSolution
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


def search(linear: LinearFlight, baseline: RotorBaseline) -> list[EffectSet]:
    """Return the explanations of a flight, best first; one of them is none.

    The noise of each channel in this flight is that of nominal flights or larger. It is taken from the residuals
    without effects, and again from those of the best explanation.
    """
    start = linear.start(baseline.parameters)
    linear.weights = np.ones(len(CHANNELS))
    none = solve(linear, baseline.parameters, baseline.spread, start, iterations=4)
    scales = channel_scales(none.white, linear)
    none = _reweighted(linear, baseline, none, scales)
    explanations = _explanations(linear, baseline, none)
    best = explanations[0]
    quieter = np.maximum(linear.weights * channel_scales(best.solution.white, linear), 1.0)
    if best.active and (quieter < _QUIETER * linear.weights).any():
        none = _reweighted(linear, baseline, none, quieter)
        explanations = _explanations(linear, baseline, none)
    return explanations


def _explanations(linear: LinearFlight, baseline: RotorBaseline, none: FlightSolution) -> list[EffectSet]:
    n = len(linear.catalogue)
    explanations = [EffectSet((), np.log(_PRIOR_NONE), none, 0.0)]
    nothing = EffectSet((), 0.0, none, 0.0)
    singles = []
    for scan in _best(scan_effects(linear, none, baseline), _REFINED):
        fitted = _refined(linear, baseline, nothing, scan)
        singles.append(replace(fitted, evidence=fitted.evidence + np.log(_PRIOR_SINGLE / n)))
    singles.sort(key=lambda one: -one.evidence)
    for single in [one for one in singles if one.evidence > explanations[0].evidence][:_EXTENDED]:
        used = {one.one.label for one in single.active}
        used |= {one.names[0] for one in singles if one.evidence > single.evidence}  # extended by this one already
        scans = [s for s in scan_effects(linear, single.solution, baseline) if s.one.label not in used]
        for scan in _best(scans, 2):
            fitted = _refined(linear, baseline, single, scan)
            explanations.append(replace(fitted, evidence=fitted.evidence + np.log(_PRIOR_PAIR / _PRIOR_SINGLE / n)))
    return sorted(explanations + singles, key=lambda one: -one.evidence)


def _best(scans: Sequence[_Scan], number: int) -> list[_Scan]:
    """Return the best onsets, at most one for each effect and place."""
    return sorted(scans, key=lambda one: -one.evidence)[:number]


def channel_scales(white: np.ndarray, linear: LinearFlight) -> np.ndarray:
    """Return the robust scale of the whitened residuals of each channel, (13,); 1 where a channel is absent."""
    scales = np.median(np.abs(white[linear.valid]), axis=0) / 0.6745
    return np.asarray(np.where(linear.channels, scales, 1.0))


def block_scales(white: np.ndarray, linear: LinearFlight) -> tuple[np.ndarray, np.ndarray]:
    """Return the robust scale of each channel over blocks of 20 s, (b, 13), nan without rows, and their limits [s]."""
    n = round(_BLOCK_S / STEP_S)
    blocks = []
    edges = np.arange(0, len(white), n)
    for begin in edges:
        rows = white[begin : begin + n][linear.valid[begin : begin + n]]
        enough = len(rows) > n // 2
        scale = linear.weights * np.median(np.abs(rows), axis=0) / 0.6745 if enough else np.full(len(CHANNELS), np.nan)
        blocks.append(scale)
    return np.array(blocks), np.append(linear.t[edges], linear.t[-1])


def _reweighted(
    linear: LinearFlight, baseline: RotorBaseline, solution: FlightSolution, scales: np.ndarray
) -> FlightSolution:
    """Fit again with larger noise of each channel, (13,), and the same derivatives."""
    weights = np.maximum(scales, 1.0)
    columns = solution.columns * (linear.weights / weights)[:, None]
    linear.weights = weights
    again = replace(solution, columns=columns, active=())
    return solve(linear, baseline.parameters, baseline.spread, again, iterations=4)


def scan_effects(linear: LinearFlight, solution: FlightSolution, baseline: RotorBaseline) -> list[_Scan]:
    """Return for every effect its best onset in the linear search."""
    columns = linear.effect_columns(solution.fit, solution.active, solution.base)
    nuisance = solution.columns
    rows = nuisance.shape[0]
    limited = np.clip(solution.white, -5.0, 5.0)
    A = nuisance.reshape(-1, nuisance.shape[2])
    H = A.T @ A + solution.precision
    active = _active_columns(linear, solution)
    pull = solution.precision @ linear.vector(solution.fit, baseline.parameters)
    if active is not None:
        full = np.concatenate([nuisance, active], axis=2)
        A = full.reshape(-1, full.shape[2])
        precision = np.zeros((full.shape[2],) * 2)
        precision[: len(H), : len(H)] = solution.precision
        scales = np.array([one.one.scale for one in solution.active for _ in one.values])
        values = np.concatenate([one.values for one in solution.active])
        precision[len(H) :, len(H) :] = np.diag(scales**-2.0)
        H, nuisance, pull = A.T @ A + precision, full, np.concatenate([pull, values / scales**2])
    gradient = np.einsum("ncp,nc->p", nuisance, limited) + pull
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
            fitted = _scored(one, onset, b, information, baseline, n_onsets=len(grid))
            if fitted is not None and (best is None or fitted.evidence > best.evidence):
                best = fitted
        if best is not None:
            out.append(best)
    return out


def _active_columns(linear: LinearFlight, solution: FlightSolution) -> np.ndarray | None:
    if not solution.active:
        return None
    return effect_derivatives(linear, solution.fit, solution.active, solution.base)


def _tails(x: np.ndarray) -> np.ndarray:
    """Return the sums from each row to the end."""
    return np.asarray(np.cumsum(x[::-1], axis=0)[::-1])


def _scored(
    one: RotorEffect,
    onset: float | None,
    b: np.ndarray,
    information: np.ndarray,
    baseline: RotorBaseline,
    *,
    n_onsets: int,
) -> _Scan | None:
    """Return the score of one onset; None where the value has the wrong sign or no information."""
    precision = np.eye(len(b)) / one.scale**2
    try:
        values = -np.linalg.solve(information + precision, b)
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(values).all() or (values < one.low).any():
        return None
    gain = float(-b @ values)
    active = ActiveEffect(one, onset, values)
    return _Scan(one, onset, values, gain, _evidence(active, gain, information, baseline, n_onsets))


def _evidence(
    active: ActiveEffect, gain: float, information: np.ndarray, baseline: RotorBaseline, n_onsets: int
) -> float:
    """Return the log evidence of one effect beyond what nominal flights show of it.

    G' = G - max(2 c ln n, k^2 s^2 / |x|^2 G)   with the standard deviation s of such values on nominal flights, k = 2
    """
    one = active.one
    chance, nominal = baseline.chance.get(one.group, 1.0), baseline.sizes.get(one.group, 0.0)
    if Onset.ALWAYS in one.effect.onsets:  # of others a constant value is nominal, but no step
        nominal = float(np.hypot(nominal, one.nominal))
    square = max(float(active.values @ active.values), 1e-12)
    usual = max(2 * chance * float(np.log(n_onsets)), gain * (_NOMINAL_SIGMAS * nominal) ** 2 / square)
    precision = np.eye(len(information)) / active.one.scale**2
    ratio = np.eye(len(information)) + np.linalg.solve(precision, information)
    occam = 0.5 * float(np.linalg.slogdet(ratio)[1])
    return (
        (gain - usual) / (2 * baseline.temper) - occam - float(np.log(2.0 if active.onset is None else 2.0 * n_onsets))
    )


def _refined(linear: LinearFlight, baseline: RotorBaseline, before: EffectSet, scan: _Scan) -> EffectSet:
    """Add an effect to an explanation and fit all by Gauss-Newton, with its onset moved to the best time."""
    trial = (*before.active, ActiveEffect(scan.one, scan.onset, scan.values))
    start = before.solution if before.active else before.solution.fit  # a first effect changes the derivatives
    solution = solve(linear, baseline.parameters, baseline.spread, start, trial, iterations=_ITERATIONS)
    if scan.onset is not None:
        solution = _with_onset(linear, baseline, solution)
    gain = max(before.solution.cost - solution.cost, 0.0)
    n_onsets = max(int((linear.t[-1] - 2 * _MARGIN_S) / _ONSET_STEP_S), 2)
    last = solution.active[-1]
    m = len(last.values)
    information = np.linalg.inv(solution.covariance[-m:, -m:]) - np.eye(m) / last.one.scale**2
    penalty = float((last.values**2).sum()) / last.one.scale**2
    evidence = _evidence(last, gain, information, baseline, n_onsets) - 0.5 * penalty
    return EffectSet(solution.active, before.evidence + evidence, solution, before.gain + gain)


def _with_onset(linear: LinearFlight, baseline: RotorBaseline, solution: FlightSolution) -> FlightSolution:
    """Move the onset of the last effect on a finer grid, with the other unknowns held, then fit again."""
    last = solution.active[-1]
    assert last.onset is not None
    best = last.onset
    for steps in _ONSET_GRIDS:
        costs = []
        for onset in best + steps:
            moved = (*solution.active[:-1], replace(last, onset=float(onset)))
            costs.append(huber(linear.whitened(linear.residuals(solution.fit, moved))))
        best = float(best + steps[int(np.argmin(costs))])
    moved = (*solution.active[:-1], replace(last, onset=best))
    return solve(linear, baseline.parameters, baseline.spread, solution, moved, iterations=_ITERATIONS)


def nominal_gains(
    flight: RotorFlight, baseline: RotorBaseline
) -> tuple[dict[str, float], dict[str, float], np.ndarray]:
    """Return the gain of each group over that of chance, its size, and the scale of each channel by block, (b, 13).

    The best of n onsets gains about 2 ln n by chance.
    """
    linear = LinearFlight(flight, baseline.noise)
    start = linear.start(baseline.parameters)
    none = solve(linear, baseline.parameters, baseline.spread, start, iterations=4)
    scales = channel_scales(none.white, linear)
    none = _reweighted(linear, baseline, none, scales)
    expected = float(2 * np.log(max(linear.t[-1] / _ONSET_STEP_S, 3.0)))
    gains: dict[str, float] = {}
    sizes: dict[str, float] = {}
    for scan in scan_effects(linear, none, baseline):
        group = scan.one.group
        gains[group] = max(gains.get(group, 0.0), scan.gain / len(scan.one.coordinates) / expected)
        sizes[group] = max(sizes.get(group, 0.0), float(np.linalg.norm(scan.values)))
    return gains, sizes, block_scales(none.white, linear)[0]
