"""Log evidence of the explanations of a flight, relative to none.

An explanation is a set of up to three effects with their onsets, a change that no effect stands for (alone or beside
such a set), turbulence, or none. Its log evidence is a tempered Laplace approximation,

    ln p = sum_c G_c / (2 T_c) - chance C / (2 T_0) + w_b (B - chance C_b) / (2 T_b) - nats k - nats_o k_o + offset
    T_c = T_0 + error max G_c,  T_b = 1 + error max B

with G_c the drop of the whitened sum of squares in channel c, B that of the block means, C and C_b the same gains on
left-out nominal flights, k and k_o the numbers of parameters of effects and onsets, and an offset for the number of
effects and the kind of change, the prior. T_0 counts whitened rows per independent sample; a model's error grows with
its gain, so that close explanations of a strong effect keep comparable probabilities. All weights come from
`decision.json`: a multinomial logistic regression on flights with known labels.

Without fast accelerometer the constants of the equations differ between flights. Effects without an onset that gain A
may then be such a nominal difference, whose prior is a Student distribution with the largest such gain A_0 of n
left-out nominal flights as scale: the same explanation without these effects, less (n + 1) / 2 ln(1 + A / A_0).
Source: Kass & Raftery 1995 (Laplace approximation); Kennedy & O'Hagan 2001 (model discrepancy).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import msgspec
import numpy as np

from twin_worker.diagnosis.data.card import FaultHypothesis
from twin_worker.diagnosis.inference.isolation.isolate import ScoredHypothesis
from twin_worker.diagnosis.inference.isolation.unmodelled import Anomaly

TABLE = Path(__file__).with_name("decision.json")
TURBULENCE = "turbulence"
NEVER_MISSED = (np.inf, 0.0, 0.0)  # see `Weights.missed`


class Weights(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Weights of the log evidence, fitted on flights with known labels.

    Attributes:
        rows_per_sample: T_0 [-]
        model_error: share of the largest gain [-]
        nats_per_parameter: cost of one parameter of an effect [nat]
        nats_per_onset: cost of one parameter of an onset, which may lie anywhere in the flight [nat]
        chance: weight of the gain on nominal flights [-]
        block_weight: weight of the block means [-]
        further: prior of at least 1, 2 and 3 effects, each against one fewer [nat]
        changes: prior of each kind of change without an effect, and of turbulence [nat]
        beside: prior of such a change beside effects, in addition [nat]
        missed: intercept, slope and largest log odds of the logistic regression `missed_at`
        fault_odds: odds of a fault among the flights that the weights were fitted on [-]
    """

    rows_per_sample: float
    model_error: float
    nats_per_parameter: float
    nats_per_onset: float
    chance: float
    block_weight: float
    further: tuple[float, float, float]
    changes: dict[str, float]
    beside: float = 0.0
    missed: tuple[float, float, float] = NEVER_MISSED
    fault_odds: float = 1.0

    def missed_at(self, log_odds: float) -> float:
        """Return the probability that the search misses the cause, at log odds of the most probable outcome [-]."""
        intercept, slope, largest = self.missed
        return float(1.0 / (1.0 + np.exp(intercept + slope * min(log_odds, largest))))


class DecisionTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Fitted weights, and the flights that they were fitted on."""

    provenance: dict[str, str]
    weights: Weights


@dataclass(frozen=True)
class Explanation:
    """A set of effects, refined jointly, or with `change` a change that no effect stands for beside them.

    Attributes:
        members: the effects, in the order in which they were found
        channel_gain: drop of the whitened sum of squares by channel, and by the prior of the nuisances, (c + 1,)
        block_gain: drop of the sum of squares of block means
        parameters: number of parameters of the effects and of the change, without those of their onsets
        chance, block_chance: the same gains that these effects reach on left-out nominal flights
        nominal: differences to the nominal flights beside the effects; nominal_nats: their cost [nat]
        change: kind of the change, `turbulence`, or empty
        anomaly: the change
    """

    members: tuple[ScoredHypothesis, ...]
    channel_gain: np.ndarray
    block_gain: float = 0.0
    parameters: int = 0
    chance: float = 0.0
    block_chance: float = 0.0
    nominal: tuple[FaultHypothesis, ...] = ()
    nominal_nats: float = 0.0
    change: str = ""
    anomaly: Anomaly | None = None

    @property
    def gain(self) -> float:
        """Return the joint gain."""
        return float(self.channel_gain.sum())

    @property
    def labels(self) -> frozenset[str]:
        """Return the labels of the effects."""
        return frozenset(member.hypothesis.label for member in self.members)

    @property
    def effect_names(self) -> frozenset[str]:
        """Return the names of the effects."""
        return frozenset(member.hypothesis.effect.name for member in self.members)

    @property
    def names(self) -> frozenset[str]:
        """Return the names of the effects; of a change beside them, its kind too."""
        return self.effect_names | {self.change} if self.change else self.effect_names


@cache
def load_table() -> DecisionTable:
    """Read the fitted weights."""
    return msgspec.json.decode(TABLE.read_bytes(), type=DecisionTable)


class EvidenceTerms:
    """Terms of the log evidence of explanations, as arrays."""

    def __init__(self, explanations: Sequence[Explanation]) -> None:
        self._gains = np.array([one.channel_gain for one in explanations])
        self._blocks = np.array([one.block_gain for one in explanations])
        self._size = np.array([[len(one.members) > k for k in range(3)] for one in explanations])
        self._onsets = np.array(
            [sum(member.hypothesis.onset.n_parameters for member in one.members) for one in explanations]
        )
        self._parameters = np.array([one.parameters for one in explanations])
        self._block_chance = np.array([one.block_chance for one in explanations])
        self._chance = np.array([one.chance for one in explanations])
        self._changes = [one.change for one in explanations]
        self._beside = np.array([bool(one.change and one.members) for one in explanations])
        self._nominal = np.array([one.nominal_nats for one in explanations])

    def log_evidence(self, weights: Weights) -> np.ndarray:
        """Return the log evidence of each explanation against none, (m,)."""
        if not len(self._gains):
            return np.zeros(0)
        temperature = weights.rows_per_sample + weights.model_error * np.maximum(self._gains.max(axis=0), 0.0)
        block_temperature = 1.0 + weights.model_error * max(float(self._blocks.max()), 0.0)
        offset = {"": 0.0} | weights.changes
        return np.asarray(
            (self._gains / (2.0 * temperature)).sum(axis=1)
            - self._nominal
            + weights.block_weight * (self._blocks - weights.chance * self._block_chance) / (2.0 * block_temperature)
            - weights.nats_per_parameter * self._parameters
            - weights.nats_per_onset * self._onsets
            - weights.chance * self._chance / (2.0 * weights.rows_per_sample)
            + self._size @ np.array(weights.further)
            + np.array([offset[change] for change in self._changes])
            + weights.beside * self._beside
        )
