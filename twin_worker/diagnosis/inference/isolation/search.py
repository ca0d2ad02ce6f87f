"""Search sets of up to three effects that explain a flight: a beam over the best names, then backward elimination."""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from itertools import combinations

import numpy as np

from fleet.effects import Onset, Stage
from twin_worker.diagnosis.data.card import ALWAYS, FaultHypothesis
from twin_worker.diagnosis.inference.isolation.block_means import BLOCK_S, BlockMeans
from twin_worker.diagnosis.inference.isolation.evidence import TURBULENCE, EvidenceTerms, Explanation, load_table
from twin_worker.diagnosis.inference.isolation.isolate import Scanner, ScoredHypothesis
from twin_worker.diagnosis.inference.isolation.onset import onset_posterior
from twin_worker.diagnosis.inference.isolation.refine import refine
from twin_worker.diagnosis.inference.isolation.unmodelled import Anomaly, find_anomalies, find_changed_coefficients
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals
from twin_worker.diagnosis.model.baseline import CHANNELS

MAX_EFFECTS = 3  # effects per flight
_N_REFINED = {1: 12, 2: 6, 3: 4}  # hypotheses refined per scan, by size of the set
_BEAM = {1: 3, 2: 2}  # sets of each size that are extended
_MIN_SCAN_GAIN = 40.0  # gain of the scan below which a hypothesis is not refined
_REFINE_SHARE = 0.6  # share of the best score from which the onset is refined
_PRUNED_NATS = 6.0  # a set this far below the best one is not extended

ReportProgress = Callable[[str], None]


class Search:
    """Explanations of one flight, all under the same initial conditions.

    Args:
        whitened: residuals conditioned on the weather alone; modified by the search
    """

    def __init__(self, whitened: WhitenedResiduals) -> None:
        self.whitened = whitened
        self.weights = load_table().weights
        self._scanner = Scanner(whitened)
        self.blocks = BlockMeans(whitened, whitened.base.block_sigma)
        self._no_effect, self._no_effect_blocks = self._costs(()), self.blocks.cost(())
        self._constants: dict[
            tuple[str, frozenset[str]], float
        ] = {}  # gain of an effect without an onset, given others
        # a fast accelerometer tells the air apart from the equations; the own past has the same constants
        self._own_past = whitened.base.envelope is None
        self._constants_differ = not whitened.base.vane and not self._own_past
        nominal = [x for kind, x in whitened.base.chance.items() if kind.endswith(f"|{Onset.ALWAYS}")]
        self._nominal_constant = max(self.weights.rows_per_sample, *nominal)
        self._explanations: dict[tuple[str, ...], Explanation] = {}
        self.ranking: list[ScoredHypothesis] = []

    @property
    def explanations(self) -> list[Explanation]:
        """Return all stored explanations, without the empty one."""
        return list(self._explanations.values())

    def run(self, progress: ReportProgress = lambda message: None) -> None:
        """Search singles, pairs and triples, then the best ones without each of their members."""
        level = [self._add((scored,)) for scored in self._best_hypotheses(self.whitened, ())]
        for size in range(2, MAX_EFFECTS + 1):
            progress(f"sets of {size} effects")
            level = [extended for parent in self._beam(level, size - 1) for extended in self._extended(parent)]
            for explanation in self._beam(level, size)[:1]:
                for member in explanation.members[:-1]:
                    self._refined([one for one in explanation.members if one is not member])
        self._add_changes()

    def best(self) -> Explanation | None:
        """Return the most probable set of effects, whatever the probability of none."""
        sets = [one for one in self.explanations if one.members and not one.change]
        return sets[int(np.argmax(self._evidence(sets)))] if sets else None

    def estimated(self, members: Sequence[ScoredHypothesis]) -> tuple[ScoredHypothesis, ...]:
        """Return the members refined given the others, the nuisances estimated anew with these; rivals as they are."""
        refined = list(members)
        for i, member in enumerate(members):
            given = copy(self.whitened)
            others = (one.hypothesis for k, one in enumerate(refined) if k != i)
            given.condition_on((*self.whitened.conditions, *others))
            refined[i] = replace(self._with_onset(given, member.hypothesis), rivals=member.rivals)
        return tuple(refined)

    def _with_onset(self, given: WhitenedResiduals, hypothesis: FaultHypothesis) -> ScoredHypothesis:
        """Refine an effect from its onset, and from the most probable one; return the more probable, with interval."""
        best = refine(given, hypothesis)
        if hypothesis.onset.kind not in (Onset.STEP, Onset.RAMP):
            return best
        posterior = onset_posterior(given, best.hypothesis, self.weights)
        if posterior is None:
            return best
        moved = refine(given, replace(best.hypothesis, onset=posterior.mode))
        best = max(best, moved, key=self._onset_evidence)
        return replace(best, onset_interval=posterior.interval)

    def _onset_evidence(self, scored: ScoredHypothesis) -> float:
        nats = self.weights.nats_per_onset * scored.hypothesis.onset.n_parameters
        return scored.gain / (2.0 * self.weights.rows_per_sample) - nats

    def _evidence(self, explanations: Sequence[Explanation]) -> np.ndarray:
        reference = [*explanations, *self.explanations]
        return EvidenceTerms(reference).log_evidence(self.weights)[: len(explanations)]

    def _costs(self, hypotheses: Sequence[FaultHypothesis]) -> np.ndarray:
        """Return the cost by channel and that of the nuisances' prior, (c + 1,)."""
        channels = self.whitened.channel_cost(hypotheses)
        return np.append(channels, self.whitened.cost(hypotheses) - channels.sum())

    def _add(self, members: Sequence[ScoredHypothesis]) -> Explanation:
        """Store and return an explanation; of the same effects and onsets, the one with the larger gain is stored."""
        hypotheses = [member.hypothesis for member in members]
        explanation = self._with_priors(
            Explanation(
                tuple(members),
                self._no_effect - self._costs(hypotheses),
                self._no_effect_blocks - self.blocks.cost(hypotheses),
            )
        )
        key = tuple(sorted(member.kind for member in members))
        if key not in self._explanations or self._explanations[key].gain < explanation.gain:
            self._explanations[key] = explanation
            self._add_nominal(key, explanation)
        return explanation

    def _with_priors(self, explanation: Explanation) -> Explanation:
        """Return an explanation with the number of parameters and the gains on nominal flights of its members."""
        base, hypotheses = self.whitened.base, [member.hypothesis for member in explanation.members]
        chance, block_chance = (
            sum(chance_gain(gains, hypothesis, base.vane, self._constants_differ) for hypothesis in hypotheses)
            for gains in (base.chance, base.block_chance)
        )
        parameters = sum(hypothesis.effect.degrees_of_freedom for hypothesis in hypotheses)
        return replace(explanation, parameters=parameters, chance=chance, block_chance=block_chance)

    def _add_nominal(self, key: tuple[str, ...], explanation: Explanation) -> None:
        """Store the explanations in which effects without an onset are differences between nominal flights."""
        members = explanation.members
        constant = [one for one in members if one.hypothesis.onset.kind is Onset.ALWAYS]
        if not self._constants_differ:
            return
        nats = {one.kind: self._nominal_nats(self._constant_gain(one, members)) for one in constant}
        for size in range(1, len(constant) + 1):
            for chosen in combinations(constant, size):
                others = tuple(one for one in members if one not in chosen)
                nominal = self._with_priors(replace(explanation, members=others))
                differences = tuple(one.hypothesis for one in chosen)
                cost = sum(nats[one.kind] for one in chosen)
                name = ("nominal", *(one.kind for one in chosen), *key)
                self._explanations[name] = replace(nominal, nominal=differences, nominal_nats=cost)

    def _nominal_nats(self, gain: float) -> float:
        """Return the cost of a difference to the nominal flights with a gain [nat]."""
        return 0.5 * (len(self.whitened.base.flights) + 1) * float(np.log1p(max(gain, 0.0) / self._nominal_constant))

    def _constant_gain(self, member: ScoredHypothesis, members: Sequence[ScoredHypothesis]) -> float:
        """Return the gain of an effect without its onset, the larger of alone and given the other members."""
        label = member.hypothesis.label
        others = frozenset(other.hypothesis.label for other in members if other is not member)
        return max(self._constants.get((label, others), 0.0), self._constants.get((label, frozenset()), 0.0))

    def _beam(self, level: Sequence[Explanation], size: int) -> list[Explanation]:
        """Return the best explanations of a level, each set of labels once."""
        evidence = self._evidence(level)
        chosen: dict[frozenset[str], Explanation] = {}
        least = max(float(self._evidence(self.explanations).max(initial=0.0)), 0.0) - _PRUNED_NATS
        for k in np.argsort(-evidence):
            if evidence[k] > least and len(chosen) < _BEAM.get(size, 1):
                chosen.setdefault(level[k].labels, level[k])
        return list(chosen.values())

    def _extended(self, parent: Explanation) -> list[Explanation]:
        """Return the parent with each of the best further effects; the best of them is refined jointly."""
        given = self.whitened.conditioned(tuple(member.hypothesis for member in parent.members))
        out = [self._add((*parent.members, scored)) for scored in self._best_hypotheses(given, parent.members)]
        if out:
            k = int(np.argmax(self._evidence(out)))
            out[k] = self._refined(out[k].members)
        return out

    def _refined(self, members: Sequence[ScoredHypothesis]) -> Explanation:
        """Refine each member given the others, and store the result."""
        refined = list(members)
        for i in range(len(refined)):
            others = tuple(other.hypothesis for k, other in enumerate(refined) if k != i)
            refined[i] = refine(self.whitened.conditioned(others), refined[i].hypothesis)
        return self._add(refined)

    def _best_hypotheses(self, given: WhitenedResiduals, members: Sequence[ScoredHypothesis]) -> list[ScoredHypothesis]:
        """Return the best plausible further effects, given the members."""
        taken = {member.hypothesis.label for member in members}
        scanned = [scored for scored in self._scanner.scan(given) if scored.hypothesis.label not in taken]
        if self._own_past:  # effects present from the start are part of the baseline
            scanned = [scored for scored in scanned if scored.hypothesis.onset.kind is not Onset.ALWAYS]
        for scored in scanned:
            if scored.hypothesis.onset.kind is Onset.ALWAYS:
                self._constants[(scored.hypothesis.label, frozenset(taken))] = scored.gain
        refined = best_hypotheses(given, scanned, _N_REFINED[len(members) + 1])
        if self._constants_differ:
            refined += self._without_onsets(given, refined)
        self.ranking = self.ranking or refined
        return [scored for scored in refined if is_plausible(given, scored.hypothesis)]

    def _without_onsets(self, given: WhitenedResiduals, refined: Sequence[ScoredHypothesis]) -> list[ScoredHypothesis]:
        """Return the effects of which only a change in flight was refined, present from the start."""
        started = {one.hypothesis.label for one in refined if one.hypothesis.onset.kind is Onset.ALWAYS}
        changed = {one.hypothesis.label: one.hypothesis for one in refined if one.hypothesis.label not in started}
        constant = [one for one in changed.values() if Onset.ALWAYS in one.effect.onsets]
        return [refine(given, replace(one, onset=ALWAYS), move_onset=False) for one in constant]

    def _add_changes(self) -> None:
        """Add changes that no effect stands for, alone and beside the best set of effects, and turbulence."""
        for anomaly in (*find_anomalies(self.whitened), *find_changed_coefficients(self.whitened)):
            self._add_anomaly(Explanation((), np.zeros(len(CHANNELS) + 1)), anomaly)
        if (best := self.best()) is not None:
            given = self.whitened.conditioned(tuple(member.hypothesis for member in best.members))
            for anomaly in find_anomalies(given):
                self._add_anomaly(best, anomaly)
        gain, _, _ = turbulence_evidence(self.whitened)
        if gain.any():
            self._explanations[(TURBULENCE,)] = Explanation((), gain, change=TURBULENCE)
            if self._constants_differ:
                nats = self._nominal_nats(float(gain.sum()))
                self._explanations[("nominal", TURBULENCE)] = Explanation((), gain, nominal_nats=nats)

    def _add_anomaly(self, beside: Explanation, anomaly: Anomaly) -> None:
        gain, channel = beside.channel_gain.copy(), CHANNELS.index(anomaly.channel)
        block_gain = beside.block_gain
        hypotheses = [member.hypothesis for member in beside.members]
        if anomaly.hypothesis is not None:
            hypotheses.append(anomaly.hypothesis)
            gain = self._no_effect - self._costs(hypotheses)
            block_gain = self._no_effect_blocks - self.blocks.cost(hypotheses)
        else:
            gain[channel] += max(anomaly.net_gain, 0.0)
        if anomaly.series is not None:
            block_gain = self._no_effect_blocks - self.blocks.cost(hypotheses, (channel, anomaly.series))
        chance = beside.chance + self.whitened.base.chance.get(anomaly.kind, 0.0)
        key = (*sorted(member.kind for member in beside.members), anomaly.kind)
        changed = replace(
            beside,
            channel_gain=gain,
            block_gain=block_gain,
            parameters=beside.parameters + anomaly.parameters,
            chance=chance,
            change=anomaly.change,
            anomaly=anomaly._replace(series=None),
        )
        self._explanations[key] = changed


def chance_gain(
    chance: Mapping[str, float], hypothesis: FaultHypothesis, vane: bool, constants_differ: bool = False
) -> float:
    """Return the gain that an effect reaches on nominal flights, from `Baseline.chance` or `Baseline.block_chance`.

    With a fast accelerometer the largest of the same effect or of the same surface; else of the same kind of onset, and
    where constants differ between flights, beyond that without an onset.
    """
    if vane:
        return max((x for kind, x in chance.items() if _is_related(kind, hypothesis)), default=0.0)
    constant = chance.get(f"{hypothesis.label}|{Onset.ALWAYS}", 0.0) if constants_differ else 0.0
    return max(chance.get(f"{hypothesis.label}|{hypothesis.onset.kind}", 0.0) - constant, 0.0)


def _is_related(kind: str, hypothesis: FaultHypothesis) -> bool:
    """Return whether a chance gain applies to a hypothesis: same effect, or same surface."""
    label = kind.partition("|")[0]
    return label == hypothesis.label or (
        hypothesis.effect.stage is Stage.DELTA and label.endswith(f":{hypothesis.target}")
    )


def best_hypotheses(
    whitened: WhitenedResiduals, scanned: Sequence[ScoredHypothesis], n_refined: int = _N_REFINED[1]
) -> list[ScoredHypothesis]:
    """Refine the most promising hypotheses of a scan, best first; at most two kinds of onset of each."""
    candidates: list[ScoredHypothesis] = []
    for scored in scanned:
        same = sum(other.hypothesis.label == scored.hypothesis.label for other in candidates)
        if scored.gain >= _MIN_SCAN_GAIN and same < 2:
            candidates.append(scored)
        if len(candidates) >= n_refined:
            break
    fitted = [refine(whitened, scored.hypothesis, move_onset=False) for scored in candidates]
    least = _REFINE_SHARE * max((refined.net_gain for refined in fitted), default=0.0)
    # a slightly misplaced bump gains little before its onset is fitted: the score of the scan counts too
    moved = [
        refine(whitened, refined.hypothesis) if max(refined.net_gain, scored.net_gain) > least else refined
        for refined, scored in zip(fitted, candidates, strict=True)
    ]
    return sorted(moved, key=lambda refined: -refined.net_gain)


def is_plausible(whitened: WhitenedResiduals, hypothesis: FaultHypothesis) -> bool:
    """Return whether a hypothesis exceeds sensor tolerances and minimum values, with no one-sided parameter at zero."""
    bounds = {
        n.index: n.release_sigmas * whitened.spread(n)
        for n in whitened.nuisances
        if n.is_sensor_bias and (n.effect.name, n.target) == (hypothesis.effect.name, hypothesis.target)
    }
    if bounds and all(abs(x) < bounds[k] for k, x in enumerate(hypothesis.par)):
        return False
    if not has_size(hypothesis):
        return False
    return own_share(whitened, hypothesis) > MIN_OWN_SHARE


def has_size(hypothesis: FaultHypothesis) -> bool:
    """Return whether every parameter exceeds its minimum value, and none of a one-sided effect is at its bound zero."""
    pairs = list(zip(hypothesis.effect.parameters, hypothesis.par, strict=True))
    return all(abs(x) >= p.least and (p.nuisance or p.low != 0.0 or x > 0.0) for p, x in pairs)


MIN_OWN_SHARE = 0.1  # least share of the gain without nuisances of the effect


def own_share(whitened: WhitenedResiduals, hypothesis: FaultHypothesis) -> float:
    """Return the share of the gain that is due to parameters other than nuisances."""
    is_nuisance = np.array([p.nuisance for p in hypothesis.effect.parameters])
    if not is_nuisance.any():
        return 1.0
    base_cost, full_cost = whitened.cost(()), whitened.cost((hypothesis,))
    own_cost = whitened.cost((hypothesis.with_parameters(np.where(is_nuisance, hypothesis.par, 0.0)),))
    return (own_cost - full_cost) / max(base_cost - full_cost, 1e-9)


_GUST_RATIOS = 1.2, 1.5  # variance ratio of the air channels in turbulence: least, median


def turbulence_evidence(whitened: WhitenedResiduals) -> tuple[np.ndarray, float, float | None]:
    """Return gain by channel, (c + 1,), variance ratio of gusts, and their onset [s]; None if it is before the flight.

    Sideslip, lift and airspeed scatter more, the sensor channels do not. The onset is the change point of the variance,
    r_1 before and r_2 after it:  G = -sum n_i ln r_i, against n (r - 1 - ln r) of one variance throughout.
    """
    air_channels = [CHANNELS.index(name) for name in ("side", "lift", "airspeed")]
    sensor_channels = [k for k, name in enumerate(CHANNELS) if name.startswith(("gps", "gyro"))]
    gain = np.zeros(len(CHANNELS) + 1)
    square = ((whitened.e + whitened.Jn @ whitened.xn) ** 2 / whitened.base.usual)[whitened.ok]
    t = whitened.modelled.t[whitened.ok]
    onset = _variance_onset(t, square[:, air_channels], load_table().weights.rows_per_sample)
    after = square if onset is None else square[t >= onset]
    ratio, sensor_ratio = after[:, air_channels].mean(axis=0), after[:, sensor_channels].mean()
    if ratio.min() < _GUST_RATIOS[0] or np.median(ratio) < _GUST_RATIOS[1] or sensor_ratio > _GUST_RATIOS[1]:
        return gain, 1.0, None
    gain[air_channels] = len(after) * (ratio - 1 - np.log(ratio))
    return gain, float(np.median(ratio)), onset


def _variance_onset(t: np.ndarray, square: np.ndarray, rows_per_sample: float) -> float | None:
    """Return the change point of the variance of channels, (n, c); None if one variance throughout is as probable."""
    n = len(t)
    rows = np.arange(1, n)
    inside = rows[(t[rows] > t[0] + BLOCK_S) & (t[rows] < t[-1] - BLOCK_S)]
    if not len(inside):
        return None
    total = np.cumsum(square, axis=0)
    before = np.maximum(total[inside - 1] / inside[:, None], 1e-6)
    after = np.maximum((total[-1] - total[inside - 1]) / (n - inside)[:, None], 1e-6)
    whole = np.log(np.maximum(total[-1] / n, 1e-6))
    gain = (n * whole - inside[:, None] * np.log(before) - (n - inside)[:, None] * np.log(after)).sum(axis=1)
    best = int(np.argmax(gain))
    if gain[best] / (2.0 * rows_per_sample) < np.log(len(inside)) or after[best].mean() < before[best].mean():
        return None
    return float(t[inside[best]])
