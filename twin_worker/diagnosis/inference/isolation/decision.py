"""Decide between explanations of a flight by their posterior probability.

    P(explanation) = (1 - missed) exp(ln p) / sum exp(ln p)

with the log evidence of `evidence`, and the probability that the search misses the cause: a logistic function of the
log odds of the most probable outcome, fitted on flights with known labels that the evidence was not fitted on. Where
faults are rarer than among those flights, the evidence against none is less by the logarithm of the ratio of their
odds.
Source: Platt 1999; Guo et al. 2017 (calibration); Saerens et al. 2002, Neural Computation 14, 21 (other priors).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin_worker.diagnosis.data.card import FaultHypothesis
from twin_worker.diagnosis.inference.isolation.evidence import EvidenceTerms, Explanation, Weights
from twin_worker.diagnosis.inference.isolation.isolate import ScoredHypothesis
from twin_worker.diagnosis.inference.isolation.unmodelled import Anomaly

CLASS_PROBABILITY = 0.95  # probability of the reported class [-]


@dataclass(frozen=True)
class Decision:
    """Posterior of the explanations of one flight.

    Attributes:
        best: most probable set of effects, each with the rivals that complete its class; None without any
        sets: probability of each set of names, most probable first; the empty set is none
        unmodelled: probability that a change without an effect acts, and the most probable one
        missed: probability that the cause is not among the explanations
        acting: names of the effects of each explanation, and its probability
        nominal: differences to the nominal flights in the most probable explanation
    """

    best: Explanation | None
    sets: dict[frozenset[str], float]
    unmodelled: float
    anomaly: Anomaly | None
    missed: float
    acting: tuple[tuple[frozenset[str], float], ...]
    nominal: tuple[FaultHypothesis, ...]

    @property
    def none(self) -> float:
        """Return the probability of no effect and no change."""
        return self.sets.get(frozenset(), 0.0)

    @property
    def effects(self) -> float:
        """Return the probability that effects of the catalogue, and nothing else, act."""
        return max(1.0 - self.none - self.unmodelled - self.missed, 0.0)

    def probability(self, names: Iterable[str]) -> float:
        """Return the probability that at least one of some effects acts."""
        wanted = frozenset(names)
        return sum(p for acting, p in self.acting if acting & wanted)


def posterior(log_evidences: np.ndarray) -> np.ndarray:
    """Return the probability of each explanation and, last, of none, (m + 1,)."""
    x = np.append(log_evidences, 0.0)
    weight = np.exp(x - x.max())
    return np.asarray(weight / weight.sum())


def decide(explanations: Sequence[Explanation], weights: Weights, fault_odds: float | None = None) -> Decision:
    """Return the posterior of all explanations, and the most probable set of effects with its classes.

    Args:
        explanations: found by the search
        weights: of the log evidence
        fault_odds: prior odds of a fault in this flight [-]; None: those of the flights of the weights
    """
    rarer = 0.0 if fault_odds is None else float(np.log(weights.fault_odds / fault_odds))
    probability = posterior(EvidenceTerms(explanations).log_evidence(weights) - rarer)
    missed = weights.missed_at(outcome_log_odds(explanations, probability))
    probability *= 1.0 - missed
    sets: dict[frozenset[str], float] = {frozenset(): float(probability[-1])}
    acting = []
    unmodelled, anomaly, highest = 0.0, None, -1.0
    for one, p in zip(explanations, probability.tolist(), strict=False):
        if one.anomaly is None:
            sets[one.names] = sets.get(one.names, 0.0) + p
        else:
            unmodelled += p
            if p > highest:
                anomaly, highest = one.anomaly, p
        acting.append((one.names if one.anomaly is None else one.effect_names, p))
    sets = dict(sorted(sets.items(), key=lambda entry: -entry[1]))
    chosen = next(filter(None, sets), None)
    best = None
    if chosen is not None:
        own = [k for k, one in enumerate(explanations) if one.anomaly is None and one.names == chosen]
        best = _with_classes(explanations[max(own, key=lambda k: probability[k])], explanations, probability)
    most_probable = int(np.argmax(probability))
    nominal = explanations[most_probable].nominal if most_probable < len(explanations) else ()
    return Decision(best, sets, unmodelled, anomaly, missed, tuple(acting), nominal)


def outcome_log_odds(explanations: Sequence[Explanation], probability: np.ndarray) -> float:
    """Return the log odds of the most probable outcome: a set of names, a change without an effect, or none.

    Args:
        explanations: m of them
        probability: of each and, last, of none, (m + 1,)
    """
    total: dict[frozenset[str] | None, float] = {frozenset(): float(probability[-1])}
    for one, p in zip(explanations, probability.tolist(), strict=False):
        names = one.names if one.anomaly is None else None
        total[names] = total.get(names, 0.0) + p
    *others, most = sorted(total.values())
    return float(np.log(most / max(sum(others), np.finfo(float).tiny)))


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
