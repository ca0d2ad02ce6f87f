"""Change-point posterior of one effect: the probability of every onset of a grid, steps and ramps.

    p(onset) ~ exp(G(onset) / (2 T_0) - nats_o k_o) / number of onsets of its kind

with G the gain of the fitted change of the residuals, its size free, behind this onset, T_0 the whitened rows per
independent sample, and k_o the number of parameters of the onset.
Source: Barry & Hartigan 1993 (Bayesian change points).
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fleet.effects import Onset
from twin_worker.diagnosis.data.card import ALWAYS, FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.inference.isolation.evidence import Weights
from twin_worker.diagnosis.inference.isolation.isolate import normal_equations, onset_gates, solve_onsets
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals

_LEVELS = 0.025, 0.975
_LASTING = (Onset.STEP, Onset.RAMP)


class OnsetPosterior(NamedTuple):
    """Onsets, their probabilities, (m,), the most probable one of the most probable kind, and its 95 % interval [s]."""

    onsets: list[OnsetProfile]
    probability: np.ndarray
    mode: OnsetProfile
    interval: tuple[float, float]


def onset_posterior(
    whitened: WhitenedResiduals, hypothesis: FaultHypothesis, weights: Weights
) -> OnsetPosterior | None:
    """Return the posterior over the lasting onsets of an effect; None where it has none.

    Args:
        whitened: residuals conditioned on the other effects
        hypothesis: as fitted
        weights: of the evidence
    """
    change = whitened.residuals((replace(hypothesis, onset=ALWAYS),)) - whitened.raw
    kinds = [kind for kind in _LASTING if kind in hypothesis.effect.onsets]
    onsets: list[OnsetProfile] = []
    log_p: list[np.ndarray] = []
    for kind in kinds:
        gates, tested = onset_gates(whitened.modelled.t, kind, 1)
        if len(gates):
            gain, _ = solve_onsets(whitened, *normal_equations(whitened, change[:, :, None], gates, kind))
            nats = weights.nats_per_onset * tested[0].n_parameters + np.log(len(tested))
            log_p.append(np.nan_to_num(gain) / (2.0 * weights.rows_per_sample) - nats)
            onsets += tested
    if not onsets:
        return None
    x = np.concatenate(log_p)
    probability = np.exp(x - x.max())
    probability /= probability.sum()
    t0 = np.array([onset.t0 for onset in onsets])
    order = np.argsort(t0)
    rows = np.minimum(np.searchsorted(np.cumsum(probability[order]), _LEVELS), len(t0) - 1)
    low, high = t0[order][rows].tolist()
    is_step = np.array([onset.kind is Onset.STEP for onset in onsets])
    own_kind = is_step == (probability[is_step].sum() > 0.5)  # one ramp stands for many steps: the sums decide
    return OnsetPosterior(onsets, probability, onsets[int(np.argmax(probability * own_kind))], (low, high))
