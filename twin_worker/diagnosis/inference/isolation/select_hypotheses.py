"""Select up to three effects that jointly explain a flight, each with its inseparable rivals."""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from fleet.effects import Stage
from twin_worker.diagnosis.data.card import FaultHypothesis
from twin_worker.diagnosis.inference.isolation.isolate import PARAMETER_COST, ScoredHypothesis, scan
from twin_worker.diagnosis.inference.isolation.refine import refine
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals
from twin_worker.diagnosis.model.baseline import CHANNELS

MAX_EFFECTS = 3  # effects per flight
_N_REFINED = 12  # hypotheses refined per step
_MIN_GAIN, _MIN_GAIN_COARSE = 150.0, 400.0  # least gain of the first effect, with and without fast accelerometer
_CANCEL_RATIO = 1.5  # limit of the relative contribution above which effects cancel each other
_MIN_FURTHER_GAIN = 250.0  # least gain of every further effect
_REFINE_SHARE = 0.6  # share of the best score from which the onset is refined
_CHANCE_FACTOR, _CHANCE_FACTOR_COARSE = 1.5, 1.2  # multiple of the gain that nominal flights reach by chance
# share of the other effects' gain per channel that counts as their error; least share of the first effect's gain
_ERROR_SHARE, _FURTHER_SHARE_COARSE = 0.03, 0.25
_MIN_OWN_SHARE = 0.1  # least share of the gain without nuisances
_TIE_SHARE = 0.02  # score tie within which the simpler hypothesis wins
# score tie within which hypotheses are inseparable: with fast accelerometer; without, where model errors are larger
_RIVAL_SHARE, _RIVAL_SHARE_COARSE = 0.06, 0.15
_GUST_RATIOS = 1.2, 1.5  # variance ratio of the air channels: least, median
_MIN_TIE, _MAX_TIE = 20.0, 300.0

ReportProgress = Callable[[str], None]


def select_hypotheses(
    whitened: WhitenedResiduals, weather: tuple[FaultHypothesis, ...], progress: ReportProgress = lambda message: None
) -> tuple[list[ScoredHypothesis], list[ScoredHypothesis]]:
    """Select the effects that explain the flight; return them and the first ranking. Modifies `whitened`.

    Args:
        whitened: residuals conditioned on the weather alone
        weather: hypotheses included throughout
        progress: callback for progress messages
    """
    named: list[ScoredHypothesis] = []
    ranking: list[ScoredHypothesis] = []
    joint = JointGain(whitened)
    while len(named) < MAX_EFFECTS:
        progress(f"effect {len(named) + 1}")
        candidates = best_hypotheses(whitened, [selected.hypothesis for selected in named])
        ranking = ranking or candidates
        before, others_gain = whitened.channel_cost(()), joint.channel_gain(named)
        candidates = [
            scored
            for scored in candidates
            if _has_required_gain(whitened, named, scored, before, others_gain)
            and is_plausible(whitened, scored.hypothesis)
        ]
        if not candidates:
            break
        extended = [*named, select_simplest(whitened, candidates)]
        if len(extended) > 1:
            extended = _reselect(whitened, extended, weather)
            if not joint.accepts(extended, named):
                break
        named = extended
        whitened.condition_on((*weather, *(selected.hypothesis for selected in named)))
    return named, ranking


class JointGain:
    """Joint gain of several effects, under the same initial conditions."""

    def __init__(self, whitened: WhitenedResiduals) -> None:
        self._whitened = copy(whitened)
        self._no_effect_cost, self._no_effect_channels = self._whitened.cost(()), self._whitened.channel_cost(())

    def gain(self, named: list[ScoredHypothesis]) -> float:
        """Return the joint gain."""
        return self._no_effect_cost - self._whitened.cost([selected.hypothesis for selected in named])

    def channel_gain(self, named: list[ScoredHypothesis]) -> np.ndarray:
        """Return the joint gain by channel, (c,)."""
        return self._no_effect_channels - self._whitened.channel_cost([selected.hypothesis for selected in named])

    def accepts(self, extended: list[ScoredHypothesis], current: list[ScoredHypothesis]) -> bool:
        """Return whether a further effect adds enough gain, without effects that cancel each other."""
        gain = self.gain(extended)
        without = min(self.gain([selected for selected in extended if selected is not omitted]) for omitted in extended)
        cancelling = gain - without > _CANCEL_RATIO * gain
        before = self.channel_gain(current)
        excess = excess_gain(self._whitened, self.channel_gain(extended) - before, before)
        gained = min(gain - self.gain(current), excess)
        return not cancelling and gained > required_gain(self._whitened, current, extended[-1])


def _has_required_gain(
    whitened: WhitenedResiduals,
    named: list[ScoredHypothesis],
    scored: ScoredHypothesis,
    before: np.ndarray,
    others_gain: np.ndarray,
) -> bool:
    """Return whether a hypothesis exceeds the required gain beyond the model errors of the selected effects.

    Args:
        whitened: residuals conditioned on the selected effects
        named: effects selected so far
        scored: the further hypothesis
        before: their cost by channel, (c,)
        others_gain: their joint gain by channel, (c,)
    """
    threshold = required_gain(whitened, named, scored)
    if not named or scored.gain <= threshold:
        return scored.gain > threshold
    own = before - whitened.channel_cost((scored.hypothesis,))
    return excess_gain(whitened, own, others_gain) > threshold


def excess_gain(whitened: WhitenedResiduals, own: np.ndarray, others_gain: np.ndarray) -> float:
    """Return the gain of a hypothesis beyond the errors of the others, which are a share of their gain per channel.

    Args:
        own, others_gain: gain of the hypothesis and of the others by channel, (c,)
    """
    share = _ERROR_SHARE if whitened.base.vane else 0.0
    return float(np.maximum(own - share * np.maximum(others_gain, 0.0), 0.0).sum())


def best_hypotheses(whitened: WhitenedResiduals, selected: Sequence[FaultHypothesis]) -> list[ScoredHypothesis]:
    """Scan all hypotheses and refine the most promising; best first."""
    taken = {hypothesis.label for hypothesis in selected}
    candidates: list[ScoredHypothesis] = []
    for scored in scan(whitened):
        if scored.hypothesis.label in taken or scored.gain < 40.0:
            continue
        if sum(other.hypothesis.label == scored.hypothesis.label for other in candidates) < 2:
            candidates.append(scored)
        if len(candidates) >= _N_REFINED:
            break
    fitted = [refine(whitened, scored.hypothesis, move_onset=False) for scored in candidates]
    least = _REFINE_SHARE * max((penalised_gain(whitened, refined) for refined in fitted), default=0.0)
    # a slightly misplaced bump gains little before its onset is fitted: the score of the scan counts too
    moved = [
        refine(whitened, refined.hypothesis)
        if max(penalised_gain(whitened, refined), scored.net_gain) > least
        else refined
        for refined, scored in zip(fitted, candidates, strict=True)
    ]
    return sorted(moved, key=lambda refined: -penalised_gain(whitened, refined))


def penalised_gain(whitened: WhitenedResiduals, scored: ScoredHypothesis) -> float:
    """Return the gain less the parameter costs; without fast accelerometer, less a share per extra parameter too."""
    extra = scored.hypothesis.effect.degrees_of_freedom - 1
    share = 0.0 if whitened.base.vane else _RIVAL_SHARE_COARSE * extra
    return scored.gain * (1.0 - share) - PARAMETER_COST * scored.hypothesis.degrees_of_freedom


def select_simplest(whitened: WhitenedResiduals, candidates: list[ScoredHypothesis]) -> ScoredHypothesis:
    """Select the hypothesis with the fewest parameters among the best ties; the others become its rivals."""
    scores = [penalised_gain(whitened, scored) for scored in candidates]
    gain = candidates[0].gain
    margin = max(_MIN_TIE, _RIVAL_SHARE_COARSE * gain)
    if whitened.base.vane:
        margin = max(_MIN_TIE, _TIE_SHARE * gain, min(_RIVAL_SHARE * gain, _MAX_TIE))
    least_tie = scores[0] - max(_MIN_TIE, _TIE_SHARE * gain)
    ties = [k for k, score in enumerate(scores) if score > least_tie]
    chosen = candidates[min(ties, key=lambda k: (candidates[k].hypothesis.degrees_of_freedom, -scores[k]))]
    rivals: dict[str, ScoredHypothesis] = {}
    for scored, score in zip(candidates, scores, strict=True):
        name = scored.hypothesis.effect.name
        if score >= scores[0] - margin and name != chosen.hypothesis.effect.name:
            rivals.setdefault(name, scored)
    return replace(chosen, rivals=tuple(rivals.values()))


def required_gain(whitened: WhitenedResiduals, named: list[ScoredHypothesis], scored: ScoredHypothesis) -> float:
    """Return the least gain of a hypothesis, from the chance gain and a share of the first effect's gain."""
    chance_gains = whitened.base.chance
    if whitened.base.vane:
        related = (x for kind, x in chance_gains.items() if _is_related(kind, scored.hypothesis))
        return max(_MIN_FURTHER_GAIN if named else _MIN_GAIN, _CHANCE_FACTOR * max(related, default=0.0))
    least = max(_MIN_GAIN_COARSE, _CHANCE_FACTOR_COARSE * chance_gains.get(scored.kind, 0.0))
    return max(least, _FURTHER_SHARE_COARSE * named[0].gain) if named else least


def _is_related(kind: str, hypothesis: FaultHypothesis) -> bool:
    """Return whether a chance gain applies to a hypothesis: same effect, or same surface."""
    label = kind.partition("|")[0]
    return label == hypothesis.label or (
        hypothesis.effect.stage is Stage.DELTA and label.endswith(f":{hypothesis.target}")
    )


def is_plausible(whitened: WhitenedResiduals, hypothesis: FaultHypothesis) -> bool:
    """Return whether a hypothesis exceeds sensor tolerances and minimum values, not by nuisances alone."""
    bounds = {
        n.index: n.release_sigmas * whitened.spread(n)
        for n in whitened.nuisances
        if n.is_sensor_bias and (n.effect.name, n.target) == (hypothesis.effect.name, hypothesis.target)
    }
    if bounds and all(abs(x) < bounds[k] for k, x in enumerate(hypothesis.par)):
        return False
    if any(abs(x) < p.least for p, x in zip(hypothesis.effect.parameters, hypothesis.par, strict=True)):
        return False
    return _own_share(whitened, hypothesis) > _MIN_OWN_SHARE


def _own_share(whitened: WhitenedResiduals, hypothesis: FaultHypothesis) -> float:
    """Return the share of the gain that is due to parameters other than nuisances."""
    is_nuisance = np.array([p.nuisance for p in hypothesis.effect.parameters])
    if not is_nuisance.any():
        return 1.0
    base_cost, full_cost = whitened.cost(()), whitened.cost((hypothesis,))
    own_cost = whitened.cost((hypothesis.with_parameters(np.where(is_nuisance, hypothesis.par, 0.0)),))
    return (own_cost - full_cost) / max(base_cost - full_cost, 1e-9)


def _reselect(
    whitened: WhitenedResiduals, named: list[ScoredHypothesis], weather: tuple[FaultHypothesis, ...]
) -> list[ScoredHypothesis]:
    """Reselect each effect given the others, because the first selection ignored later effects."""
    for i in range(len(named)):
        others = [selected.hypothesis for k, selected in enumerate(named) if k != i]
        whitened.condition_on((*weather, *others))
        candidates = [
            scored for scored in best_hypotheses(whitened, others) if is_plausible(whitened, scored.hypothesis)
        ]
        if candidates:
            candidates.insert(0, refine(whitened, named[i].hypothesis))
            candidates.sort(key=lambda scored: -penalised_gain(whitened, scored))
            named[i] = select_simplest(whitened, candidates)
    return named


def turbulence_evidence(whitened: WhitenedResiduals) -> tuple[float, float]:
    """Return gain and variance ratio of gusts: sideslip, lift and airspeed scatter more, the sensor channels do not."""
    air_channels = [CHANNELS.index(name) for name in ("side", "lift", "airspeed")]
    sensor_channels = [k for k, name in enumerate(CHANNELS) if name.startswith(("gps", "gyro"))]
    mean_square = whitened.mean_square() / whitened.base.usual
    ratio, sensor_ratio = mean_square[air_channels], mean_square[sensor_channels].mean()
    if ratio.min() < _GUST_RATIOS[0] or np.median(ratio) < _GUST_RATIOS[1] or sensor_ratio > _GUST_RATIOS[1]:
        return 0.0, 1.0
    n_rows = int(whitened.ok.sum())
    return float(sum(n_rows * (x - 1 - np.log(x)) for x in ratio)), float(np.median(ratio))
