"""Path flown after the time shown in 3-D, with error lines to the prediction."""

from typing import Any

import numpy as np

from viewer.scene.strokes import Strokes, chain
from viewer.theme.palette import Palette, mix, rgb
from viewer.timeline import compare
from viewer.timeline.past import Past

AFTER_S = 60.0  # shortest path drawn after the time shown; at least to the prediction horizon [s]
NOTHING = np.zeros((0, 2, 3))


class After:
    """Two nodes: the path flown after the time shown, and error lines to the prediction."""

    def __init__(self, scene: Any, palette: Palette) -> None:
        self._palette = palette
        self._flown = Strokes(scene, "/timeline/flown", 2.2)
        self._whiskers = Strokes(scene, "/timeline/whiskers", 1.6)
        self._drawn = False

    def draw(self, past: Past | None) -> list[compare.Miss]:
        """Draw the path after the time shown and return the prediction errors; None clears it."""
        if past is None:
            if self._drawn:
                self._flown.draw(NOTHING)
                self._whiskers.draw(NOTHING)
            self._drawn = False
            return []
        told, self._drawn = past.forecast, True
        reach = max(told.t + told.until - past.then, 0.0) if told is not None else 0.0
        path = past.tape.path(past.then, past.then + max(reach, AFTER_S))
        self._flown.draw(chain(path[:, 1:]), mix(self._palette.verified, self._palette.ground, 0.9))
        if told is None or not len(path):
            self._whiskers.draw(NOTHING)
            return []
        self._whiskers.draw(compare.whiskers(told, path, past.then), rgb(self._palette.horizon))
        return compare.misses(told, path, past.then)
