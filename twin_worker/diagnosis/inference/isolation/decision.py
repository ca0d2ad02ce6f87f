"""Decide between explanations of a flight by their posterior probability.

An explanation is a set of up to three effects with their onsets, a change that no effect stands for (alone or beside
such a set), turbulence, or none. Its log evidence is a tempered Laplace approximation, relative to none,

    ln p = sum_c G_c / (2 T_c) - chance C / (2 T_0) + w_b (B - chance C_b) / (2 T_b) - nats k - nats_o k_o + offset
    T_c = T_0 + error max G_c,  T_b = 1 + error max B

with G_c the drop of the whitened sum of squares in channel c, B that of the block means, C and C_b the same gains on
left-out nominal flights, k and k_o the numbers of parameters of effects and onsets, and an offset for the number of
effects and the kind of change, the prior. T_0 counts whitened rows per independent sample; a model's error grows with
its gain, so that close explanations of a strong effect keep comparable probabilities. All weights come from
`decision.json`: a multinomial logistic regression on flights with known labels, which calibrates the posterior.

Without fast accelerometer the constants of the equations differ between flights. Effects without an onset that gain A
may then be such a nominal difference, whose prior is a Student distribution with the largest such gain A_0 of n
left-out nominal flights as scale: the same explanation without these effects, less (n + 1) / 2 ln(1 + A / A_0).
Source: Kass & Raftery 1995 (Laplace approximation); Kennedy & O'Hagan 2001 (model discrepancy); Platt 1999 and Guo et
al. 2017 (calibration by logistic regression, temperature).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np

from twin_worker.diagnosis.data.card import FaultHypothesis
from twin_worker.diagnosis.inference.isolation.isolate import ScoredHypothesis
from twin_worker.diagnosis.inference.isolation.unmodelled import Anomaly

TABLE = Path(__file__).with_name("decision.json")
TURBULENCE = "turbulence"
CLASS_PROBABILITY = 0.95  # probability of the reported class [-]


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
    """

    rows_per_sample: float
    model_error: float
    nats_per_parameter: float
    nats_per_onset: float
    chance: float
    block_weight: float
    further: tuple[float, float, float]
    changes: dict[str, float]


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
        parameters: number of parameters of the effects, without those of their onsets
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
    def names(self) -> frozenset[str]:
        """Return the names of the effects; of a change beside them, its kind too."""
        names = frozenset(member.hypothesis.effect.name for member in self.members)
        return names | {self.change} if self.change else names


@dataclass(frozen=True)
class Decision:
    """Posterior of the explanations of one flight.

    Attributes:
        best: most probable set of effects, each with the rivals that complete its class; None without any
        sets: probability of each set of names, most probable first; the empty set is none
        unmodelled: probability that a change without an effect acts, and the most probable one
        names: probability of each effect
        nominal: differences to the nominal flights in the most probable explanation
    """

    best: Explanation | None
    sets: dict[frozenset[str], float]
    unmodelled: float
    anomaly: Anomaly | None
    names: dict[str, float]
    nominal: tuple[FaultHypothesis, ...]

    @property
    def none(self) -> float:
        """Return the probability of no effect and no change."""
        return self.sets.get(frozenset(), 0.0)

    @property
    def effects(self) -> float:
        """Return the probability that effects of the catalogue, and nothing else, act."""
        return max(1.0 - self.none - self.unmodelled, 0.0)


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
        )


def posterior(log_evidences: np.ndarray) -> np.ndarray:
    """Return the probability of each explanation and, last, of none, (m + 1,)."""
    x = np.append(log_evidences, 0.0)
    weight = np.exp(x - x.max())
    return np.asarray(weight / weight.sum())


def decide(explanations: Sequence[Explanation], weights: Weights) -> Decision:
    """Return the posterior of all explanations, and the most probable set of effects with its classes."""
    probability = posterior(EvidenceTerms(explanations).log_evidence(weights))
    sets: dict[frozenset[str], float] = {frozenset(): float(probability[-1])}
    names: dict[str, float] = {}
    unmodelled, anomaly, highest = 0.0, None, -1.0
    for one, p in zip(explanations, probability.tolist(), strict=False):
        if one.anomaly is None:
            sets[one.names] = sets.get(one.names, 0.0) + p
        else:
            unmodelled += p
            if p > highest:
                anomaly, highest = one.anomaly, p
        for name in one.names if one.anomaly is None else {m.hypothesis.effect.name for m in one.members}:
            names[name] = names.get(name, 0.0) + p
    sets = dict(sorted(sets.items(), key=lambda entry: -entry[1]))
    chosen = next(filter(None, sets), None)
    best = None
    if chosen is not None:
        own = [k for k, one in enumerate(explanations) if one.anomaly is None and one.names == chosen]
        best = _with_classes(explanations[max(own, key=lambda k: probability[k])], explanations, probability)
    most_probable = int(np.argmax(probability))
    nominal = explanations[most_probable].nominal if most_probable < len(explanations) else ()
    return Decision(best, sets, unmodelled, anomaly, names, nominal)


def _with_classes(best: Explanation, explanations: Sequence[Explanation], probability: np.ndarray) -> Explanation:
    """Return a set of effects in which each has the rivals that complete its class.

    The effects that may replace a member compete given the other members; the class is the smallest set of names that
    holds `CLASS_PROBABILITY` of their probability.
    """
    members = []
    for member in best.members:
        others = best.labels - {member.hypothesis.label}
        total: dict[str, float] = {}
        scored: dict[str, tuple[float, ScoredHypothesis]] = {}
        for one, p in zip(explanations, probability.tolist(), strict=False):
            own = [other for other in one.members if other.hypothesis.label not in others]
            if one.change or len(own) != 1 or len(one.members) != len(best.members):
                continue
            name = own[0].hypothesis.effect.name
            total[name] = total.get(name, 0.0) + p
            scored[name] = max(scored.get(name, (-1.0, own[0])), (p, own[0]), key=lambda pair: pair[0])
        names = smallest_set(total, CLASS_PROBABILITY)
        rivals = tuple(scored[name][1] for name in names if name != member.hypothesis.effect.name)
        members.append(replace(member, rivals=rivals))
    return replace(best, members=tuple(members))


def smallest_set(probability: Mapping[str, float], share: float) -> list[str]:
    """Return the fewest names that together hold a share of the total probability, most probable first."""
    total, out = 0.0, []
    for name in sorted(probability, key=lambda name: -probability[name]):
        if total >= share * sum(probability.values()):
            break
        total += probability[name]
        out.append(name)
    return out
