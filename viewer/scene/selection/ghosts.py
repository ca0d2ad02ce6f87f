"""Ghost paths: what the aircraft would fly with each option of the proposals of the selected UAV."""

from typing import Any

import numpy as np

from viewer.scene.labels import Tag
from viewer.scene.selection.pins import rings
from viewer.scene.strokes import Strokes, chain, closed_loops
from viewer.store.forecast import ScenePrediction
from viewer.store.proposal import MAX_OPTIONS, SceneProposal
from viewer.theme.palette import Palette, mix, rgb

STEP_S = 1.0  # step of the drawn paths [s]
RING_STEP_S = 15.0  # between the cross-sections of a region [s]
DASHES = ((1, 0), (3, 2), (1, 1))  # drawn and omitted steps of each option
Parts = list[tuple[np.ndarray, np.ndarray]]  # segments (n, 2, 3) [10 m] and their colour (3,)


class GhostPaths:
    """Node of the options on one page, made for the first: thin lines, of another dash and colour for each option."""

    def __init__(self, scene: Any, palette: Palette) -> None:
        self._scene, self._palette = scene, palette
        self._lines: Strokes | None = None
        self._is_empty = True

    def clear(self) -> None:
        """Hide all options."""
        if self._lines is not None and not self._is_empty:
            self._is_empty = True
            self._lines.draw(np.zeros((0, 2, 3)))

    def draw(self, proposals: list[SceneProposal], clock: float) -> list[Tag]:
        """Draw the valid options at data time `clock` [s since 1970]; return their numbers as labels."""
        parts: Parts = []
        tags: list[Tag] = []
        number = 0
        for proposal in proposals:
            for paths in proposal.paths if proposal.is_valid(clock) else ():
                number += 1
                if number > MAX_OPTIONS:
                    break
                colour = self._palette.option(number)
                for path in paths:
                    parts += _ghost(path, clock, number, (colour, mix(colour, self._palette.ground, 0.45)))
                    tags.append(Tag(f"option{number}-{path.message.uav}", str(number), _middle(path, clock)))
        if not parts:
            self.clear()
            return []
        self._is_empty = False
        self._lines = self._lines or Strokes(self._scene, "/selected/options", 1.6)
        self._lines.draw_parts(parts)
        return tags


def _ghost(
    path: ScenePrediction, clock: float, number: int, colours: tuple[str, np.ndarray]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the dashes of a path and the cross-sections of its region, with their colours."""
    start = max(clock - path.t, float(path.ahead[0]))
    at = np.arange(start, float(path.ahead[-1]), STEP_S)
    if len(at) < 2:
        return []
    marks = at[:: int(RING_STEP_S / STEP_S)][1:]
    drawn, omitted = DASHES[(number - 1) % len(DASHES)]
    segments = chain(path.position_at(at))
    dashes = segments[np.arange(len(segments)) % (drawn + omitted) < drawn]
    colour, region_colour = colours
    full = rgb(colour)
    if not len(marks):
        return [(dashes, full)]
    sections = closed_loops(rings(path.position_at(marks), path.half_axes_at(marks)))
    return [(dashes, full), (sections, region_colour)]


def _middle(path: ScenePrediction, clock: float) -> np.ndarray:
    """Return the position of the number on a path, (3,) [10 m]: halfway to its end."""
    return path.position_at(0.5 * (max(clock - path.t, 0.0) + float(path.ahead[-1])))
