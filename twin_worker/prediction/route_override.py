"""Override of route and parameters, with a bumpless transfer of the synchronised controller."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from fleet.autopilots import arduplane, laws
from fleet.contract import Item
from fleet.frames import Origin
from fleet.mission import VA_C, Route, unroll_route

_STATIONARY_SPEED = 0.5  # stationary below this speed [m/s]


@dataclass(frozen=True)
class RouteOverride:
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
    parameters: Mapping[str, float] = field(default_factory=dict)
    restart_leg: bool = False
    speed: float | None = None
    first_item: int = 1

    def to_route(self, origin: Origin, received: Mapping[str, float]) -> Route:
        """Return the route."""
        return unroll_route(
            self.items, seq=self.seq, origin=origin, params={**received, **self.parameters}, first=self.first_item
        )

    def scale_to_speed(self, velocity: np.ndarray, psi: float = 0.0) -> np.ndarray:
        """Scale a velocity (3,) [m/s] to the requested speed; a stationary aircraft uses the heading `psi` [rad]."""
        if self.speed is None:
            return velocity
        present_speed = float(np.linalg.norm(velocity))
        along = (
            velocity / present_speed if present_speed > _STATIONARY_SPEED else np.array([np.cos(psi), np.sin(psi), 0.0])
        )
        return self.speed * along


def transfer_controller(
    ctl: np.ndarray, old_legs: np.ndarray, par: np.ndarray, legs: np.ndarray, restart: tuple[bool, np.ndarray]
) -> np.ndarray:
    """Return the controller state on another route: filters and integrators stay, an identical leg continues.

    Args:
        ctl, old_legs: synchronised state and its legs
        par, legs: new parameters and legs
        restart: whether to restart the leg unconditionally, and the aircraft position, NED, (3,) [m]
    """
    out, (restart_leg, p) = ctl.copy(), restart
    compared = [column for column in range(legs.shape[1]) if column != VA_C]
    out[arduplane.LEG] = 0
    if restart_leg or not np.array_equal(old_legs[int(ctl[arduplane.LEG]), compared], legs[0, compared]):
        laws.begin(out, par, legs, 0, p)
        return out
    restarted = ctl.copy()
    arduplane.set_leg(restarted, par, legs, 0, ctl[arduplane.FROM])
    out[arduplane.TURN] = restarted[arduplane.TURN]
    return out
