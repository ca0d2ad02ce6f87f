"""Meshes of about one unit, and numerals as line segments."""

import numpy as np


def aircraft() -> tuple[np.ndarray, np.ndarray]:
    """Return a fixed-wing aircraft of one unit span, +x forward: vertices (n, 3), triangles (m, 3)."""
    boxes = [  # centre, half size, sweep of the tip
        ((0.05, 0.0, 0.0), (0.38, 0.045, 0.05), 0.0),
        ((0.08, 0.26, 0.02), (0.09, 0.24, 0.012), 0.07),
        ((0.08, -0.26, 0.02), (0.09, -0.24, 0.012), 0.07),
        ((-0.32, 0.09, 0.03), (0.05, 0.09, 0.01), 0.03),
        ((-0.32, -0.09, 0.03), (0.05, -0.09, 0.01), 0.03),
    ]
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    quads = np.array([(a, b, c, a, c, d) for a, b, c, d in sides]).reshape(-1, 3)
    vertices, faces = [], []
    for k, (centre, half, sweep) in enumerate(boxes):
        box = np.array(centre) + corners * half
        box[:, 0] -= np.where(corners[:, 1] > 0, sweep, 0.0)
        vertices.append(box)
        faces.append((quads if half[1] > 0 else quads[:, ::-1]) + 8 * k)
    n = 8 * len(boxes)
    fin = [[-0.25, 0.01, 0.03], [-0.38, 0.01, 0.03], [-0.40, 0.0, 0.20], [-0.32, 0.0, 0.20]]
    vertices.append(np.array([*fin, [0.58, 0, 0]]))
    faces.append(np.array([(0, 1, 2), (0, 2, 3), (2, 1, 0), (3, 2, 0)]) + n)
    faces.append(np.array([(4, n + 4, 5), (6, n + 4, 4), (7, n + 4, 6), (5, n + 4, 7)]))
    return 1.1 * np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.uint32)


def diamond() -> tuple[np.ndarray, np.ndarray]:
    """Return an octahedron of radius 1: vertices (6, 3), triangles (8, 3)."""
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1.3], [0, 0, -1.3]], np.float32)
    ring = [0, 2, 1, 3]
    faces = [(ring[k], ring[(k + 1) % 4], 4) for k in range(4)] + [(ring[(k + 1) % 4], ring[k], 5) for k in range(4)]
    return vertices, np.array(faces, np.uint32)


def rotorcraft() -> tuple[np.ndarray, np.ndarray]:
    """Return a multirotor of one unit span, +x forward: vertices (n, 3), triangles (m, 3)."""
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    disc = 0.24 * np.stack([np.cos(turn), np.sin(turn), np.zeros(12)], axis=-1)
    fan = np.array([(0, k, k + 1) for k in range(1, 11)])
    body, sides = diamond()
    vertices, faces = [body * [0.2, 0.13, 0.07]], [sides]
    arm = np.array([[0, 0.025, 0], [0, -0.025, 0], [1, -0.025, 0], [1, 0.025, 0]])
    for k, azimuth in enumerate(np.radians([45, 135, 225, 315])):
        c, s = np.cos(azimuth), np.sin(azimuth)
        beam = arm * [0.38, 1, 1] @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        rotor = disc + np.array([0.38 * c, 0.38 * s, 0.04])
        n = 6 + 16 * k
        vertices += [beam, rotor]
        faces += [np.array([(0, 1, 2), (0, 2, 3), (2, 1, 0), (3, 2, 0)]) + n, fan + n + 4, fan[:, ::-1] + n + 4]
    return np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.uint32)


def dart() -> tuple[np.ndarray, np.ndarray]:
    """Return an arrowhead of one unit span, +x forward, for a large fleet: vertices (5, 3), triangles (6, 3)."""
    vertices = np.array([[0.75, 0, 0], [-0.45, 0.42, 0], [-0.45, -0.42, 0], [-0.2, 0, 0.16], [-0.2, 0, -0.06]])
    faces = np.array([(0, 1, 3), (0, 3, 2), (1, 2, 3), (0, 4, 1), (0, 2, 4), (1, 4, 2)])
    return vertices.astype(np.float32), faces.astype(np.uint32)


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
