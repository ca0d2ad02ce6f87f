"""What everything stands on: grid, range rings with their distances, sky."""

from typing import Any

import numpy as np

from viewer.numerals import written
from viewer.palette import Palette, rgb, triple
from viewer.place import UNIT_M
from viewer.routes import circle
from viewer.strokes import Strokes

RINGS_M = (500, 1000, 2000, 5000, 10_000)


class Ground:
    """The ground of one page: its height follows what is known of it."""

    def __init__(self, scene: Any, palette: Palette) -> None:
        self.height = 0.0  # scene [10 m]
        top, bottom = rgb(palette.sky[0]), rgb(palette.sky[1])
        w = (np.linspace(0, 1, 256) ** 1.2)[:, None, None]
        scene.set_background_image(np.repeat(top * (1 - w) + bottom * w, 2, axis=1).astype(np.uint8), format="png")
        scene.configure_default_lights(True, cast_shadow=False)
        # No fog: with it the client fails to draw the outline of an aircraft under the mouse, and then the whole frame.
        self._node = scene.add_frame("/env", show_axes=False)
        scene.add_grid(
            "/env/grid",
            width=6000.0,
            height=6000.0,
            cell_size=10.0,
            section_size=50.0,
            cell_color=triple(palette.grid),
            section_color=triple(palette.section),
            cell_thickness=0.6,
            section_thickness=1.0,
            plane_color=triple(palette.ground),
            plane_opacity=0.92,
            fade_distance=1500.0,
            fade_strength=1.2,
            shadow_opacity=0.0,
            position=(0.0, 0.0, -0.05),
        )
        rings = [circle(np.array([0, 0, 0.02]), m / UNIT_M, 128) for m in RINGS_M]
        Strokes(scene, "/env/rings", 1.2).draw(np.concatenate([*rings, *map(_distance, RINGS_M)]), rgb(palette.ring))

    def raise_to(self, height: float) -> None:
        """Move the ground to a height [10 m]."""
        if abs(height - self.height) > 0.05:
            self.height = height
            self._node.position = (0.0, 0.0, height)


def _distance(metres: int) -> np.ndarray:
    """Write how far a ring is, flat on the ground inside its southern edge: (n, 2, 3)."""
    tall = 0.035 * metres / UNIT_M + 0.8
    return written(f"{metres / 1000:g} km", tall) + np.array([0.4 * tall, -metres / UNIT_M + 0.4 * tall, 0.02])
