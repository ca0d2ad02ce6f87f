"""One fault: name, part, values and time profile."""

from collections.abc import Mapping
from math import cos, inf, pi
from typing import NamedTuple


class Fault(NamedTuple):
    """One fault of one aircraft."""

    name: str  # in `kinds.KINDS`
    part: str  # surface or axis; empty if there is only one
    values: Mapping[str, float]  # parameters, units in their names; faults compare by identity
    t0: float = 0.0  # onset [s since simulation start]
    ramp_s: float = 0.0  # ramp duration; edge duration of a transient [s]
    t1: float = inf  # end [s]

    def __hash__(self) -> int:
        """Hash by identity."""
        return id(self)

    def intensity(self, t: float) -> float:
        """Return the intensity at `t` [s], 0..1.

        A step or a linear ramp; a transient rises and falls as (1 - cos) / 2.
        """
        if not self.t0 <= t < self.t1:
            return 0.0
        if self.t1 < inf:
            edge = self.ramp_s or (self.t1 - self.t0) / 2
            edge_fraction = min(t - self.t0, self.t1 - t) / edge
            return (1 - cos(pi * min(edge_fraction, 1.0))) / 2
        return min((t - self.t0) / self.ramp_s, 1.0) if self.ramp_s > 0 else 1.0
