"""Where to stand: frames a set of points, and follows one."""

from typing import Any

import numpy as np

from viewer.scene.labels import Sight

FOV = np.radians(50.0)  # vertical field of view [rad]
IN_VIEW_M = 20_000.0  # what is farther from the middle of the fleet is not framed [m]
CLOSE = 1.3  # room round an aircraft one turns to, for its labels [-]
BELOW = 0.12  # of the picture's height that the timeline takes [-]
CLOSEST = 5.0  # no nearer, however little there is to see [10 m]
NOBODY = 60.0 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)  # seen while nobody is there [10 m]
VIEW = (np.radians(-125.0), np.radians(38.0))  # where the camera stands: azimuth from east, elevation [rad]


def frame(
    points: np.ndarray, aspect: float, margin: float = 1.1, away: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Place the camera so that every point is in view.

    Args:
        points: what to see, (n, 3) [10 m]
        aspect: width over height of the picture [-]
        margin: room round the points, 1 is none [-]
        away: from where to look, as seen from the points, (3,); None: as usual
    Returns:
        position and look-at, two (3,) [10 m]
    """
    azimuth, elevation = VIEW
    if away is not None and np.linalg.norm(away[:2]) > 1e-6:
        azimuth, elevation = np.arctan2(away[1], away[0]), np.arctan2(away[2], np.linalg.norm(away[:2]))
    to_eye = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.cross(to_eye, right)
    look_at = (points.min(axis=0) + points.max(axis=0)) / 2
    for _ in range(3):  # centring by what is seen moves the distance a little, and the other way round
        x, y, z = (points - look_at) @ right, (points - look_at) @ up, (points - look_at) @ to_eye
        wide, tall = np.tan(FOV / 2) * aspect, np.tan(FOV / 2) * (1 - BELOW)
        distance = float(np.max(np.maximum(np.abs(x) / wide, np.abs(y) / tall) * margin + z))
        distance = max(distance, CLOSEST)
        depth = distance - z
        look_at = look_at + right * _middle(x / depth) * distance + up * _middle(y / depth) * distance
    eye = look_at + to_eye * distance - up * BELOW * np.tan(FOV / 2) * distance
    sink = (eye[2] - float(points[:, 2].mean())) / to_eye[2]  # orbit about the fleet, not about a point underground
    return eye, eye - to_eye * max(sink, CLOSEST / 2)


def _middle(x: np.ndarray) -> float:
    return float(x.min() + x.max()) / 2


def near(points: np.ndarray, reach: float) -> np.ndarray:
    """Keep the points (n, 3) within `reach` of the most central one: never none [10 m]."""
    centre = points[np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1))]
    return points[np.linalg.norm(points - centre, axis=1) < reach]


class Camera:
    """The camera of one page: framed once things appear, left alone as soon as someone moves it."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._placed: np.ndarray | None = None
        self._turned = False  # to something: the page may not have told yet that it moved

    @property
    def aspect(self) -> float:
        """Return width over height of the picture [-]."""
        camera = self._client.camera
        return camera.image_width / max(camera.image_height, 1) or 1.0

    def sight(self) -> Sight:
        """Return what it sees now."""
        camera = self._client.camera
        return Sight(np.array(camera.position), np.array(camera.look_at), float(camera.fov), self.aspect)

    def show(self, points: np.ndarray, *, again: bool = False) -> None:
        """Frame the points (n, 3) [10 m]; a camera that was moved stays, unless asked for `again`."""
        camera, placed = self._client.camera, self._placed
        moved = placed is not None and np.linalg.norm(camera.position - placed) > 0.01 * np.linalg.norm(placed)
        if (moved or self._turned) and not again:
            return
        self._turned = False
        camera.position, camera.look_at = frame(points, self.aspect)
        self._placed = np.array(camera.position)

    def fly_to(self, points: np.ndarray) -> None:
        """Turn to some points (n, 3) [10 m] so that all are seen, from the side one looks from."""
        camera = self._client.camera
        self._turned = True
        away = np.array(camera.position) - np.array(camera.look_at)
        camera.position, camera.look_at = frame(points, self.aspect, CLOSE, away)

    def follow(self, step: np.ndarray) -> None:
        """Move along with what it follows, by a step (3,) [10 m]."""
        camera = self._client.camera
        camera.position, camera.look_at = camera.position + step, camera.look_at + step


def start_at(server: Any, points: np.ndarray = NOBODY) -> None:
    """Say where a page that opens from now on looks from; points (n, 3) [10 m] are framed."""
    start = server.initial_camera
    start.fov, start.near, start.far = FOV, 0.1, 5000.0
    start.position, start.look_at = frame(points, 1.0)
