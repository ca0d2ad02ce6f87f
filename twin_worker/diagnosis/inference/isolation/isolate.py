"""Scan all effects, targets and onsets; one whitened Jacobian per effect and target serves all onsets."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fleet.effects import Effect, Onset, catalogue
from twin_worker.diagnosis.data.card import ALWAYS, FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals
from twin_worker.diagnosis.model.baseline import Baseline

PARAMETER_COST = 9.0  # gain that each parameter must add [-]
MIN_R2 = 0.6  # share of variance explained from which an equation counts as calibrated
_SURFACE = {"aileron": "L", "elevator": "M", "rudder": "N"}
_SHOWS_IN = {"roll": "L", "pitch": "M", "yaw": "N", "thrust": "X", "drag": "X", "lift": "alpha"}
_EDGE_S = 15.0, 20.0  # no onset closer to the start and the end of the flight [s]
_ONSET_STRIDE = 5  # rows between two tested onsets, unless the onset is resolved to the row
_RAMPS_S = (20.0, 40.0, 60.0, 90.0, 130.0)
_BUMPS_S = (3.0, 5.0, 8.0, 14.0, 25.0, 45.0)


@dataclass(frozen=True)
class ScoredHypothesis:
    """A hypothesis, its gain (decrease of the whitened sum of squares), and hypotheses of equal explanatory power."""

    gain: float
    hypothesis: FaultHypothesis
    rivals: tuple["ScoredHypothesis", ...] = ()  # best first

    @property
    def kind(self) -> str:
        """Return `label|onset kind`, the key of `Baseline.chance`."""
        return f"{self.hypothesis.label}|{self.hypothesis.onset.kind}"

    @property
    def net_gain(self) -> float:
        """Return the gain less the cost of its parameters."""
        return self.gain - PARAMETER_COST * self.hypothesis.degrees_of_freedom


def scan(whitened: WhitenedResiduals) -> list[ScoredHypothesis]:
    """Return the best hypothesis of every effect, target and kind of onset, best first."""
    out = []
    for effect, target in candidates(whitened):
        scan_effect = _scan_by_start if effect.initial_guesses else _scan_by_slope
        out += scan_effect(whitened, effect, target)
    return sorted(out, key=lambda scored: -scored.net_gain)


def candidates(whitened: WhitenedResiduals) -> Iterator[tuple[Effect, str]]:
    """Yield every effect and target that the calibration covers, except effects on the variance alone."""
    for effect in catalogue().values():
        if not effect.variance:
            for target in effect.targets or ("",):
                if covered(whitened.base, effect, target):
                    yield effect, target


def covered(base: Baseline, effect: Effect, target: str) -> bool:
    """Return whether the equation that an effect acts on is sufficiently calibrated."""
    if effect.channel in ("gyro", "imu"):
        return base.vane  # an estimator's rates and velocity no longer contain the fault
    equation = _SURFACE.get(target) or _SHOWS_IN.get(effect.channel)
    return equation is None or base.r2.get(equation, 1.0) > MIN_R2


def _scan_by_slope(whitened: WhitenedResiduals, effect: Effect, target: str) -> list[ScoredHypothesis]:
    step = np.array([p.step for p in effect.parameters])
    zero = FaultHypothesis(effect, target, (0.0,) * effect.n_parameters)
    raw_slopes = whitened.residual_slopes(zero, step)
    J = whitened.whiten_slopes(raw_slopes)
    scale = np.sqrt((J**2).sum(axis=(0, 1)))
    if not (scale > 1e-9).all():
        return []
    J = J / scale
    # a force derived from the velocity does not resolve the first rows
    by_row = whitened.base.vane and Onset.STEP in effect.onsets
    onset_slopes = whitened.whiten_onset_slopes(raw_slopes) / scale if by_row else None
    out = []
    for kind in effect.onsets:
        gates, onsets = onset_gates(whitened.modelled.t, kind, 1 if by_row else _ONSET_STRIDE)
        if not len(gates):
            continue
        sums = normal_equations(whitened, J, gates, kind)
        if kind is Onset.STEP and onset_slopes is not None:
            sums = _with_onset_slopes(whitened, J, onset_slopes, gates, sums)
        gain, x = solve_onsets(whitened, *sums)
        best = int(np.argmax(gain))
        out.append(ScoredHypothesis(float(gain[best]), zero.with_parameters(x[best] / scale, onsets[best])))
    return out


def onset_gates(t: np.ndarray, kind: Onset, stride: int = _ONSET_STRIDE) -> tuple[np.ndarray, list[OnsetProfile]]:
    """Return the gates (m, n) to test and their onset profiles; for steps, rows (m,), `stride` apart, replace gates."""
    first, last = t[0] + _EDGE_S[0], t[-1] - _EDGE_S[1]
    if kind is Onset.ALWAYS:
        return np.ones((1, len(t))), [ALWAYS]
    if kind is Onset.STEP:
        onset_rows = np.flatnonzero((t > first) & (t < last))[::stride]
        return onset_rows, [OnsetProfile(kind, float(t[i])) for i in onset_rows]
    lengths = _RAMPS_S if kind is Onset.RAMP else _BUMPS_S
    onsets = []
    for T in lengths:
        spacing = 10.0 if kind is Onset.RAMP else max(T / 6, 1.0)
        end = last - 10.0 if kind is Onset.RAMP else t[-1] - T
        onsets += [OnsetProfile(kind, float(t0), T) for t0 in np.arange(t[0] + 5.0, end, spacing)]
    return np.stack([onset.gate(t) for onset in onsets]) if onsets else np.empty((0, len(t))), onsets


def normal_equations(
    whitened: WhitenedResiduals, J: np.ndarray, gates: np.ndarray, kind: Onset
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sum the normal equations of slopes J, (n, c, k), per onset: (m, k, k), (m, k), (m, k, nuisances)."""
    rows = np.swapaxes(J, 1, 2)
    A, b, C = rows @ J, -(rows @ whitened.e[..., None])[..., 0], rows @ whitened.Jn
    if kind is Onset.STEP:
        return tuple(np.cumsum(x[::-1], axis=0)[::-1][gates] for x in (A, b, C))  # type: ignore[return-value]
    flat = [x.reshape(len(x), -1) for x in (A, b, C)]
    sums = (gates**2 @ flat[0], gates @ flat[1], gates @ flat[2])
    return tuple(s.reshape(len(gates), *x.shape[1:]) for s, x in zip(sums, (A, b, C), strict=True))  # type: ignore[return-value]


def _with_onset_slopes(
    whitened: WhitenedResiduals,
    J: np.ndarray,
    onset_slopes: np.ndarray,
    onset_rows: np.ndarray,
    sums: tuple[np.ndarray, ...],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Replace the first two rows after each step by `onset_slopes`, (2, n, c, k), which start from zero."""
    A, b, C = sums
    for offset, slopes in enumerate(onset_slopes):
        index = onset_rows + offset
        new, old, e, Jn = slopes[index], J[index], whitened.e[index], whitened.Jn[index]
        A = A + np.einsum("mci,mcj->mij", new, new) - np.einsum("mci,mcj->mij", old, old)
        b = b - np.einsum("mci,mc->mi", new - old, e)
        C = C + np.einsum("mci,mcj->mij", new - old, Jn)
    return A, b, C


def solve_onsets(
    whitened: WhitenedResiduals, A: np.ndarray, b: np.ndarray, C: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Solve for the gain (m,) and the parameters (m, k) of each onset, the nuisances free within their spread."""
    inverse = np.linalg.inv(whitened.Ann)
    A = A - C @ inverse @ np.swapaxes(C, 1, 2)
    b = b - C @ (inverse @ whitened.bn)
    k = A.shape[1]
    trace = np.einsum("mii->m", A)
    A = A + (1e-9 * trace + 1e-12)[:, None, None] * np.eye(k)
    x = np.linalg.solve(A, b[..., None])[..., 0]
    return (b * x).sum(axis=1), x


def _scan_by_start(whitened: WhitenedResiduals, effect: Effect, target: str) -> list[ScoredHypothesis]:
    """Scan the start values of an effect without a slope at zero; a step gains the sum over the rows after it."""
    out: dict[Onset, ScoredHypothesis] = {}
    before = (whitened.e**2).sum(axis=1)
    t = whitened.modelled.t
    onset_rows = np.flatnonzero((t > t[0] + _EDGE_S[0]) & (t < t[-1] - _EDGE_S[1]))
    if not len(onset_rows):  # a short flight has no onset inside
        onset_rows = np.array([0])
    for start in effect.initial_guesses:
        hypothesis = FaultHypothesis(effect, target, start)
        gain = before - (whitened.clipped((hypothesis,)) ** 2).sum(axis=1)
        tail_gain = np.cumsum(gain[::-1])[::-1][onset_rows]
        i = int(np.argmax(tail_gain))
        step = OnsetProfile(Onset.STEP, float(t[onset_rows[i]]))
        options = {
            Onset.ALWAYS: ScoredHypothesis(float(gain.sum()), hypothesis),
            Onset.STEP: ScoredHypothesis(float(tail_gain[i]), hypothesis.with_parameters(np.array(start), step)),
        }
        for kind, scored in options.items():
            if kind in effect.onsets and (kind not in out or scored.gain > out[kind].gain):
                out[kind] = scored
    return list(out.values())
