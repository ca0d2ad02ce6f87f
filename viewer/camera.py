"""Where to stand: frames a set of points, and follows one."""

from typing import Any

import numpy as np

FOV = np.radians(50.0)  # vertical field of view [rad]
CLOSEST = 5.0  # no nearer, however little there is to see [10 m]
VIEW = (np.radians(-125.0), np.radians(38.0))  # where the camera stands: azimuth from east, elevation [rad]


def frame(points: np.ndarray, aspect: float, margin: float = 1.1) -> tuple[np.ndarray, np.ndarray]:
    """Place the camera so that every point is in view.

    Args:
        points: what to see, (n, 3) [10 m]
        aspect: width over height of the picture [-]
        margin: room round the points, 1 is none [-]
    Returns:
        position and look-at, two (3,) [10 m]
    """
    azimuth, elevation = VIEW
    to_eye = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.cross(to_eye, right)
    look_at = (points.min(axis=0) + points.max(axis=0)) / 2
    for _ in range(3):  # centring by what is seen moves the distance a little, and the other way round
        x, y, z = (points - look_at) @ right, (points - look_at) @ up, (points - look_at) @ to_eye
        tall = np.tan(FOV / 2)
        distance = float(np.max(np.maximum(np.abs(x) / (tall * aspect), np.abs(y) / tall) * margin + z))
        distance = max(distance, CLOSEST)
        depth = distance - z
        look_at = look_at + right * _middle(x / depth) * distance + up * _middle(y / depth) * distance
    eye = look_at + to_eye * distance
    sink = (eye[2] - float(points[:, 2].mean())) / to_eye[2]  # orbit about the fleet, not about a point underground
    return eye, eye - to_eye * max(sink, CLOSEST / 2)


def _middle(x: np.ndarray) -> float:
    return float(x.min() + x.max()) / 2


class Cameras:
    """The cameras of all who watch: framed once things appear, left alone as soon as someone moves theirs."""

    def __init__(self, server: Any) -> None:
        self._server = server
        self._placed: dict[int, np.ndarray] = {}
        start = server.initial_camera
        start.fov, start.near, start.far = FOV, 0.1, 5000.0

    def watchers(self) -> tuple[tuple[int, float], ...]:
        """Tell who looks, and through what shape of picture: (client, width over height), (n,)."""
        clients = self._server.get_clients().items()
        return tuple(
            (number, round(client.camera.image_width / max(client.camera.image_height, 1), 1))
            for number, client in clients
        )

    def show(self, points: np.ndarray) -> None:
        """Frame the points for everyone who has not moved their camera."""
        position, look_at = frame(points, 1.0)
        self._server.initial_camera.position, self._server.initial_camera.look_at = position, look_at
        clients = self._server.get_clients()
        self._placed = {number: placed for number, placed in self._placed.items() if number in clients}
        for number, client in clients.items():
            camera = client.camera
            placed = self._placed.get(number)
            if placed is not None and np.linalg.norm(camera.position - placed) > 0.01 * np.linalg.norm(placed):
                continue
            aspect = camera.image_width / max(camera.image_height, 1) or 1.0
            position, look_at = frame(points, aspect)
            camera.position, camera.look_at = position, look_at
            self._placed[number] = position

    def fly_to(self, points: np.ndarray) -> None:
        """Turn every camera to some points (n, 3) [10 m], no farther off than it takes to see them all."""
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        enough = 1.6 * float(np.linalg.norm(points - middle, axis=1).max()) / np.tan(FOV / 2) + 30.0
        for client in self._server.get_clients().values():
            away = client.camera.position - client.camera.look_at
            length = float(np.linalg.norm(away)) or 1.0
            client.camera.position = middle + away / length * min(length, enough)
            client.camera.look_at = middle

    def follow(self, step: np.ndarray) -> None:
        """Move every camera along with what it follows, by a step (3,) [10 m]."""
        for client in self._server.get_clients().values():
            position, look_at = client.camera.position + step, client.camera.look_at + step
            client.camera.position, client.camera.look_at = position, look_at
