"""Event markers of the selected UAV on its flown path, with labels for the newest few."""

from typing import Any

import numpy as np

from viewer.scene.labels import Tag
from viewer.store.received.datatime import time_of_day
from viewer.store.track import positions_at
from viewer.theme.events import EventKind, TimelineEvent
from viewer.theme.palette import MARK, Palette, mesh_colour, rgb
from viewer.theme.shapes import diamond

MAX_MARKERS = 40  # newest markers on the path
MAX_LABELS = 3  # more labels would overlap
MAX_TEXT = 26  # characters of a label
CLEARANCE = 3.0  # distance of a label to the aircraft and other labels [drawn spans of an aircraft]
RADIUS = 0.22  # marker radius [drawn spans of an aircraft]
MINOR_KINDS = {
    EventKind.ITEM,
    EventKind.MISSION,
    EventKind.ACCEPTED,
    EventKind.UNVERIFIED,
}  # frequent: smaller, without label
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
        """Draw events at their positions; return the labels of the newest few.

        Args:
            events: oldest first
            rows: the flown path, (n, 4) time [s] and scene ENU [10 m]
            at: drawn position of the aircraft, (3,) [10 m]
            size: drawn span of an aircraft [10 m]
        """
        points = positions_at(rows, np.array([event.t for event in events]))
        located = [(event, point) for event, point in zip(events, points, strict=True) if np.isfinite(point).all()]
        located = sorted(located, key=lambda entry: entry[0].kind not in MINOR_KINDS)[
            -MAX_MARKERS:
        ]  # major events take precedence
        positions, scales, colours = (
            np.zeros((MAX_MARKERS, 3)),
            np.zeros(MAX_MARKERS, np.float32),
            np.zeros((MAX_MARKERS, 3)),
        )
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
    """Return the events with a label: the newest with clearance to the aircraft and each other.

    Args:
        located: events with positions (3,) [10 m], oldest first
        at: drawn position of the aircraft, (3,) [10 m]; None when it is not drawn
        clearance: shortest distance [10 m]
    """
    selected: list[tuple[TimelineEvent, np.ndarray]] = []
    taken = [] if at is None else [at]
    for event, point in reversed(located):
        if (
            len(selected) < MAX_LABELS
            and event.kind not in MINOR_KINDS
            and all(np.linalg.norm(point - x) > clearance for x in taken)
        ):
            selected.append((event, point))
            taken.append(point)
    return selected


def event_text(event: TimelineEvent) -> str:
    """Describe an event in one short line."""
    text = event.text.split(":")[0] if event.kind in MODEL_KINDS else event.text
    text = text if len(text) <= MAX_TEXT else text[: MAX_TEXT - 1] + "…"
    return f"{MARK[event.kind]} {text} {time_of_day(event.t)}"
