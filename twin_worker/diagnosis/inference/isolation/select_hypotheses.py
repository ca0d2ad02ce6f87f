"""Select up to three effects that jointly explain a flight, each with its inseparable rivals."""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from fleet.effects import Stage
from twin_worker.diagnosis.data.fault_hypothesis import Guess
from twin_worker.diagnosis.inference.isolation.isolate import PRICE, Found, scan
from twin_worker.diagnosis.inference.isolation.refine import refine
from twin_worker.diagnosis.inference.isolation.whitened_residuals import Sight
from twin_worker.diagnosis.model.baseline import CHANNELS

MOST = 3  # effects per flight
_TRIED = 12  # hypotheses refined per step
_LEAST, _LEAST_COARSE = 150.0, 400.0  # least gain of the first effect, with and without fast accelerometer
_CANCEL = 1.5  # limit of the relative contribution above which effects cancel each other
_SECOND = 250.0  # least gain of every further effect
_NEAR = 0.6  # share of the best score from which the onset is refined
_CHANCE, _CHANCE_COARSE = 1.5, 1.2  # multiple of the gain that nominal flights reach by chance
# share of the other effects' gain per channel that counts as their error; least share of the first effect's gain
_SHARE, _SHARE_COARSE = 0.03, 0.25
_OWN = 0.1  # least share of the gain without nuisances
_NEXT = 0.02  # score tie within which the simpler hypothesis wins
# score tie within which hypotheses are inseparable: with fast accelerometer; without, where model errors are larger
_FINE, _COARSE = 0.06, 0.15
_GUSTS = 1.2, 1.5  # variance ratio of the air channels: least, median
_LEAST_TIE, _WIDEST_TIE = 20.0, 300.0

Say = Callable[[str], None]


@dataclass(frozen=True)
class Named:
    """One selected effect.

    Attributes:
        scored: the hypothesis and its gain
        rivals: hypotheses with equal explanatory power, best first
    """

    found: Found
    rivals: tuple[Found, ...]


def decide(sight: Sight, weather: tuple[Guess, ...], say: Say = lambda word: None) -> tuple[list[Named], list[Found]]:
    """Select the effects that explain the flight; return them and the first ranking. Modifies `whitened`.

    Args:
        whitened: residuals conditioned on the weather alone
        weather: hypotheses included throughout
        progress: callback for progress messages
    """
    named: list[Named] = []
    ranking: list[Found] = []
    first = Joint(sight)
    while len(named) < MOST:
        say(f"effect {len(named) + 1}")
        found = best(sight, [one.found.guess for one in named])
        ranking = ranking or found
        beside = Beside(sight, named, first.borne(named))
        found = [one for one in found if beside.earned(one) and believable(sight, one.guess)]
        if not found:
            break
        more = [*named, choose(sight, found)]
        if len(more) > 1:
            more = _again(sight, more, weather)
            if not first.better(more, named):
                break
        named = more
        sight.grant((*weather, *(one.found.guess for one in named)))
    return named, ranking


class Joint:
    """Joint gain of several effects, under the same initial conditions."""

    def __init__(self, sight: Sight) -> None:
        self._sight = copy(sight)
        self._none, self._bare = self._sight.cost(()), self._sight.powers(())

    def gain(self, named: list[Named]) -> float:
        """Return the joint gain."""
        return self._none - self._sight.cost([one.found.guess for one in named])

    def borne(self, named: list[Named]) -> np.ndarray:
        """Return the joint gain by channel, (c,)."""
        return self._bare - self._sight.powers([one.found.guess for one in named])

    def better(self, more: list[Named], fewer: list[Named]) -> bool:
        """Return whether a further effect adds enough gain, without effects that cancel each other."""
        gain = self.gain(more)
        without = min(self.gain([one for one in more if one is not left]) for left in more)
        cancelling = gain - without > _CANCEL * gain
        before = self.borne(fewer)
        gained = min(gain - self.gain(fewer), beyond(self._sight, self.borne(more) - before, before))
        return not cancelling and gained > needed(self._sight, fewer, more[-1].found)


class Beside:
    """Test whether a further hypothesis adds enough gain to the selected effects.

    Args:
        whitened: residuals conditioned on the selected effects
        named: effects selected so far
        channel_gain: their joint gain by channel, (c,)
    """

    def __init__(self, sight: Sight, named: list[Named], borne: np.ndarray) -> None:
        self._sight, self._named, self._borne = sight, named, borne
        self._before = sight.powers(())

    def earned(self, found: Found) -> bool:
        """Return whether a hypothesis exceeds the required gain beyond the model errors of the selected effects."""
        least = needed(self._sight, self._named, found)
        if not self._named or found.gain <= least:
            return found.gain > least
        own = self._before - self._sight.powers((found.guess,))
        return beyond(self._sight, own, self._borne) > least


def beyond(sight: Sight, own: np.ndarray, borne: np.ndarray) -> float:
    """Return the gain of a hypothesis beyond the errors of the others, which are a share of their gain per channel.

    Args:
        own, others_gain: gain of the hypothesis and of the others by channel, (c,)
    """
    share = _SHARE if sight.base.vane else 0.0
    return float(np.maximum(own - share * np.maximum(borne, 0.0), 0.0).sum())


def best(sight: Sight, beside: Sequence[Guess]) -> list[Found]:
    """Scan all hypotheses and refine the most promising; best first."""
    taken = {guess.label for guess in beside}
    tried: list[Found] = []
    for found in scan(sight):
        if found.guess.label in taken or found.gain < 40.0:
            continue
        if sum(other.guess.label == found.guess.label for other in tried) < 2:
            tried.append(found)
        if len(tried) >= _TRIED:
            break
    fitted = [refine(sight, found.guess, move=False) for found in tried]
    if not fitted:
        return []
    least = _NEAR * max(rank(sight, one) for one in fitted)
    # a slightly misplaced bump gains little before its onset is fitted: the score of the scan counts too
    near = [max(rank(sight, one), found.worth) > least for one, found in zip(fitted, tried, strict=True)]
    moved = [refine(sight, one.guess) if good else one for one, good in zip(fitted, near, strict=True)]
    return sorted(moved, key=lambda one: -rank(sight, one))


def rank(sight: Sight, found: Found) -> float:
    """Return the gain less the parameter costs; without fast accelerometer, less a share per extra parameter too."""
    extra = found.guess.effect.price - 1
    share = 0.0 if sight.base.vane else _COARSE * extra
    return found.gain * (1.0 - share) - PRICE * found.guess.size


def tie(sight: Sight, found: Found) -> float:
    """Return the score difference within which two hypotheses are inseparable."""
    if not sight.base.vane:
        return max(_LEAST_TIE, _COARSE * found.gain)
    return max(_LEAST_TIE, _NEXT * found.gain, min(_FINE * found.gain, _WIDEST_TIE))


def choose(sight: Sight, found: list[Found]) -> Named:
    """Select the hypothesis with the fewest parameters among the best ties; the others become its rivals."""
    first = found[0]
    near = [one for one in found if rank(sight, one) > rank(sight, first) - max(_LEAST_TIE, _NEXT * first.gain)]
    chosen = min(near, key=lambda one: (one.guess.size, -rank(sight, one)))
    rivals: dict[str, Found] = {}
    for one in found:
        if rank(sight, one) < rank(sight, first) - tie(sight, first):
            continue
        if one.guess.effect.name != chosen.guess.effect.name:
            rivals.setdefault(one.guess.effect.name, one)
    return Named(chosen, tuple(rivals.values()))


def needed(sight: Sight, named: list[Named], found: Found) -> float:
    """Return the least gain of a hypothesis, from the chance gain and a share of the first effect's gain."""
    known = sight.base.chance
    chance = _CHANCE_COARSE * known.get(found.kind, 0.0)
    if sight.base.vane:
        chance = _CHANCE * max((x for kind, x in known.items() if _akin(kind, found.guess)), default=0.0)
    least = _LEAST if sight.base.vane else _LEAST_COARSE
    if not named:
        return max(least, chance)
    return max(_SECOND, chance) if sight.base.vane else max(least, chance, _SHARE_COARSE * named[0].found.gain)


def _akin(kind: str, guess: Guess) -> bool:
    """Return whether a chance gain applies to a hypothesis: same effect, or same surface."""
    label = kind.partition("|")[0]
    return label == guess.label or (guess.effect.stage is Stage.DELTA and label.endswith(f":{guess.of}"))


def believable(sight: Sight, guess: Guess) -> bool:
    """Return whether a hypothesis exceeds sensor tolerances and minimum values, not by nuisances alone."""
    bounds = {
        n.index: n.released * max(sight.base.spread.get(n.name, n.floor), n.floor)
        for n in sight.nuisances
        if n.sensor and (n.effect.name, n.of) == (guess.effect.name, guess.of)
    }
    if bounds and all(abs(x) < bounds[k] for k, x in enumerate(guess.par)):
        return False
    if any(abs(x) < p.least for p, x in zip(guess.effect.parameters, guess.par, strict=True)):
        return False
    return _own(sight, guess) > _OWN


def _own(sight: Sight, guess: Guess) -> float:
    """Return the share of the gain that is due to parameters other than nuisances."""
    aside = np.array([p.aside for p in guess.effect.parameters])
    if not aside.any():
        return 1.0
    none, all_of_it = sight.cost(()), sight.cost((guess,))
    alone = sight.cost((guess.at(np.where(aside, guess.par, 0.0)),))
    return (alone - all_of_it) / max(none - all_of_it, 1e-9)


def _again(sight: Sight, named: list[Named], weather: tuple[Guess, ...]) -> list[Named]:
    """Reselect each effect given the others, because the first selection ignored later effects."""
    for i in range(len(named)):
        others = [one.found.guess for k, one in enumerate(named) if k != i]
        sight.grant((*weather, *others))
        found = [one for one in best(sight, others) if believable(sight, one.guess)]
        kept = refine(sight, named[i].found.guess)
        if found:
            named[i] = choose(sight, sorted([kept, *found], key=lambda one: -rank(sight, one)))
    return named


def turbulent(sight: Sight) -> tuple[float, float]:
    """Return gain and variance ratio of gusts: sideslip, lift and airspeed scatter more, the sensor channels do not."""
    kept = [CHANNELS.index(name) for name in ("side", "lift", "airspeed")]
    calm = [CHANNELS.index(name) for name in ("gps_x", "gps_y", "gps_z", "gyro_roll", "gyro_pitch", "gyro_yaw")]
    left = sight.left() / sight.base.usual
    ratio = left[kept]
    if ratio.min() < _GUSTS[0] or np.median(ratio) < _GUSTS[1] or left[calm].mean() > _GUSTS[1]:
        return 0.0, 1.0
    rows = int(sight.ok.sum())
    return float(sum(rows * (x - 1 - np.log(x)) for x in ratio)), float(np.median(ratio))
