"""Cross-validation: fit effects on even blocks of 10 s, evaluate them on odd blocks; and the part left unexplained."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from fleet.effects import Onset, Stage
from twin_worker.diagnosis.data.card import FaultHypothesis
from twin_worker.diagnosis.inference.isolation.block_means import BlockMeans
from twin_worker.diagnosis.inference.isolation.evidence import Weights
from twin_worker.diagnosis.inference.isolation.refine import refine
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals
from twin_worker.diagnosis.inference.validation.force_prediction import BLOCK_S, blocks
from twin_worker.diagnosis.model.residual import ModelledFlight

MIN_RMS_DROP = 0.03  # least relative drop of the held-out rms residual for a named effect
_JUMP_S = 2.0  # a sensor jump is visible within this time of its onset
_SHORT_S, _MIN_GATE = 2.0, 0.01  # block length for transient effects; least gate value at which they act
MIN_CHANNEL_RATIO = 1.15  # least ratio of mean square to usual of a channel that takes part
_MAX_REMAINING = 0.95  # or largest share of the mean square that remains on the blocks of the fit


@dataclass(frozen=True)
class CrossValidation:
    """Held-out evidence.

    Attributes:
        before, after: whitened rms on odd blocks without and with the effects, in the affected channels
        fitted: the effects as fitted on even blocks
        held_out_gains: gain of each effect on odd blocks given the others, doubled to compare with the whole flight
        evidence: log evidence of each effect given the others in each odd block in which it acts [nat]
    """

    before: float
    after: float
    fitted: tuple[FaultHypothesis, ...]
    held_out_gains: tuple[float, ...]
    evidence: tuple[tuple[float, ...], ...] = ()

    def probability(self, index: int) -> float:
        """Return the probability of an effect against none from the held-out blocks alone, at equal prior odds."""
        return float(expit(sum(self.evidence[index])))

    @property
    def rms_drop(self) -> float:
        """Return the relative drop of the rms residual."""
        return 1.0 - self.after / self.before if self.before > 0 else 0.0


def fit_and_validate(
    whitened: WhitenedResiduals,
    hypotheses: tuple[FaultHypothesis, ...],
    channel_ratio: np.ndarray,
    means: BlockMeans,
    weights: Weights,
) -> CrossValidation:
    """Fit the effects on even blocks and evaluate them on odd blocks.

    Args:
        whitened: residuals conditioned on the weather alone; not modified
        hypotheses: as fitted on the whole flight
        channel_ratio: mean square of each channel over its usual, (c,)
        means: block means of the flight
        weights: of the evidence
    """
    weather = whitened.conditions
    even, odd = (whitened.part(_half_rows(whitened, hypotheses, odd=side)) for side in (False, True))
    fitted = list(hypotheses)
    for _ in range(1 + (len(hypotheses) > 1)):
        for i, hypothesis in enumerate(fitted):
            even.condition_on((*weather, *(g for k, g in enumerate(fitted) if k != i)))
            fitted[i] = refine(even, hypothesis, iterations=3, move_onset=False).hypothesis
    even.condition_on(weather)
    unexplained = _mean_squares(even)
    even.condition_on((*weather, *fitted))
    used = (channel_ratio > MIN_CHANNEL_RATIO) | (_mean_squares(even) < _MAX_REMAINING * unexplained)
    used = used if used.any() else np.ones_like(used)
    cost = odd.cost(fitted)
    held_out_gains = tuple(
        2.0 * (odd.cost([g for k, g in enumerate(fitted) if k != i]) - cost) for i in range(len(fitted))
    )
    before = _rms(odd, used)
    transient = _is_transient(hypotheses)
    labels = np.floor(whitened.modelled.t / (_SHORT_S if transient else BLOCK_S)).astype(int)

    def block_costs(acting: Sequence[FaultHypothesis]) -> np.ndarray:
        """Return the negative log likelihood of each block of odd rows, with nuisances of the even rows, (b,)."""
        even.condition_on((*weather, *acting))
        odd.condition_on((*weather, *acting))
        e = (odd.e + odd.Jn @ even.xn) * odd.ok[:, None]
        out = np.bincount(labels - labels[0], (e * e).sum(axis=1)) / (2.0 * weights.rows_per_sample)
        return out if transient else out + 0.5 * weights.block_weight * means.squares(acting, even.xn)

    with_all = block_costs(fitted)
    evidence = []
    for i, hypothesis in enumerate(fitted):
        others = [g for k, g in enumerate(fitted) if k != i]
        acts = odd.ok & (hypothesis.onset.gate(whitened.modelled.t) > _MIN_GATE)
        gain = block_costs(others) - with_all
        evidence.append(tuple(gain[np.unique(labels[acts]) - labels[0]].tolist()))
    even.condition_on((*weather, *fitted))
    odd.condition_on((*weather, *fitted))
    return CrossValidation(before, _rms(odd, used), tuple(fitted), held_out_gains, tuple(evidence))


def _is_transient(hypotheses: Sequence[FaultHypothesis]) -> bool:
    return all(hypothesis.onset.kind is Onset.BUMP for hypothesis in hypotheses)


def _half_rows(whitened: WhitenedResiduals, hypotheses: tuple[FaultHypothesis, ...], odd: bool) -> np.ndarray:
    """Return the rows of one half, (n,) bool.

    Transient effects use shorter blocks while they act. Sensor jumps use every second row around the onset, because
    slow noise hides them elsewhere.
    """
    t = whitened.modelled.t
    if _is_transient(hypotheses):
        passing = np.any([hypothesis.onset.gate(t) > _MIN_GATE for hypothesis in hypotheses], axis=0)
        return passing & ((np.floor(t / _SHORT_S) % 2 == 1) == odd)
    jumps = [g.onset.t0 for g in hypotheses if g.effect.stage is Stage.SENSOR and g.onset.kind is Onset.STEP]
    near = np.any([np.abs(t - t0) < _JUMP_S for t0 in jumps], axis=0) if jumps else np.zeros(len(t), bool)
    return np.where(near, (np.arange(len(t)) % 2 == 1) == odd, blocks(t, odd=odd))


def _mean_squares(whitened: WhitenedResiduals) -> np.ndarray:
    """Return the mean square of each channel, the nuisances profiled out, (c,)."""
    e = (whitened.e + whitened.Jn @ whitened.xn)[whitened.ok]
    return (e**2).mean(axis=0) if e.size else np.zeros(e.shape[1])


def _rms(whitened: WhitenedResiduals, used: np.ndarray) -> float:
    return float(np.sqrt(_mean_squares(whitened)[used].mean()))


_MIN_LEVEL = 2.0  # rms over 5 s from which a segment is listed [standard deviations]
_WINDOW = 25  # rows of 5 s
_TERMS = 2  # of the free-form fit


def high_segments(t: np.ndarray, e: np.ndarray, ok: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Return the segments where the rms of a whitened residual, (n,), is high [s]."""
    power = np.where(ok, np.nan_to_num(e) ** 2, 0.0)
    weight = np.convolve(ok.astype(float), np.ones(_WINDOW), "same")
    level = np.sqrt(np.convolve(power, np.ones(_WINDOW), "same") / np.maximum(weight, 1.0))
    exceeds = np.concatenate([[False], level > min(_MIN_LEVEL, 0.9 * level.max()), [False]])
    edges = np.flatnonzero(np.diff(exceeds.astype(int)))
    return tuple((float(t[a]), float(t[min(b, len(t) - 1)])) for a, b in zip(edges[::2], edges[1::2], strict=True))


def free_form(modelled: ModelledFlight, weather: tuple[FaultHypothesis, ...], channel: int) -> dict[str, float]:
    """Fit the residual of a channel by the library terms that explain most, `term -> coefficient`.

    Source: Brunton, Proctor & Kutz 2016 (sparse regression), here by orthogonal matching pursuit.
    """
    flow = modelled.equation_terms(weather).flow
    y = modelled.residuals(weather)[modelled.ok, channel]
    d_a, d_e, d_r, d_t = modelled.inputs(weather)
    library = {
        "1": np.ones_like(flow.Va),
        "Va": flow.Va / modelled.base.speed,
        "alpha": flow.alpha,
        "beta": flow.beta,
        "|beta|": np.abs(flow.beta),
        "p": flow.p,
        "q": flow.q,
        "r": flow.r,
        "delta_a": d_a,
        "delta_e": d_e,
        "delta_r": d_r,
        "delta_t": d_t,
        "height": flow.height / 100.0,
    }
    columns = {name: x[modelled.ok] for name, x in library.items()}
    chosen: list[str] = []
    remainder = y
    for _ in range(_TERMS):
        correlation = {
            n: abs(x @ remainder) / (np.linalg.norm(x) + 1e-12) for n, x in columns.items() if n not in chosen
        }
        chosen.append(max(correlation, key=lambda name: correlation[name]))
        A = np.stack([columns[name] for name in chosen], axis=1)
        coefficients = np.linalg.lstsq(A, y, rcond=None)[0]
        remainder = y - A @ coefficients
    return {name: float(x) for name, x in zip(chosen, coefficients, strict=True)}
