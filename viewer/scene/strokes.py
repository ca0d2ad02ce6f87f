"""Line segments: one node of many segments, coloured per vertex, updated in place."""

from typing import Any

import numpy as np

from viewer.theme.palette import line_colour

_EMPTY = np.zeros((1, 2, 3), np.float32)  # viser requires at least one segment; this one has zero length


class Strokes:
    """One node of line segments."""

    def __init__(self, scene: Any, name: str, width: float) -> None:
        self._node = scene.add_line_segments(
            name, _EMPTY, np.zeros((1, 2, 3), np.uint8), thickness=width, thickness_units="screen"
        )
        self._is_empty = True
        self._colours: tuple[np.ndarray, int] | None = None  # as last drawn, and of how many segments

    def draw_parts(self, parts: list[tuple[np.ndarray, np.ndarray]]) -> None:
        """Show segments of several colours: pairs of segments (..., 2, 3) [10 m] and their one colour (3,)."""
        lines = [np.zeros((0, 2, 3)), *(segments.reshape(-1, 2, 3) for segments, _ in parts)]
        colours = np.array([colour for _, colour in parts]).reshape(-1, 3)
        self.draw(np.concatenate(lines), np.repeat(colours, [len(part) for part in lines[1:]], axis=0))

    def draw(self, segments: np.ndarray, colours: np.ndarray | None = None) -> None:
        """Show segments (n, 2, 3) [10 m]; colours (3,), (n, 3) or (n, 2, 3), sRGB [0..255]; None keeps them."""
        segments = np.asarray(segments, np.float32).reshape(-1, 2, 3)
        if not len(segments):
            if self._is_empty:
                return
            segments, colours = _EMPTY, np.zeros(3)
        self._is_empty = segments is _EMPTY
        if colours is not None:
            self.colour(colours, len(segments))
        self._node.points = segments

    def colour(self, colours: np.ndarray, n: int) -> None:
        """Colour n segments."""
        colours = np.array(colours, float)
        if self._colours is not None and self._colours[1] == n and np.array_equal(self._colours[0], colours):
            return
        self._colours = colours, n
        if colours.ndim == 2:
            colours = colours[:, None, :]
        self._node.colors = np.broadcast_to(line_colour(colours), (n, 2, 3))

    def show(self, visible: bool) -> None:
        """Show or hide the node."""
        if self._node.visible != visible:
            self._node.visible = visible


def chain(points: np.ndarray) -> np.ndarray:
    """Return the segments between neighbours: (..., n, 3) -> (..., n - 1, 2, 3)."""
    return np.stack([points[..., :-1, :], points[..., 1:, :]], axis=-2)


def smooth_curve(points: np.ndarray, parts: int) -> np.ndarray:
    """Interpolate points (..., n, 3) smoothly in `parts` per step: (..., (n - 1) parts + 1, 3)."""
    if parts < 2 or points.shape[-2] < 2:
        return points
    slope = np.gradient(points, axis=-2)
    s = (np.arange(parts) / parts)[:, None]
    a, b, da, db = (
        x[..., None, :] for x in (points[..., :-1, :], points[..., 1:, :], slope[..., :-1, :], slope[..., 1:, :])
    )
    curve = a + (b - a) * s * s * (3 - 2 * s) + s * (1 - s) * ((1 - s) * da - s * db)
    return np.concatenate([curve.reshape(*points.shape[:-2], -1, 3), points[..., -1:, :]], axis=-2)


def dashed(points: np.ndarray) -> np.ndarray:
    """Return every second segment between neighbours: (n, 3) -> (n // 2, 2, 3)."""
    return chain(points)[::2]


def dash_lines(segments: np.ndarray, length: float) -> np.ndarray:
    """Cut straight segments (n, 2, 3) into dashes of about `length`, at most 200 each: (m, 2, 3)."""
    dashes = []
    for a, b in segments:
        steps = int(np.clip(np.linalg.norm(b - a) / length, 2, 400))
        dashes.append(dashed(a + np.linspace(0, 1, steps + 1)[:, None] * (b - a)))
    return np.concatenate(dashes) if dashes else np.zeros((0, 2, 3))


def faded(colour: np.ndarray, ground: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Return fading segment colours: colour (..., 3), shares (n + 1,) at the points -> (..., n, 2, 3)."""
    joints = colour[..., None, :] * shares[:, None] + ground * (1 - shares[:, None])
    return chain(joints)


def closed_loops(ring: np.ndarray) -> np.ndarray:
    """Return the closed loops of corners (..., sides, 3): (..., sides, 2, 3)."""
    return np.stack([ring, np.concatenate([ring[..., 1:, :], ring[..., :1, :]], axis=-2)], axis=-2)


def circle(centre: np.ndarray, radius: float, sides: int = 48) -> np.ndarray:
    """Return a horizontal circle around a point (3,) as segments: (sides, 2, 3)."""
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    return closed_loops(centre + radius * np.stack([np.cos(turn), np.sin(turn), np.zeros(sides)], axis=-1))
