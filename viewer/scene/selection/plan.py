"""Mission of the selected UAV in 3-D: legs, item numbers and the active leg."""

from typing import Any

import numpy as np

from viewer.scene.labels import CameraView
from viewer.scene.routes import RouteLines
from viewer.scene.strokes import SegmentBatch, Strokes, circle_corners, closed_loops, dash_lines
from viewer.store.vehicle import Vehicle
from viewer.theme.numerals import digit_strokes, face_camera
from viewer.theme.palette import Palette, mix, rgb

MAX_NUMBERS = 60  # items up to which numbers are drawn


class MissionDrawing:
    """Two nodes: the route and its active leg."""

    def __init__(self, scene: Any, palette: Palette) -> None:
        self._palette = palette
        self._route = Strokes(scene, "/selected/route", 1.6)
        self._leg = Strokes(scene, "/selected/leg", 3.0)

    def draw(self, route: RouteLines, seq: int, camera_view: CameraView, unit: float) -> None:
        """Draw a route: legs and loiters solid, jumps and returns dashed, a ring and its number at each item.

        Args:
            route: lines of the mission
            seq: active item; -1 when unknown
            camera_view: view that the numbers face
            unit: drawn span of an aircraft [10 m]
        """
        p, lines, leg = self._palette, SegmentBatch(), SegmentBatch()
        lines.add(np.concatenate([route.legs, route.circles]), mix(p.route, p.ground, 0.7))
        lines.add(dash_lines(route.returns, 1.2 * unit), mix(p.route, p.ground, 0.5))
        for point, item in zip(route.points, route.items.tolist(), strict=True):
            is_active = item == seq
            (leg if is_active else lines).add(
                closed_loops(circle_corners(point, 0.22 * unit, 14)), rgb(p.ink if is_active else p.route)
            )
            if len(route.items) <= MAX_NUMBERS:
                lines.add(
                    self._number(item, point, camera_view, unit), rgb(p.ink) if is_active else mix(p.ink, p.route, 0.35)
                )
        leg.add(route.legs[route.ends == seq], rgb(p.route))
        self._route.draw(*lines.all())
        self._leg.draw(*leg.all())

    @staticmethod
    def _number(item: int, point: np.ndarray, camera_view: CameraView, unit: float) -> np.ndarray:
        """Return the strokes of an item number beside its ring, facing the camera: (n, 2, 3)."""
        right, up = camera_view.axes()
        return face_camera(digit_strokes(str(item), 0.42 * unit), right, up) + point + 0.34 * unit * (right + up)


def active_seq(vehicle: Vehicle) -> int:
    """Return the active mission item from telemetry, prediction or mission; -1 when unknown."""
    predicted_seq = vehicle.prediction.seq if vehicle.prediction is not None else -1
    mission_seq = vehicle.mission.seq if vehicle.mission is not None else -1
    return next((seq for seq in (vehicle.detector_state.seq, predicted_seq, mission_seq) if seq >= 0), -1)
