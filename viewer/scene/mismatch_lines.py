"""Mismatch in the scene: located stretches of the flown path and onset position."""

from math import isfinite

import numpy as np

from fleet.contract import Found, Mismatch
from viewer.scene.strokes import chain
from viewer.store.track import placed
from viewer.text.mismatch_text import spans

MOST_POINTS = 200  # points of a segment


def lines(found: Mismatch | None, track: np.ndarray) -> np.ndarray:
    """Return the located stretches of the flown path as segments (n, 2, 3) [10 m].

    Args:
        mismatch: the latest mismatch
        track: flown path: data time [s], scene ENU [10 m], (m, 4)
    """
    parts = [np.zeros((0, 2, 3))]
    if found is None or found.outcome is Found.NONE or len(track) < 2:
        return parts[0]
    newest, oldest = float(track[-1, 0]), float(track[0, 0])
    for begin, last in spans(found, newest):
        if last > (first := max(begin, oldest)):
            points = placed(track, np.linspace(first, last, min(int(last - first) + 2, MOST_POINTS)))
            parts.append(chain(points[np.isfinite(points).all(axis=1)]))
    return np.concatenate(parts)


def place(found: Mismatch | None, track: np.ndarray) -> np.ndarray | None:
    """Return the position of the mismatch onset, (3,) [10 m]; None when it is unknown."""
    if found is None or found.outcome is Found.NONE or found.onset is None or not isfinite(found.onset):
        return None
    (spot,) = placed(track, np.array([found.onset]))
    return spot if np.isfinite(spot).all() else None
