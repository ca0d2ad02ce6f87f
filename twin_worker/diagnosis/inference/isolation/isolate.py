"""Scan all effects, targets and onsets; one whitened Jacobian per effect and target serves all onsets."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

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
_N_GATES = 5  # sets of gates stored: those of one flight
_RAMPS_S = (20.0, 40.0, 60.0, 90.0, 130.0)
BUMPS_S = (3.0, 5.0, 8.0, 14.0, 25.0, 45.0)


@dataclass(frozen=True)
class ScoredHypothesis:
    """A hypothesis, its gain (decrease of the whitened sum of squares), and hypotheses of equal explanatory power."""

    gain: float
    hypothesis: FaultHypothesis
    rivals: tuple["ScoredHypothesis", ...] = ()  # best first
    onset_interval: tuple[float, float] | None = None  # 95 % interval of the onset [s]

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
    return Scanner(whitened).scan(whitened)


class _StepsOf(NamedTuple):
    """One kind of onset of one effect: gates and profiles of the tested onsets, and inverse normal matrices."""

    kind: Onset
    gates: np.ndarray
    onsets: list[OnsetProfile]
    inverse: np.ndarray


class _Slopes(NamedTuple):
    """Whitened slopes of one effect, (n, c, k), scaled; those of the first rows of a step, and the kinds of onset."""

    zero: FaultHypothesis
    scale: np.ndarray
    J: np.ndarray
    onset_slopes: np.ndarray | None
    kinds: list[_StepsOf]


class _Starts(NamedTuple):
    """Whitened change of the residuals, (n, c), under each start value of an effect without a slope at zero."""

    hypotheses: list[FaultHypothesis]
    changes: list[np.ndarray]


class Scanner:
    """Scan of all effects, targets and onsets, with slopes computed once and used for every set of conditions.

    Args:
        whitened: residuals without any effect
        effects: effects with their targets; by default all of the catalogue that the calibration covers
    """

    def __init__(self, whitened: WhitenedResiduals, effects: Iterable[tuple[Effect, str]] | None = None) -> None:
        self._slopes: list[_Slopes] = []
        self._starts: list[_Starts] = []
        for effect, target in candidates(whitened) if effects is None else effects:
            if effect.initial_guesses:
                starts = [FaultHypothesis(effect, target, start) for start in effect.initial_guesses]
                reference = whitened.residuals(())
                self._starts.append(_Starts(starts, [whitened.residuals((one,)) - reference for one in starts]))
            elif (slopes := _prepare_slopes(whitened, effect, target)) is not None:
                self._slopes.append(slopes)

    def scan(self, whitened: WhitenedResiduals) -> list[ScoredHypothesis]:
        """Return the best hypothesis of every effect, target and kind of onset, best first."""
        profiled = whitened.e + whitened.Jn @ whitened.xn
        out = []
        for slopes in self._slopes:
            score = -(np.swapaxes(slopes.J, 1, 2) @ profiled[..., None])[..., 0]
            for steps in slopes.kinds:
                b = _onset_sums(score, steps.gates, steps.kind)
                if steps.kind is Onset.STEP and slopes.onset_slopes is not None:
                    for offset, new in enumerate(slopes.onset_slopes):
                        i = steps.gates + offset
                        b = b - np.einsum("mci,mc->mi", new[i] - slopes.J[i], profiled[i])
                x = (steps.inverse @ b[..., None])[..., 0]
                gain = np.nan_to_num((b * x).sum(axis=1))  # an effect that the flight does not excite has no gain
                best = int(np.argmax(gain))
                fitted = slopes.zero.with_parameters(x[best] / slopes.scale, steps.onsets[best])
                out.append(ScoredHypothesis(float(gain[best]), fitted))
        for starts in self._starts:
            out += _scan_starts(whitened, starts)
        return sorted(out, key=lambda scored: -scored.net_gain)


def candidates(whitened: WhitenedResiduals) -> Iterator[tuple[Effect, str]]:
    """Yield every effect and target that the calibration covers, except effects on the variance alone."""
    for effect in catalogue().values():
        if not effect.variance:
            for target in effect.targets or ("",):
                if covered(whitened.base, effect, target):
                    yield effect, target


def covered(base: Baseline, effect: Effect, target: str) -> bool:
    """Return whether the surface and the equation that an effect acts on are sufficiently calibrated."""
    if effect.channel in ("gyro", "imu"):
        return base.vane  # an estimator's rates and velocity no longer contain the fault
    if target in base.undetermined:
        return False
    equation = _SURFACE.get(target) or _SHOWS_IN.get(effect.channel)
    return equation is None or base.r2.get(equation, 1.0) > MIN_R2


def _prepare_slopes(whitened: WhitenedResiduals, effect: Effect, target: str) -> _Slopes | None:
    """Return the slopes of an effect at zero, or None if the flight does not show it."""
    step = np.array([p.step for p in effect.parameters])
    zero = FaultHypothesis(effect, target, (0.0,) * effect.n_parameters)
    raw_slopes = whitened.residual_slopes(zero, step)
    J = whitened.whiten_slopes(raw_slopes)
    scale = np.sqrt((J**2).sum(axis=(0, 1)))
    if not (scale > 1e-9).all():
        return None
    J = J / scale
    # a force derived from the velocity does not resolve the first rows
    by_row = whitened.base.vane and Onset.STEP in effect.onsets
    onset_slopes = whitened.whiten_onset_slopes(raw_slopes) / scale if by_row else None
    products = row_products(whitened, J)
    kinds = []
    for kind in effect.onsets:
        gates, onsets = onset_gates(whitened.modelled.t, kind, 1 if by_row else _ONSET_STRIDE)
        if not len(gates):
            continue
        sums = sum_products(products, gates, kind)
        if kind is Onset.STEP and onset_slopes is not None:
            sums = with_onset_slopes(whitened, J, onset_slopes, gates, sums)
        kinds.append(_StepsOf(kind, gates, onsets, np.linalg.inv(_profiled_matrix(whitened, sums[0], sums[2]))))
    return _Slopes(zero, scale, J, onset_slopes, kinds)


def onset_gates(t: np.ndarray, kind: Onset, stride: int = _ONSET_STRIDE) -> tuple[np.ndarray, list[OnsetProfile]]:
    """Return the gates (m, n) to test and their onset profiles; for steps, rows (m,), `stride` apart, replace gates.

    Both are shared between calls and must not be modified.
    """
    return _onset_gates(t.tobytes(), kind, stride if kind is Onset.STEP else 1)


@lru_cache(maxsize=_N_GATES)
def _onset_gates(times: bytes, kind: Onset, stride: int) -> tuple[np.ndarray, list[OnsetProfile]]:
    t = np.frombuffer(times)
    first, last = t[0] + _EDGE_S[0], t[-1] - _EDGE_S[1]
    if kind is Onset.ALWAYS:
        return np.ones((1, len(t))), [ALWAYS]
    if kind is Onset.STEP:
        onset_rows = np.flatnonzero((t > first) & (t < last))[::stride]
        return onset_rows, [OnsetProfile(kind, float(t[i])) for i in onset_rows]
    lengths = _RAMPS_S if kind is Onset.RAMP else BUMPS_S
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
    return sum_products(row_products(whitened, J), gates, kind)


def row_products(whitened: WhitenedResiduals, J: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the normal equations of slopes J, (n, c, k), of each row: (n, k, k), (n, k), (n, k, nuisances)."""
    rows = np.swapaxes(J, 1, 2)
    return rows @ J, -(rows @ whitened.e[..., None])[..., 0], rows @ whitened.Jn


def sum_products(
    products: tuple[np.ndarray, np.ndarray, np.ndarray], gates: np.ndarray, kind: Onset
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sum `row_products` per onset: (m, k, k), (m, k), (m, k, nuisances)."""
    A, b, C = products
    squares = gates if kind is Onset.STEP else gates**2
    return _onset_sums(A, squares, kind), _onset_sums(b, gates, kind), _onset_sums(C, gates, kind)


def _onset_sums(x: np.ndarray, gates: np.ndarray, kind: Onset) -> np.ndarray:
    """Sum the rows of x, (n, …), under each gate, (m, …)."""
    if kind is Onset.STEP:
        return np.cumsum(x[::-1], axis=0)[::-1][gates]  # type: ignore[no-any-return]
    return (gates @ x.reshape(len(x), -1)).reshape(len(gates), *x.shape[1:])  # type: ignore[no-any-return]


def with_onset_slopes(
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
    b = b - C @ (whitened.nuisance_covariance @ whitened.bn)
    x = np.linalg.solve(_profiled_matrix(whitened, A, C), b[..., None])[..., 0]
    return (b * x).sum(axis=1), x


def _profiled_matrix(whitened: WhitenedResiduals, A: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Return the normal matrices, (m, k, k), with the nuisances free within their spread."""
    profiled = (C.reshape(-1, C.shape[2]) @ whitened.nuisance_covariance).reshape(C.shape)
    A = A - profiled @ np.swapaxes(C, 1, 2)
    trace = np.einsum("mii->m", A)
    return A + (1e-9 * trace + 1e-12)[:, None, None] * np.eye(A.shape[1])  # type: ignore[no-any-return]


def _scan_starts(whitened: WhitenedResiduals, starts: _Starts) -> list[ScoredHypothesis]:
    """Scan the start values of an effect without a slope at zero; a step gains the sum over the rows after it."""
    out: dict[Onset, ScoredHypothesis] = {}
    before = (whitened.e**2).sum(axis=1)
    t = whitened.modelled.t
    onset_rows = np.flatnonzero((t > t[0] + _EDGE_S[0]) & (t < t[-1] - _EDGE_S[1]))
    if not len(onset_rows):  # a short flight has no onset inside
        onset_rows = np.array([0])
    for hypothesis, change in zip(starts.hypotheses, starts.changes, strict=True):
        e = np.clip(whitened.raw + change, -whitened.clip, whitened.clip)
        gain = before - (e**2).sum(axis=1)
        tail_gain = np.cumsum(gain[::-1])[::-1][onset_rows]
        i = int(np.argmax(tail_gain))
        step = OnsetProfile(Onset.STEP, float(t[onset_rows[i]]))
        options = {
            Onset.ALWAYS: ScoredHypothesis(float(gain.sum()), hypothesis),
            Onset.STEP: ScoredHypothesis(float(tail_gain[i]), replace(hypothesis, onset=step)),
        }
        for kind, scored in options.items():
            if kind in hypothesis.effect.onsets and (kind not in out or scored.gain > out[kind].gain):
                out[kind] = scored
    return list(out.values())
