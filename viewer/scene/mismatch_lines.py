"""Mismatch in the scene: located stretches of the flown path and onset position."""

from math import isfinite

import numpy as np

from fleet.contract import DiagnosisOutcome, Mismatch
from viewer.scene.strokes import chain
from viewer.store.track import positions_at
from viewer.text.mismatch_text import located_spans

MAX_POINTS = 200  # points of a segment


def lines(mismatch: Mismatch | None, track: np.ndarray) -> np.ndarray:
    """Return the located stretches of the flown path as segments (n, 2, 3) [10 m].

    Args:
        mismatch: the latest mismatch
        track: flown path: data time [s], scene ENU [10 m], (m, 4)
    """
    segments = [np.zeros((0, 2, 3))]
    if mismatch is None or mismatch.outcome is DiagnosisOutcome.NONE or len(track) < 2:
        return segments[0]
    newest, oldest = float(track[-1, 0]), float(track[0, 0])
    for begin, last in located_spans(mismatch, newest):
        if last > (first := max(begin, oldest)):
            points = positions_at(track, np.linspace(first, last, min(int(last - first) + 2, MAX_POINTS)))
            segments.append(chain(points[np.isfinite(points).all(axis=1)]))
    return np.concatenate(segments)


def onset_position(mismatch: Mismatch | None, track: np.ndarray) -> np.ndarray | None:
    """Return the position of the mismatch onset, (3,) [10 m]; None when it is unknown."""
    if (
        mismatch is None
        or mismatch.outcome is DiagnosisOutcome.NONE
        or mismatch.onset is None
        or not isfinite(mismatch.onset)
    ):
        return None
    (point,) = positions_at(track, np.array([mismatch.onset]))
    return point if np.isfinite(point).all() else None
