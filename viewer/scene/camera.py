"""Camera: frames a set of points and follows one."""

from typing import Any

import numpy as np

from viewer.browser.http_server import Browser
from viewer.scene.labels import CameraView

FOV = np.radians(50.0)  # vertical field of view [rad]
IN_VIEW_M = 20_000.0  # points farther from the centre of the fleet are not framed [m]
FOCUS_MARGIN = 1.3  # margin around a focused aircraft for its labels [-]
BOTTOM_SHARE, MAX_BOTTOM_SHARE = 0.12, 0.6  # least and greatest share of the image height left free below [-]
CLOSEST = 5.0  # smallest distance [10 m]
EMPTY_VIEW = 60.0 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)  # framed without UAVs [10 m]
FROM_ABOVE = np.array([0.0, -1e-3, 1.0])  # north is up on the page
SIDE_ELEVATION, CHASE_ELEVATION = np.radians(7.0), np.radians(22.0)  # of the camera [rad]
VIEW_ANGLES = (np.radians(-125.0), np.radians(38.0))  # camera direction: azimuth from east, elevation [rad]


def frame(
    points: np.ndarray,
    aspect: float,
    margin: float = 1.1,
    direction: np.ndarray | None = None,
    bottom_share: float = BOTTOM_SHARE,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the camera position so that every point is in view.

    Args:
        points: points to frame, (n, 3) [10 m]
        aspect: width over height of the image [-]
        margin: relative size of the frame, 1 is tight [-]
        direction: from the points to the camera, (3,); None: `VIEW_ANGLES`
        bottom_share: share of the image height that panels cover from below [-]
    Returns:
        position and look-at, two (3,) [10 m]
    """
    azimuth, elevation = VIEW_ANGLES
    if direction is not None and np.linalg.norm(direction[:2]) > 1e-6:
        azimuth = np.arctan2(direction[1], direction[0])
        elevation = np.arctan2(direction[2], np.linalg.norm(direction[:2]))
    to_camera = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.cross(to_camera, right)
    look_at = (points.min(axis=0) + points.max(axis=0)) / 2
    for _ in range(3):  # centre and distance depend on each other: iterate
        x, y, z = (points - look_at) @ right, (points - look_at) @ up, (points - look_at) @ to_camera
        wide, tall = np.tan(FOV / 2) * aspect, np.tan(FOV / 2) * (1 - bottom_share)
        distance = max(float(np.max(np.maximum(np.abs(x) / wide, np.abs(y) / tall) * margin + z)), CLOSEST)
        depth = distance - z
        look_at = look_at + right * _middle(x / depth) * distance + up * _middle(y / depth) * distance
    position = look_at + to_camera * distance - up * bottom_share * np.tan(FOV / 2) * distance
    ground_distance = (position[2] - float(points[:, 2].mean())) / to_camera[2]  # orbit about the height of the fleet
    return position, position - to_camera * max(ground_distance, CLOSEST / 2)


def _middle(x: np.ndarray) -> float:
    return float(x.min() + x.max()) / 2


def within_reach(points: np.ndarray, reach: float) -> np.ndarray:
    """Return the points (n, 3) within `reach` [10 m] of the most central one, at least one."""
    centre = points[np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1))]
    return points[np.linalg.norm(points - centre, axis=1) < reach]


class Camera:
    """Camera of one page: frames new content until the operator moves it."""

    def __init__(self, browser: Browser) -> None:
        self._client, self._browser = browser.client, browser
        self._placed: np.ndarray | None = None
        self._moved_by_page = False  # camera moved by this page, maybe not yet reported by the client

    @property
    def aspect(self) -> float:
        """Return width over height of the image [-]."""
        camera = self._client.camera
        return camera.image_width / max(camera.image_height, 1) or 1.0

    def view(self) -> CameraView:
        """Return the current camera view."""
        camera, layout = self._client.camera, self._browser.layout
        sides = float(layout.height), float(layout.top), float(layout.bottom)
        return CameraView(np.array(camera.position), np.array(camera.look_at), float(camera.fov), self.aspect, *sides)

    @property
    def bottom_share(self) -> float:
        """Return the share of the image height that panels cover from below [-]."""
        layout = self._browser.layout
        return min(max(layout.bottom / layout.height, BOTTOM_SHARE), MAX_BOTTOM_SHARE)

    def show(self, points: np.ndarray, *, force: bool = False) -> None:
        """Frame the points (n, 3) [10 m]; keep a camera that the operator moved, unless `force`."""
        camera, placed = self._client.camera, self._placed
        moved = placed is not None and np.linalg.norm(camera.position - placed) > 0.01 * np.linalg.norm(placed)
        if (moved or self._moved_by_page) and not force:
            return
        self._moved_by_page = False
        camera.position, camera.look_at = frame(points, self.aspect, bottom_share=self.bottom_share)
        self._placed = np.array(camera.position)

    def fly_to(self, points: np.ndarray) -> None:
        """Frame points (n, 3) [10 m] from the current direction."""
        camera = self._client.camera
        self.look_from(np.array(camera.position) - np.array(camera.look_at), points)

    def look_from(self, direction: np.ndarray, points: np.ndarray) -> None:
        """Frame points (n, 3) [10 m] from a direction, from the points to the camera, (3,)."""
        camera = self._client.camera
        self._moved_by_page = True
        placed = frame(points, self.aspect, FOCUS_MARGIN, direction, self.bottom_share)
        with self._client.atomic():
            camera.position, camera.look_at = placed

    def follow(self, step: np.ndarray) -> None:
        """Translate by the step (3,) of the followed UAV [10 m]."""
        camera = self._client.camera
        camera.position, camera.look_at = camera.position + step, camera.look_at + step


def direction_from(psi: float, azimuth: float, elevation: float) -> np.ndarray:
    """Return the direction to a camera beside an aircraft, ENU (3,).

    Args:
        psi: heading of the aircraft, clockwise from north [rad]
        azimuth: of the camera from its nose, clockwise; pi is behind it [rad]
        elevation: above the horizontal plane [rad]
    """
    bearing = psi + azimuth
    return np.array([np.sin(bearing) * np.cos(elevation), np.cos(bearing) * np.cos(elevation), np.sin(elevation)])


def set_initial_view(server: Any, points: np.ndarray = EMPTY_VIEW) -> None:
    """Set the initial camera of new pages to frame points (n, 3) [10 m]."""
    start = server.initial_camera
    start.fov, start.near, start.far = FOV, 0.1, 5000.0
    start.position, start.look_at = frame(points, 1.0)
