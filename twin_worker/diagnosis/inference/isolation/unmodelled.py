"""Is anything left that no effect of the catalogue explains: has an equation itself changed, or does it hum?

For each channel every coefficient of its equation is let go at once, and the channel's own slow and fast terms beside
it: since any instant, and since any instant against what they were before it. A named effect that is right leaves
nothing to gain; one that only resembles what happened leaves much. And what no effect stands for is tried against the
names themselves: a single coefficient that explains as much as they do is the better word.
"""

from collections.abc import Sequence
from typing import NamedTuple

from twin_worker.diagnosis.inference.isolation.changed import equations_of
from twin_worker.diagnosis.inference.isolation.tones import tones
from twin_worker.diagnosis.inference.isolation.whitened_residuals import Sight
from twin_worker.diagnosis.model.baseline import Baseline


class Rule(NamedTuple):
    """When one kind of evidence counts.

    Attributes:
        least: gain
        chance: over what nominal flights reach by chance
        against: so many limits, to be held against names; and
        beside, loud: so much of what they gained, the latter where some channel stays loud
    """

    least: float
    chance: float
    against: float
    beside: float
    loud: float


RULES = {
    "odd": Rule(450.0, 3.0, 2.0, 0.5, 0.25),  # the whole equation is another, beside the names
    "shift": Rule(240.0, 2.4, 1.5, 0.05, 0.05),  # it changed in flight, beside the names
    "one": Rule(165.0, 3.0, 1.0, 0.9, 0.9),  # one coefficient changed, instead of the names
    "tone": Rule(200.0, 2.0, 1.0, 0.0, 0.0),  # it hums, beside the names
}


class Odd(NamedTuple):
    """What a changed equation would gain beyond its price, in which channel, since when [s]; or how loud it hums."""

    worth: float
    channel: str
    t0: float
    rule: str = "odd"
    term: str = ""

    @property
    def kind(self) -> str:
        """Name it beside what nominal flights reach by chance."""
        return ":".join(filter(None, (self.rule, self.channel, self.term)))

    def limit(self, base: Baseline) -> float:
        """Return what it must gain to be more than chance."""
        rule = RULES[self.rule]
        return max(rule.least, rule.chance * base.chance.get(self.kind, 0.0))

    def counts(self, base: Baseline, gained: float, loud: bool) -> bool:
        """Return whether names that gained so much in all, 0 without any, do not explain it."""
        rule = RULES[self.rule]
        least = (rule.loud if loud else rule.beside) * gained
        return self.worth > max((rule.against if gained else 1.0) * self.limit(base), least)


def oddities(sight: Sight, plain: Sight) -> list[Odd]:
    """Return what every channel would gain by changing since its best instant, and how it hums; best first.

    Plain telemetry knows its equations too loosely to tell.

    Args:
        sight: with the names granted
        plain: the same with none of them
    """
    if not sight.base.vane:
        return []
    held = sight.held()  # no nuisance handed over
    out = [Odd(*tone, "tone") for tone in tones(held)]
    for one in equations_of(held):
        for rule, (worth, t0) in (("odd", one.all_of_it()), ("shift", one.in_flight())):
            out.append(Odd(worth, one.channel, t0, rule))
    for one in equations_of(plain):
        out += [Odd(worth, one.channel, t0, "one", name) for name, (worth, t0) in one.one_by_one()]
    return sorted(out, key=lambda odd: -odd.worth)


def strange(odds: Sequence[Odd], base: Baseline, gained: float, loud: bool) -> Odd | None:
    """Return first that names do not explain; `gained` by them in all, 0 without any; `loud`: a channel stays so."""
    return next((odd for odd in odds if odd.counts(base, gained, loud)), None)
