"""One fault: what it is, of which part, how much, and since when."""

from collections.abc import Mapping
from math import cos, inf, pi
from typing import NamedTuple


class Fault(NamedTuple):
    """One fault of one aircraft."""

    name: str  # in `kinds.KINDS`
    of: str  # the part: a surface, an axis; empty where there is but one
    values: Mapping[str, float]  # its parameters, units in their names; faults are told apart by identity
    t0: float = 0.0  # begins [s since the flight began]
    ramp_s: float = 0.0  # grows for so long; of what passes: the length of either edge [s]
    t1: float = inf  # is over [s]

    def __hash__(self) -> int:
        """Tell faults apart."""
        return id(self)

    def share(self, t: float) -> float:
        """Return how much of it is there at `t` [s]: 0 nothing, 1 all.

        It steps or grows in a straight line; what passes rises and falls as (1 - cos) / 2.
        """
        if not self.t0 <= t < self.t1:
            return 0.0
        if self.t1 < inf:
            edge = self.ramp_s or (self.t1 - self.t0) / 2
            near = min(t - self.t0, self.t1 - t) / edge
            return (1 - cos(pi * min(near, 1.0))) / 2
        return min((t - self.t0) / self.ramp_s, 1.0) if self.ramp_s > 0 else 1.0
