"""In 3-D: what happened after the time shown, and how far from what was predicted then."""

from typing import Any

import numpy as np

from viewer.scene.strokes import Strokes, chain
from viewer.theme.palette import Palette, mix, rgb
from viewer.timeline import compare
from viewer.timeline.past import Past

AFTER_S = 60.0  # how much of the flight after the time shown is drawn, at least what answers the prediction [s]
NOTHING = np.zeros((0, 2, 3))


class After:
    """Two nodes: the path flown since, and whiskers from what was predicted to it."""

    def __init__(self, scene: Any, palette: Palette) -> None:
        self._palette = palette
        self._flown = Strokes(scene, "/timeline/flown", 2.2)
        self._whiskers = Strokes(scene, "/timeline/whiskers", 1.6)
        self._drawn = False

    def draw(self, past: Past | None) -> list[compare.Miss]:
        """Draw what happened after a UAV's time shown; None clears it. Give the misses."""
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
