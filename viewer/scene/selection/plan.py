"""Mission of the selected UAV in 3-D: legs, item numbers and the active leg."""

from typing import Any

import numpy as np

from viewer.scene.labels import Sight
from viewer.scene.routes import Route
from viewer.scene.strokes import Sheaf, Strokes, closed, dash_lines, disc
from viewer.store.vehicle import Vehicle
from viewer.theme.numerals import upright, written
from viewer.theme.palette import Palette, mix, rgb

NUMBERS = 60  # items up to which numbers are drawn


class Plan:
    """Two nodes: the route and its active leg."""

    def __init__(self, scene: Any, palette: Palette) -> None:
        self._palette = palette
        self._route = Strokes(scene, "/selected/route", 1.6)
        self._leg = Strokes(scene, "/selected/leg", 3.0)

    def draw(self, route: Route, seq: int, sight: Sight, unit: float) -> None:
        """Draw a route: legs and loiters solid, jumps and returns dashed, a ring and its number at each item.

        Args:
            route: lines of the mission
            seq: active item; -1 when unknown
            camera_view: view that the numbers face
            unit: drawn span of an aircraft [10 m]
        """
        p, lines, leg = self._palette, Sheaf(), Sheaf()
        lines.add(np.concatenate([route.legs, route.circles]), mix(p.route, p.ground, 0.7))
        lines.add(dash_lines(route.back, 1.2 * unit), mix(p.route, p.ground, 0.5))
        for point, item in zip(route.points, route.items.tolist(), strict=True):
            here = item == seq
            (leg if here else lines).add(closed(disc(point, 0.22 * unit, 14)), rgb(p.ink if here else p.route))
            if len(route.items) <= NUMBERS:
                lines.add(self._number(item, point, sight, unit), rgb(p.ink) if here else mix(p.ink, p.route, 0.35))
        leg.add(route.legs[route.ends == seq], rgb(p.route))
        self._route.draw(*lines.all())
        self._leg.draw(*leg.all())

    @staticmethod
    def _number(item: int, point: np.ndarray, sight: Sight, unit: float) -> np.ndarray:
        """Return the strokes of an item number beside its ring, facing the camera: (n, 2, 3)."""
        right, up = sight.axes()
        return upright(written(str(item), 0.42 * unit), right, up) + point + 0.34 * unit * (right + up)


def seq_in_force(vehicle: Vehicle) -> int:
    """Return the active mission item from telemetry, prediction or mission; -1 when unknown."""
    told = vehicle.prediction.seq if vehicle.prediction is not None else -1
    sent = vehicle.mission.seq if vehicle.mission is not None else -1
    return next((seq for seq in (vehicle.known.seq, told, sent) if seq >= 0), -1)
