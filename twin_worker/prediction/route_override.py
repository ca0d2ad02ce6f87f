"""What is flown instead of what is on board: the synchronised controller goes over to another route and parameters."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from fleet.autopilots import arduplane, laws
from fleet.contract import Item
from fleet.frames import Origin
from fleet.mission import VA_C, Route, route

_STILL = 0.5  # slower than this it stands [m/s]


@dataclass(frozen=True)
class Instead:
    """What a question has instead, from the start of the prediction on.

    Attributes:
        items: mission
        seq: item flown to first
        asked: autopilot parameters
        anew: begin at `seq` from where the aircraft is, though it may already be flying that item
        speed: through the air at the start, of what hovers over ground [m/s]; None: as it is
        first: number of the first item to fly, as for `fleet.mission.route`
    """

    items: tuple[Item, ...]
    seq: int
    asked: Mapping[str, float] = field(default_factory=dict)
    anew: bool = False
    speed: float | None = None
    first: int = 1

    def way(self, origin: Origin, received: Mapping[str, float]) -> Route:
        """Lay the route."""
        return route(self.items, seq=self.seq, origin=origin, params={**received, **self.asked}, first=self.first)

    def at_speed(self, velocity: np.ndarray, psi: float = 0.0) -> np.ndarray:
        """Return a velocity (3,) [m/s] the speed asked for; of one who stands the nose tells the direction [rad]."""
        if self.speed is None:
            return velocity
        now = float(np.linalg.norm(velocity))
        along = velocity / now if now > _STILL else np.array([np.cos(psi), np.sin(psi), 0.0])
        return self.speed * along


def gone_over(
    ctl: np.ndarray, was: np.ndarray, par: np.ndarray, legs: np.ndarray, begin: tuple[bool, np.ndarray]
) -> np.ndarray:
    """Return controller's state on another route: filters and integrators stay, and the leg where it is the same one.

    Args:
        ctl, was: synchronised state, and the legs it is on
        par, legs: parameters and legs from now on
        begin: whether the leg begins anew in any case, and where the aircraft is, NED, (3,) [m]
    """
    out, (anew, p) = ctl.copy(), begin
    rest = [column for column in range(legs.shape[1]) if column != VA_C]
    out[arduplane.LEG] = 0
    if anew or not np.array_equal(was[int(ctl[arduplane.LEG]), rest], legs[0, rest]):
        laws.begin(out, par, legs, 0, p)
        return out
    again = ctl.copy()
    arduplane.set_leg(again, par, legs, 0, ctl[arduplane.FROM])
    out[arduplane.TURN] = again[arduplane.TURN]
    return out
