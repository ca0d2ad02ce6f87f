"""Ground of the scene: grid, range rings with distances, sky."""

from typing import Any

import numpy as np

from viewer.scene.strokes import Strokes, chain, circle
from viewer.store.place import UNIT_M
from viewer.theme.palette import Palette, rgb
from viewer.theme.shapes import digit_strokes

RINGS_M = (500, 1000, 2000, 5000, 10_000)
GRIDS = ((100, 1_200, 0.5), (500, 6_000, 1.0), (5_000, 30_000, 1.0))  # spacing [m], extent [m], strength [-]
PARTS = 6  # segments of a fading grid line


class GroundGrid:
    """Ground grid of one page at the estimated ground height."""

    def __init__(self, scene: Any, palette: Palette) -> None:
        self.height = 0.0  # scene [10 m]
        share = np.clip(np.linspace(0, 3, 256), 0, 1)[:, None, None] ** 0.7  # sky in the upper third, ground below
        sky = rgb(palette.sky[0]) * (1 - share) + rgb(palette.ground) * share
        scene.set_background_image(np.repeat(sky, 2, axis=1).astype(np.uint8), format="png")
        scene.configure_default_lights(True, cast_shadow=False)
        # No fog: with fog the client fails to draw the outline of a hovered aircraft and loses the frame.
        self._node = scene.add_frame("/env", show_axes=False)
        lines, colours = zip(*[_grid(palette, *grid) for grid in GRIDS], strict=True)
        self.grid = Strokes(scene, "/env/grid", 1.0)
        self.grid.draw(np.concatenate(lines), np.concatenate(colours))
        rings = [circle(np.array([0, 0, 0.02]), m / UNIT_M, 80) for m in RINGS_M]
        Strokes(scene, "/env/rings", 1.2).draw(np.concatenate([*rings, *map(_ring_label, RINGS_M)]), rgb(palette.ring))

    def raise_to(self, height: float) -> None:
        """Move the ground to a height [10 m]."""
        if abs(height - self.height) > 0.05:
            self.height = height
            self._node.position = (0.0, 0.0, height)


def _grid(palette: Palette, spacing: float, reach: float, strength: float) -> tuple[np.ndarray, np.ndarray]:
    """Return grid lines that fade outwards, (n, 2, 3) [10 m], and the colours of their ends, (n, 2, 3).

    The built-in grid is too slow for software rendering. `spacing` and `reach` are in metres.
    """
    offsets = np.arange(-reach, reach + 1, spacing) / UNIT_M
    along = np.linspace(-reach, reach, PARTS + 1) / UNIT_M
    x, y = np.meshgrid(along, offsets)
    lines = chain(np.stack([x, y, np.zeros_like(x)], axis=-1)).reshape(-1, 2, 3)
    lines = np.concatenate([lines, lines[..., [1, 0, 2]]])
    distance = np.clip(np.linalg.norm(lines, axis=-1) * UNIT_M / reach, 0, 1)[..., None]
    share = strength * (1 - distance) ** 0.8
    return lines, share * rgb(palette.section) + (1 - share) * rgb(palette.ground)


def _ring_label(metres: int) -> np.ndarray:
    """Return the strokes of a ring's distance, inside its southern edge: (n, 2, 3)."""
    height = 0.035 * metres / UNIT_M + 0.8
    corner = np.array([0.4 * height, -metres / UNIT_M + 0.4 * height, 0.02])
    return digit_strokes(f"{metres / 1000:g} km", height) + corner
