"""Detect anomalies that no effect in the catalogue explains: a changed equation or a tone.

For each channel all coefficients of its equation are freed, from any onset on, and from any onset relative to the time
before it. A correctly named effect leaves no gain; a wrong one that only resembles the cause leaves much. Single
coefficients without an effect in the catalogue compete with the named effects directly.
"""

from collections.abc import Sequence
from typing import NamedTuple

from twin_worker.diagnosis.inference.isolation.changed import equations_of
from twin_worker.diagnosis.inference.isolation.tones import tones
from twin_worker.diagnosis.inference.isolation.whitened_residuals import Sight
from twin_worker.diagnosis.model.baseline import Baseline


class Rule(NamedTuple):
    """Thresholds of one kind of evidence.

    Attributes:
        min_gain: least gain
        chance_factor: multiple of the gain that nominal flights reach by chance
        limit_factor: multiple of the limit if effects are named
        gain_share, gain_share_high: least share of the gain of the named effects; the latter if a channel stays high
    """

    least: float
    chance: float
    against: float
    beside: float
    loud: float


RULES = {
    "odd": Rule(450.0, 3.0, 2.0, 0.5, 0.25),  # the whole equation changed, given the named effects
    "shift": Rule(240.0, 2.4, 1.5, 0.05, 0.05),  # the equation changed in flight, given the named effects
    "one": Rule(165.0, 3.0, 1.0, 0.9, 0.9),  # one coefficient changed, without the named effects
    "tone": Rule(200.0, 2.0, 1.0, 0.0, 0.0),  # a tone, given the named effects
}


class Odd(NamedTuple):
    """Gain of a changed equation less its cost, or power ratio of a tone, with channel, onset [s], rule and term."""

    worth: float
    channel: str
    t0: float
    rule: str = "odd"
    term: str = ""

    @property
    def kind(self) -> str:
        """Return `rule:channel:term`, the key of `Baseline.chance`."""
        return ":".join(filter(None, (self.rule, self.channel, self.term)))

    def limit(self, base: Baseline) -> float:
        """Return the least gain that exceeds chance."""
        rule = RULES[self.rule]
        return max(rule.least, rule.chance * base.chance.get(self.kind, 0.0))

    def counts(self, base: Baseline, gained: float, loud: bool) -> bool:
        """Return whether the named effects, with total gain `named_gain` (0: none), do not explain the anomaly."""
        rule = RULES[self.rule]
        least = (rule.loud if loud else rule.beside) * gained
        return self.worth > max((rule.against if gained else 1.0) * self.limit(base), least)


def oddities(sight: Sight, plain: Sight) -> list[Odd]:
    """Return the gain of a changed equation and the tone of every channel, best first.

    Without a fast accelerometer the equations are too uncertain: the list is empty.

    Args:
        whitened: residuals conditioned on the named effects
        unconditioned: residuals without the named effects
    """
    if not sight.base.vane:
        return []
    held = sight.held()  # no nuisance released
    out = [Odd(*tone, "tone") for tone in tones(held)]
    for one in equations_of(held):
        for rule, (worth, t0) in (("odd", one.all_of_it()), ("shift", one.in_flight())):
            out.append(Odd(worth, one.channel, t0, rule))
    for one in equations_of(plain):
        out += [Odd(worth, one.channel, t0, "one", name) for name, (worth, t0) in one.one_by_one()]
    return sorted(out, key=lambda odd: -odd.worth)


def strange(odds: Sequence[Odd], base: Baseline, gained: float, loud: bool) -> Odd | None:
    """Return the first anomaly that the named effects do not explain; `still_high`: a channel stays above its limit."""
    return next((odd for odd in odds if odd.counts(base, gained, loud)), None)
