"""Event markers of the selected UAV on its flown path, and the tube around its predicted path."""

from functools import lru_cache
from typing import Any

import numpy as np

from viewer.scene.labels import Tag
from viewer.store.inbox import time_of_day
from viewer.store.track import positions_at
from viewer.theme.events import EventKind, TimelineEvent, clip
from viewer.theme.palette import Palette, mesh_colour, rgb
from viewer.theme.shapes import diamond

MAX_MARKERS = 40  # newest markers on the path
MAX_LABELS = 3  # more labels would overlap
MAX_TEXT = 26  # characters of a label
CLEARANCE = 3.0  # distance of a label to the aircraft and other labels [drawn spans of an aircraft]
RADIUS = 0.22  # marker radius [drawn spans of an aircraft]
# frequent kinds: smaller, without label
MINOR_KINDS = {EventKind.ITEM, EventKind.MISSION, EventKind.ACCEPTED, EventKind.UNVERIFIED}
MODEL_KINDS = {EventKind.VERIFIED, EventKind.NO_MODEL}  # the label shows only the text before the colon


class EventMarkers:
    """Markers of one UAV: a mesh batch of fixed size."""

    def __init__(self, scene: Any, palette: Palette) -> None:
        self._palette = palette
        vertices, faces = diamond()
        self._batch = scene.add_batched_meshes_simple(
            "/selected/events",
            vertices,
            faces,
            np.tile([1.0, 0.0, 0.0, 0.0], (MAX_MARKERS, 1)),
            np.zeros((MAX_MARKERS, 3)),
            batched_scales=np.zeros(MAX_MARKERS, np.float32),
            batched_colors=np.zeros((MAX_MARKERS, 3), np.uint8),
            lod="off",
            flat_shading=True,
            cast_shadow=False,
            receive_shadow=False,
        )

    def draw(
        self, events: tuple[TimelineEvent, ...], rows: np.ndarray, at: np.ndarray | None, size: float
    ) -> list[Tag]:
        """Draw events, oldest first, on the flown path (n, 4); return the labels of the newest few.

        `at` is the drawn position of the aircraft, (3,), and `size` its drawn span [10 m].
        """
        points = positions_at(rows, np.array([event.t for event in events]))
        located = [(event, point) for event, point in zip(events, points, strict=True) if np.isfinite(point).all()]
        located.sort(key=lambda entry: entry[0].kind not in MINOR_KINDS)  # major events take precedence
        located = located[-MAX_MARKERS:]
        positions, colours = np.zeros((MAX_MARKERS, 3)), np.zeros((MAX_MARKERS, 3))
        scales = np.zeros(MAX_MARKERS, np.float32)
        for k, (event, point) in enumerate(located):
            positions[k], colours[k] = point, rgb(self._palette.event(event.kind))
            scales[k] = RADIUS * size * (0.6 if event.kind in MINOR_KINDS else 1.0)
        self._batch.batched_positions, self._batch.batched_scales = positions, scales
        self._batch.batched_colors = mesh_colour(colours)
        above = np.array([0.0, 0.0, 0.9 * RADIUS * size])
        return [
            Tag(f"event{event.t}{event.kind}", event_text(event), point + above, "bottom-center")
            for event, point in labelled_events(located, at, CLEARANCE * size)
        ]


def labelled_events(
    located: list[tuple[TimelineEvent, np.ndarray]], at: np.ndarray | None, clearance: float
) -> list[tuple[TimelineEvent, np.ndarray]]:
    """Return the events with a label: the newest, `clearance` [10 m] apart and from the drawn aircraft `at`, (3,)."""
    selected: list[tuple[TimelineEvent, np.ndarray]] = []
    taken = [] if at is None else [at]
    for event, point in reversed(located):
        is_clear = all(np.linalg.norm(point - other) > clearance for other in taken)
        if event.kind not in MINOR_KINDS and is_clear:
            selected.append((event, point))
            taken.append(point)
        if len(selected) == MAX_LABELS:
            break
    return selected


def event_text(event: TimelineEvent) -> str:
    """Describe an event in one short line."""
    text = event.text.split(":")[0] if event.kind in MODEL_KINDS else event.text
    return f"{event.kind.glyph} {clip(text, MAX_TEXT)} {time_of_day(event.t)}"


SIDES = 28  # corners of one ring
_TURN = np.linspace(0, 2 * np.pi, SIDES, endpoint=False)[None, :]
_COS, _SIN = np.cos(_TURN), np.sin(_TURN)
TURN_STEPS = 4  # slices before and after a point over which its turn is measured
HOVER = 0.1  # shorter distance within these slices is no flight [10 m]
INNER_SHARE = 0.9  # of the radius of a turn that the surface reaches inwards [-]
BAND_SIGMA = 2.1  # half-axes of the simultaneous 90 % region in standard deviations


def path_frame(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the cross and vertical unit vectors along a path (n, 3): two (n, 3); hovering keeps the last direction."""
    run = np.gradient(path, axis=0) if len(path) > 1 else np.zeros_like(path)
    flat = run * [1.0, 1.0, 0.0]
    length = np.linalg.norm(flat, axis=1)
    moving = length > 1e-6
    index = np.maximum.accumulate(np.where(moving, np.arange(len(path)), 0))
    if not moving.any():
        flat, length = np.tile([1.0, 0.0, 0.0], (len(path), 1)), np.ones(len(path))
    elif not moving[0]:
        index[: int(np.argmax(moving))] = int(np.argmax(moving))
    ahead = flat[index] / length[index][:, None]
    cross = np.stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(path))], axis=-1)
    along = np.where(np.linalg.norm(run, axis=1)[index, None] > 1e-6, run[index], ahead)
    along = along / np.linalg.norm(along, axis=1)[:, None]
    x, y, z = along.T
    cross_x, cross_y = cross[:, 0], cross[:, 1]
    return cross, np.stack([-z * cross_y, z * cross_x, x * cross_y - y * cross_x], axis=-1)  # along x cross


PathFrame = tuple[np.ndarray, np.ndarray]
"""Cross and vertical unit vectors along a path, as of `path_frame`."""


def rings(
    path: np.ndarray, axes: np.ndarray, sides: np.ndarray | None = None, frame: PathFrame | None = None
) -> np.ndarray:
    """Return the cross-sections (n, SIDES, 3) of the tube around a path (n, 3) with half-axes (n, 3) [10 m].

    `sides` are half-axes to the left and to the right, (n, 2) [10 m]; None: the half-axis across the path for both.
    `frame` is that of the path where it is known.
    """
    cross, up = frame or path_frame(path)
    left, right = (axes[:, 1], axes[:, 1]) if sides is None else sides.T
    across = _COS * np.where(_COS > 0, left[:, None], right[:, None])
    return path[:, None] + across[..., None] * cross[:, None] + _SIN[..., None] * (axes[:, 2, None] * up)[:, None]


def surface_sides(path: np.ndarray, axes: np.ndarray, frame: PathFrame | None = None) -> np.ndarray:
    """Return the half-axes left and right of a path (n, 3) at which its surface is drawn: (n, 2) [10 m].

    Towards the inside of a turn cross-sections wider than its radius intersect, and their surface would fold: it ends
    before the centre of the turn. Rings at single look-aheads are drawn in full.
    """
    cross, _ = frame or path_frame(path)
    direction = np.unwrap(np.arctan2(-cross[:, 0], cross[:, 1]))  # of the horizontal path, from east [rad]
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1))])
    k = np.arange(len(path))
    before, after = np.maximum(k - TURN_STEPS, 0), np.minimum(k + TURN_STEPS, len(path) - 1)
    turned, moved = direction[after] - direction[before], length[after] - length[before]
    radius = moved / np.maximum(np.abs(turned), 1e-6)
    pace = length[-1] / max(len(path) - 1, 1)
    moves = moved > np.maximum(0.1 * pace * (after - before), HOVER)  # a hovering aircraft makes no turn
    limit = np.where(moves, INNER_SHARE * radius, np.inf)
    inner = np.minimum(axes[:, 1], limit)
    left, right = np.where(turned > 0, inner, axes[:, 1]), np.where(turned < 0, inner, axes[:, 1])
    return np.stack([left, right], axis=-1)


def pass_number(path: np.ndarray, index: int, clearance: float) -> int:
    """Return how often a path (n, 3) has come within `clearance` [10 m] of its point `index`, itself included."""
    near = np.linalg.norm(path[: index + 1] - path[index], axis=1) < clearance
    return 1 + int((near[:-1] & ~near[1:]).sum())


def mark_tags(steps: list[float], lows: np.ndarray, passes: list[int], clearance: float) -> list[Tag]:
    """Return the labels of marked look-aheads, the earliest first; one label for marks at the same place.

    Args:
        steps: marked look-aheads, increasing, k [s]
        lows: their positions, (k, 3) [10 m]
        passes: number of each pass through its place, k
        clearance: distance within which marks share a label [10 m]
    """
    groups: list[list[int]] = []
    for k in range(len(steps)):
        group = next((g for g in groups if np.linalg.norm(lows[g[0]] - lows[k]) < clearance), None)
        groups = [*groups, [k]] if group is None else groups
        if group is not None:
            group.append(k)
    texts = [f"+{step:g} s" + (f" pass {n}" if n > 1 else "") for step, n in zip(steps, passes, strict=True)]
    return [Tag(f"+{steps[g[0]]:g}", ", ".join(texts[k] for k in g), lows[g[0]]) for g in groups]


def tube_faces(n: int) -> np.ndarray:
    """Return the triangles between n rings: (2 (n - 1) SIDES, 3) indices into the flattened corners."""
    near = np.arange(n - 1)[:, None] * SIDES + np.arange(SIDES)
    next_ = np.arange(n - 1)[:, None] * SIDES + (np.arange(SIDES) + 1) % SIDES
    halves = [np.stack([near, next_, near + SIDES], -1), np.stack([next_, next_ + SIDES, near + SIDES], -1)]
    return np.concatenate([half.reshape(-1, 3) for half in halves]).astype(np.uint32)


def curtain(path: np.ndarray, ground: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a vertical surface from a path to the ground: corners (2 n, 3), triangles (2 (n - 1), 3)."""
    k = np.arange(len(path) - 1) * 2
    faces = np.concatenate([np.stack([k, k + 1, k + 2], -1), np.stack([k + 1, k + 3, k + 2], -1)])
    return curtain_corners(path, ground), faces.astype(np.uint32)


def curtain_corners(path: np.ndarray, ground: float) -> np.ndarray:
    """Return the corners of the curtain of a path (n, 3): (2 n, 3) [10 m]."""
    foot = path * [1.0, 1.0, 0.0] + [0.0, 0.0, ground]
    return np.stack([path, foot], axis=1).reshape(-1, 3)


def marked_look_aheads(horizon_s: float) -> list[float]:
    """Return the look-aheads to mark [s]: those with enough distance to the horizon."""
    return [step for step in (5, 10, 20, 30, 60, 120) if step < horizon_s - max(2.0, 0.12 * horizon_s)]


def sample_paths(path: np.ndarray, axes: np.ndarray, n: int, seed: int, frame: PathFrame | None = None) -> np.ndarray:
    """Sample paths that the tube around a path (k, 3) with half-axes (k, 3) [10 m] contains: (n, k, 3).

    Cross and vertical offsets are standard normal in units of the half-axes over `BAND_SIGMA` and rotate slowly into
    a second pair, so that errors are correlated along the path. A constant seed per UAV avoids flicker.
    """
    cross, up = frame or path_frame(path)
    begin, end = _standard_normal(seed, n)
    turn = np.linspace(0.0, 0.9, len(path))
    offset = (np.cos(turn) * begin + np.sin(turn) * end) / BAND_SIGMA
    return path + offset[:, 0, :, None] * (axes[:, 1, None] * cross) + offset[:, 1, :, None] * (axes[:, 2, None] * up)


@lru_cache(maxsize=16)
def _standard_normal(seed: int, n: int) -> np.ndarray:
    """Return the normal numbers of n sample paths: start and end of cross and vertical offsets, (2, n, 2, 1)."""
    return np.random.default_rng(seed).standard_normal((2, n, 2, 1))
