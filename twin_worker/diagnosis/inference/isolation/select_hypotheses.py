"""Name what explains a flight: up to three effects, chosen beside each other, each with what it is not told from."""

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

MOST = 3  # effects named together
_TRIED = 12  # guesses fitted properly at each step
_LEAST, _LEAST_COARSE = 150.0, 400.0  # gain of a first effect, by the accelerometer and without
_CANCEL = 1.5  # an effect that gains this much more beside the others than all together undoes one of them
_SECOND = 250.0  # and of every further one
_NEAR = 0.6  # of the best one's worth, from which an onset is worth a search
_CHANCE, _CHANCE_COARSE = 1.5, 1.2  # over what nominal flights reach by chance
_SHARE, _SHARE_COARSE = 0.03, 0.25  # of what others gain in a channel that may be their error; of the first one's gain
_OWN = 0.1  # share of a gain that must be of numbers which count
_NEXT = 0.02  # tie of which the simpler is chosen
_FINE, _COARSE = (
    0.06,
    0.15,
)  # and of what is not told apart: by the accelerometer; by plain telemetry, whose baseline is wrong by about as much
_GUSTS = 1.2, 1.5  # of the air channels' scatter over the usual: least, median
_LEAST_TIE, _WIDEST_TIE = 20.0, 300.0

Say = Callable[[str], None]


@dataclass(frozen=True)
class Named:
    """One effect found.

    Attributes:
        found: the guess and its gain
        rivals: guesses that explain as much, best first
    """

    found: Found
    rivals: tuple[Found, ...]


def decide(sight: Sight, weather: tuple[Guess, ...], say: Say = lambda word: None) -> tuple[list[Named], list[Found]]:
    """Find what explains the flight, and the first ranking; what `sight` takes for granted changes.

    Args:
        sight: the flight with nothing but its weather granted
        weather: granted throughout
        say: takes words of progress
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
    """What several effects gain together, all reckoned alike."""

    def __init__(self, sight: Sight) -> None:
        self._sight = copy(sight)
        self._none, self._bare = self._sight.cost(()), self._sight.powers(())

    def gain(self, named: list[Named]) -> float:
        """Return the gain of all."""
        return self._none - self._sight.cost([one.found.guess for one in named])

    def borne(self, named: list[Named]) -> np.ndarray:
        """Return what all gain by channel, (c,)."""
        return self._bare - self._sight.powers([one.found.guess for one in named])

    def better(self, more: list[Named], fewer: list[Named]) -> bool:
        """Return whether one more is worth it: together they gain enough, and do not merely cancel each other."""
        gain = self.gain(more)
        without = min(self.gain([one for one in more if one is not left]) for left in more)
        cancelling = gain - without > _CANCEL * gain
        before = self.borne(fewer)
        gained = min(gain - self.gain(fewer), beyond(self._sight, self.borne(more) - before, before))
        return not cancelling and gained > needed(self._sight, fewer, more[-1].found)


class Beside:
    """What a further guess must gain beside those named.

    Args:
        sight: with the named granted
        named: so far
        borne: what they gain by channel, (c,)
    """

    def __init__(self, sight: Sight, named: list[Named], borne: np.ndarray) -> None:
        self._sight, self._named, self._borne = sight, named, borne
        self._before = sight.powers(())

    def earned(self, found: Found) -> bool:
        """Return whether a guess gains what it must, and where the named are not merely wrong."""
        least = needed(self._sight, self._named, found)
        if not self._named or found.gain <= least:
            return found.gain > least
        own = self._before - self._sight.powers((found.guess,))
        return beyond(self._sight, own, self._borne) > least


def beyond(sight: Sight, own: np.ndarray, borne: np.ndarray) -> float:
    """Return what a guess gains beyond errors of those beside it, which are a share of what they gain there.

    Args:
        own, borne: gain of the guess and of the others by channel, (c,)
    """
    share = _SHARE if sight.base.vane else 0.0
    return float(np.maximum(own - share * np.maximum(borne, 0.0), 0.0).sum())


def best(sight: Sight, beside: Sequence[Guess]) -> list[Found]:
    """Scan, and fit the most promising properly; best first."""
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
    # a bump a little early gains next to nothing before it is moved: the scan's word counts too
    near = [max(rank(sight, one), found.worth) > least for one, found in zip(fitted, tried, strict=True)]
    moved = [refine(sight, one.guess) if good else one for one, good in zip(fitted, near, strict=True)]
    return sorted(moved, key=lambda one: -rank(sight, one))


def rank(sight: Sight, found: Found) -> float:
    """Return what a guess is worth: each number beyond the first must earn its price, and its share."""
    extra = found.guess.effect.price - 1
    share = 0.0 if sight.base.vane else _COARSE * extra
    return found.gain * (1.0 - share) - PRICE * found.guess.size


def tie(sight: Sight, found: Found) -> float:
    """Return how much less another guess may be worth and still not be told apart."""
    if not sight.base.vane:
        return max(_LEAST_TIE, _COARSE * found.gain)
    return max(_LEAST_TIE, _NEXT * found.gain, min(_FINE * found.gain, _WIDEST_TIE))


def choose(sight: Sight, found: list[Found]) -> Named:
    """Choose the guess of fewest numbers among the best that tie; the others are its rivals."""
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
    """Return the gain a guess must reach: more than chance, and a share of the first one's."""
    known = sight.base.chance
    chance = _CHANCE_COARSE * known.get(found.kind, 0.0)
    if sight.base.vane:
        chance = _CHANCE * max((x for kind, x in known.items() if _akin(kind, found.guess)), default=0.0)
    least = _LEAST if sight.base.vane else _LEAST_COARSE
    if not named:
        return max(least, chance)
    return max(_SECOND, chance) if sight.base.vane else max(least, chance, _SHARE_COARSE * named[0].found.gain)


def _akin(kind: str, guess: Guess) -> bool:
    """Return whether chance of this kind speaks of a guess too: the same effect, or the same surface."""
    label = kind.partition("|")[0]
    return label == guess.label or (guess.effect.stage is Stage.DELTA and label.endswith(f":{guess.of}"))


def believable(sight: Sight, guess: Guess) -> bool:
    """Return whether a guess is more than data sheets allow a sensor, by numbers of its own that are not absurd."""
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
    """Return the share of a guess's gain that is not of numbers that only come along."""
    aside = np.array([p.aside for p in guess.effect.parameters])
    if not aside.any():
        return 1.0
    none, all_of_it = sight.cost(()), sight.cost((guess,))
    alone = sight.cost((guess.at(np.where(aside, guess.par, 0.0)),))
    return (alone - all_of_it) / max(none - all_of_it, 1e-9)


def _again(sight: Sight, named: list[Named], weather: tuple[Guess, ...]) -> list[Named]:
    """Choose each effect anew with the others granted, for the first choice was made alone."""
    for i in range(len(named)):
        others = [one.found.guess for k, one in enumerate(named) if k != i]
        sight.grant((*weather, *others))
        found = [one for one in best(sight, others) if believable(sight, one.guess)]
        kept = refine(sight, named[i].found.guess)
        if found:
            named[i] = choose(sight, sorted([kept, *found], key=lambda one: -rank(sight, one)))
    return named


def turbulent(sight: Sight) -> tuple[float, float]:
    """Return gain and share of variance of gusts: sideslip, lift and airspeed scatter together, two sensors agree."""
    kept = [CHANNELS.index(name) for name in ("side", "lift", "airspeed")]
    calm = [CHANNELS.index(name) for name in ("gps_x", "gps_y", "gps_z", "gyro_roll", "gyro_pitch", "gyro_yaw")]
    left = sight.left() / sight.base.usual
    ratio = left[kept]
    if ratio.min() < _GUSTS[0] or np.median(ratio) < _GUSTS[1] or left[calm].mean() > _GUSTS[1]:
        return 0.0, 1.0
    rows = int(sight.ok.sum())
    return float(sum(rows * (x - 1 - np.log(x)) for x in ratio)), float(np.median(ratio))
