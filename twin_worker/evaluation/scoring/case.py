"""One start: what every method said of the seconds to come, and what then happened."""

from dataclasses import dataclass

import numpy as np

from fleet.frames import Origin

OURS = "ours"


@dataclass(frozen=True)
class Told:
    """What one method said at one start.

    Attributes:
        path: NED, (k, 3) [m]
        made_by: what really made it: the method itself, or what stood in for it
        tube: half-axes along, cross, vertical, (k, 3) [m]; None where the method has none
        horizon_s: confidence horizon [s]; nan where the method has none
    """

    path: np.ndarray
    made_by: str
    tube: np.ndarray | None = None
    horizon_s: float = float("nan")


@dataclass(frozen=True)
class Asked:
    """One start, as far as it was known then.

    Attributes:
        flight, uav: whose
        t: when the look-ahead begins [s since 1970]
        first_s: seconds since the first sample [s]
        ahead: look-ahead of every method, rising, (k,) [s]
        origin: of the NED frame of all paths
        speed: over ground, climb included [m/s]
        follows: why no mission was followed, or empty
        group: method / law / vehicle / parameters of ours
        told: by method
        spread: of our ensemble along, cross, vertical, (k, 3) [m]; nan without one
    """

    flight: str
    uav: int
    t: float
    first_s: float
    ahead: np.ndarray
    origin: Origin
    speed: float
    follows: str
    group: str
    told: dict[str, Told]
    spread: np.ndarray


@dataclass(frozen=True)
class Case:
    """One start and what happened.

    Attributes:
        asked: the start
        flown: NED, nan where not known, (k, 3) [m]
        length: path flown so far, at least two seconds of ground speed, (k,) [m]
        phase: climb, level, turn or descent, by what was flown next
        route: mission on board, NED, (n, 3) [m]
        apart: why this start does not count; empty: it counts
    """

    asked: Asked
    flown: np.ndarray
    length: np.ndarray
    phase: str
    route: np.ndarray
    apart: str
