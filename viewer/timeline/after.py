"""Path flown after the time shown in 3-D, with error lines to the prediction."""

from typing import Any

import numpy as np

from viewer.scene.strokes import Strokes, chain
from viewer.theme.palette import Palette, mix, rgb
from viewer.timeline import compare
from viewer.timeline.past import PastVehicle

SHOWN_S = 60.0  # shortest path drawn after the time shown; at least to the prediction horizon [s]
NO_LINES = np.zeros((0, 2, 3))


class ActualPath:
    """Two nodes: the path flown after the time shown, and error lines to the prediction."""

    def __init__(self, scene: Any, palette: Palette) -> None:
        self._palette = palette
        self._path = Strokes(scene, "/timeline/flown", 2.2)
        self._error_lines = Strokes(scene, "/timeline/whiskers", 1.6)
        self._drawn = False

    def draw(self, past: PastVehicle | None) -> list[compare.LeadTimeError]:
        """Draw the path after the time shown and return the prediction errors; None clears it."""
        if past is None:
            if self._drawn:
                self._path.draw(NO_LINES)
                self._error_lines.draw(NO_LINES)
            self._drawn = False
            return []
        forecast, self._drawn = past.forecast, True
        horizon_s = max(forecast.t + forecast.horizon_s - past.shown_t, 0.0) if forecast is not None else 0.0
        path = past.recording.path(past.shown_t, past.shown_t + max(horizon_s, SHOWN_S))
        self._path.draw(chain(path[:, 1:]), mix(self._palette.verified, self._palette.ground, 0.9))
        if forecast is None or not len(path):
            self._error_lines.draw(NO_LINES)
            return []
        self._error_lines.draw(compare.error_lines(forecast, path, past.shown_t), rgb(self._palette.horizon))
        return compare.lead_time_errors(forecast, path, past.shown_t)
