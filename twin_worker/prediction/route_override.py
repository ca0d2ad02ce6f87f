"""Override of route and parameters, with a bumpless transfer of the synchronised controller."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from fleet.autopilots import arduplane, laws
from fleet.contract import Item
from fleet.frames import Origin
from fleet.mission import VA_C, Route, route

_STILL = 0.5  # stationary below this speed [m/s]


@dataclass(frozen=True)
class Instead:
    """Route, parameters and speed of a what-if query, from the start of the prediction on.

    Attributes:
        items: mission
        seq: first target item
        parameters: autopilot parameters
        restart_leg: start the leg to `seq` at the aircraft position, even if that item is current
        speed: airspeed at the start, ground speed for hovering aircraft [m/s]; None: unchanged
        first_item: number of the first item to fly, as for `fleet.mission.route`
    """

    items: tuple[Item, ...]
    seq: int
    asked: Mapping[str, float] = field(default_factory=dict)
    anew: bool = False
    speed: float | None = None
    first: int = 1

    def way(self, origin: Origin, received: Mapping[str, float]) -> Route:
        """Return the route."""
        return route(self.items, seq=self.seq, origin=origin, params={**received, **self.asked}, first=self.first)

    def at_speed(self, velocity: np.ndarray, psi: float = 0.0) -> np.ndarray:
        """Scale a velocity (3,) [m/s] to the requested speed; a stationary aircraft uses the heading `psi` [rad]."""
        if self.speed is None:
            return velocity
        now = float(np.linalg.norm(velocity))
        along = velocity / now if now > _STILL else np.array([np.cos(psi), np.sin(psi), 0.0])
        return self.speed * along


def gone_over(
    ctl: np.ndarray, was: np.ndarray, par: np.ndarray, legs: np.ndarray, begin: tuple[bool, np.ndarray]
) -> np.ndarray:
    """Return the controller state on another route: filters and integrators stay, an identical leg continues.

    Args:
        ctl, old_legs: synchronised state and its legs
        par, legs: new parameters and legs
        restart: whether to restart the leg unconditionally, and the aircraft position, NED, (3,) [m]
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
