"""Digits as line segments: numbers in the scene without label nodes."""

import numpy as np

# Each digit on a 2 x 4 grid, as polylines of corners (x, y).
_FIGURES: dict[str, tuple[tuple[tuple[float, float], ...], ...]] = {
    "0": (((0, 0), (2, 0), (2, 4), (0, 4), (0, 0)),),
    "1": (((0.4, 3.2), (1.2, 4), (1.2, 0)),),
    "2": (((0, 4), (2, 4), (2, 2), (0, 2), (0, 0), (2, 0)),),
    "3": (((0, 4), (2, 4), (2, 0), (0, 0)), ((0.5, 2), (2, 2))),
    "4": (((0, 4), (0, 2), (2, 2)), ((2, 4), (2, 0))),
    "5": (((2, 4), (0, 4), (0, 2), (2, 2), (2, 0), (0, 0)),),
    "6": (((2, 4), (0, 4), (0, 0), (2, 0), (2, 2), (0, 2)),),
    "7": (((0, 4), (2, 4), (0.9, 0)),),
    "8": (((0, 0), (2, 0), (2, 4), (0, 4), (0, 0)), ((0, 2), (2, 2))),
    "9": (((2, 2), (0, 2), (0, 4), (2, 4), (2, 0), (0, 0)),),
    ".": (((0.3, 0), (0.7, 0), (0.7, 0.4), (0.3, 0.4), (0.3, 0)),),
    "k": (((0, 0), (0, 4)), ((1.6, 2.6), (0, 1.2), (1.7, 0))),
    "m": (((0, 0), (0, 2.4), (2, 2.4), (2, 0)), ((1, 2.4), (1, 0))),
}
_STEP = {".": 1.4}  # advance width; 3 for the others


def digit_strokes(text: str, height: float) -> np.ndarray:
    """Return the strokes of digits in the ground plane, text direction east: (n, 2, 3); others are spaces."""
    lines, x = [np.zeros((0, 2, 2))], 0.0
    for character in text:
        for stroke in _FIGURES.get(character, ()):
            corners = np.array(stroke) + np.array([x, 0.0])
            lines.append(np.stack([corners[:-1], corners[1:]], axis=1))
        x += _STEP.get(character, 3.0)
    flat = np.concatenate(lines) * (height / 4)
    return np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=-1)


def face_camera(strokes: np.ndarray, right: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Rotate strokes (n, 2, 3) into the plane of `right` and `up`, both (3,): (n, 2, 3)."""
    return strokes[..., :1] * right + strokes[..., 1:2] * up
