"""Event markers of the selected UAV on its flown path, with labels for the newest few."""

from typing import Any

import numpy as np

from viewer.scene.labels import Tag
from viewer.store.received.datatime import moment
from viewer.store.track import placed
from viewer.theme.events import Event, Kind
from viewer.theme.palette import MARK, Palette, mesh_colour, rgb
from viewer.theme.shapes import diamond

PINS = 40  # newest markers on the path
LABELS = 3  # more labels would overlap
LETTERS = 26  # characters of a label
CLEAR = 3.0  # distance of a label to the aircraft and other labels [drawn spans of an aircraft]
RADIUS = 0.22  # marker radius [drawn spans of an aircraft]
MINOR = {Kind.ITEM, Kind.MISSION, Kind.SOUND, Kind.DOUBTED}  # frequent: smaller, without label
MODEL = {Kind.VERIFIED, Kind.NO_MODEL}  # the label shows only the text before the colon


class Pins:
    """Markers of one UAV: a mesh batch of fixed size."""

    def __init__(self, scene: Any, palette: Palette) -> None:
        self._palette = palette
        vertices, faces = diamond()
        self._batch = scene.add_batched_meshes_simple(
            "/selected/events",
            vertices,
            faces,
            np.tile([1.0, 0.0, 0.0, 0.0], (PINS, 1)),
            np.zeros((PINS, 3)),
            batched_scales=np.zeros(PINS, np.float32),
            batched_colors=np.zeros((PINS, 3), np.uint8),
            lod="off",
            flat_shading=True,
            cast_shadow=False,
            receive_shadow=False,
        )

    def draw(self, events: tuple[Event, ...], rows: np.ndarray, at: np.ndarray | None, size: float) -> list[Tag]:
        """Draw events at their positions; return the labels of the newest few.

        Args:
            events: oldest first
            rows: the flown path, (n, 4) time [s] and scene ENU [10 m]
            at: drawn position of the aircraft, (3,) [10 m]
            size: drawn span of an aircraft [10 m]
        """
        spots = placed(rows, np.array([event.t for event in events]))
        found = [(event, spot) for event, spot in zip(events, spots, strict=True) if np.isfinite(spot).all()]
        found = sorted(found, key=lambda one: one[0].kind not in MINOR)[-PINS:]  # major events take precedence
        where, scales, colours = np.zeros((PINS, 3)), np.zeros(PINS, np.float32), np.zeros((PINS, 3))
        for k, (event, spot) in enumerate(found):
            where[k], colours[k] = spot, rgb(self._palette.event(event.kind))
            scales[k] = RADIUS * size * (0.6 if event.kind in MINOR else 1.0)
        self._batch.batched_positions, self._batch.batched_scales = where, scales
        self._batch.batched_colors = mesh_colour(colours)
        above = np.array([0.0, 0.0, 0.9 * RADIUS * size])
        return [
            Tag(f"event{event.t}{event.kind}", caption(event), spot + above, "bottom-center")
            for event, spot in apart(found, at, CLEAR * size)
        ]


def apart(found: list[tuple[Event, np.ndarray]], at: np.ndarray | None, clear: float) -> list[tuple[Event, np.ndarray]]:
    """Return the events with a label: the newest with clearance to the aircraft and each other.

    Args:
        located: events with positions (3,) [10 m], oldest first
        at: drawn position of the aircraft, (3,) [10 m]; None when it is not drawn
        clearance: shortest distance [10 m]
    """
    chosen: list[tuple[Event, np.ndarray]] = []
    taken = [] if at is None else [at]
    for event, spot in reversed(found):
        if len(chosen) < LABELS and event.kind not in MINOR and all(np.linalg.norm(spot - x) > clear for x in taken):
            chosen.append((event, spot))
            taken.append(spot)
    return chosen


def caption(event: Event) -> str:
    """Describe an event in one short line."""
    text = event.text.split(":")[0] if event.kind in MODEL else event.text
    text = text if len(text) <= LETTERS else text[: LETTERS - 1] + "…"
    return f"{MARK[event.kind]} {text} {moment(event.t)}"
