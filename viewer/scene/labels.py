"""Labels in 3-D by priority, without overlap; labels of UAVs with an alert."""

from math import hypot, tan
from typing import Any, NamedTuple

import numpy as np

from fleet.contract import TwinState
from viewer.scene.fleet_arrays import LOST, MISMATCH, FleetArrays, display_status
from viewer.store.vehicle import Vehicle
from viewer.text.words import in_force, lost_text, severity, short_text
from viewer.theme.palette import STATE_STYLE

MAX_LABELS = 8
SCALE = 0.92  # font scale of every label: one size, as the page rasterises each size separately
EM_PX = 12.0 * SCALE  # font size, independent of the window [CSS px]. Source: viser 1.1, LabelRenderer.tsx
CHAR_EM, PADDING_EM, LINE_EM = 0.56, 1.0, 1.8  # widest mean advance of a label, padding of its box, its height [em]
EDGE_PX = 4.0  # margin to the edge of the visible part of the image [CSS px]
_SHIFT = {"bottom": 0.0, "top": -1.0, "left": 0.0, "center": -0.5, "right": -1.0}  # anchor to low corner [label sizes]
_ANCHORS = {  # anchors to try in turn
    "bottom-left": ("bottom-left", "bottom-right", "top-left", "top-right"),
    "top-left": ("top-left", "top-right", "bottom-left", "bottom-right"),
    "bottom-center": ("bottom-center", "top-center", "bottom-left", "bottom-right"),
    "top-center": ("top-center", "bottom-center", "top-left", "top-right"),
}


class Tag(NamedTuple):
    """Label text at a position."""

    key: str  # identity, so that the label keeps its node
    text: str
    at: np.ndarray  # (3,) [10 m]
    anchor: str = "top-center"


class Labels:
    """The label nodes of one page."""

    def __init__(self, scene: Any) -> None:
        self._nodes = [
            scene.add_label(f"/labels/{k}", "", font_screen_scale=SCALE, depth_test=False, visible=False)
            for k in range(MAX_LABELS)
        ]
        self._assigned: dict[str, Any] = {}  # key -> node
        self.boxes: list[np.ndarray] = []  # corners of the labels shown, (2, 2) [image heights]

    def draw(self, tags: list[Tag], camera_view: "CameraView") -> None:
        """Show the labels that fit, in order of priority."""
        shown, self.boxes = visible_labels(tags, camera_view)
        for key in self._assigned.keys() - {tag.key for tag in shown}:
            self._assigned.pop(key).visible = False
        free = iter([node for node in self._nodes if not any(node is used for used in self._assigned.values())])
        for tag in shown:
            if tag.key not in self._assigned:
                self._assigned[tag.key] = next(free)
            node = self._assigned[tag.key]
            for name, value in (("text", tag.text), ("anchor", tag.anchor), ("visible", True)):
                if getattr(node, name) != value:
                    setattr(node, name, value)
            node.position = tuple(tag.at.tolist())


class CameraView(NamedTuple):
    """View of a camera: position, direction and field of view."""

    position: np.ndarray  # (3,) [10 m]
    look_at: np.ndarray  # (3,) [10 m]
    fov: float  # vertical [rad]
    aspect: float  # width over height [-]
    height_px: float = 720.0  # height of the image [CSS px]
    top_px: float = 0.0  # covered by the legend [CSS px]
    bottom_px: float = 0.0  # covered by a panel [CSS px]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project points (n, 3): right and up of the image centre in image heights, (n, 2), and depth (n,)."""
        offsets = points - self.position
        right, up, depth = (offsets @ axis for axis in self._directions())
        flat = np.stack([right, up], axis=-1)
        return flat / (2 * tan(self.fov / 2) * np.maximum(depth, 1e-3)[:, None]), depth

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the image directions right and up, two (3,)."""
        right, up, _ = self._directions()
        return right, up

    def _directions(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the directions right, up and forward of the image, three (3,)."""
        x, y, z = (self.look_at - self.position).tolist()
        length = hypot(x, y, z) or 1.0
        level = hypot(x, y) or 1.0
        right_x, right_y, z = y / level, -x / level, z / length
        up_x, up_y, up_z = right_y * z, -right_x * z, (right_x * y - right_y * x) / length  # right x forward
        forward = -up_z * right_y, up_z * right_x, up_x * right_y - up_y * right_x  # up x right
        return np.array([right_x, right_y, 0.0]), np.array([up_x, up_y, up_z]), np.array(forward)


def visible_labels(tags: list[Tag], camera_view: CameraView) -> tuple[list[Tag], list[np.ndarray]]:
    """Return the labels inside the visible part of the image without overlap, at most `MAX_LABELS`, and their boxes."""
    if not tags:
        return [], []
    points, depth = camera_view.project(np.array([tag.at for tag in tags]))
    shown: list[Tag] = []
    boxes: list[Box] = []
    height = camera_view.height_px
    half = camera_view.aspect / 2 - EDGE_PX / height
    lowest = -0.5 + (camera_view.bottom_px + EDGE_PX) / height
    highest = 0.5 - (camera_view.top_px + EDGE_PX) / height
    for tag, point, label_depth in zip(tags, points.tolist(), depth.tolist(), strict=True):
        for anchor in _ANCHORS[tag.anchor] if label_depth > 0 else ():
            box = (left, low), (right, high) = _box(tag.text, anchor, point, height)
            inside = left >= -half and low >= lowest and right <= half and high <= highest
            if inside and not any(overlap(box, other) for other in boxes):
                shown.append(tag._replace(anchor=anchor))
                boxes.append(box)
                break
        if len(shown) == MAX_LABELS:
            break
    return shown, [np.array(box) for box in boxes]


Box = tuple[tuple[float, float], tuple[float, float]]
"""Low and high corner of a label, each right and up [image heights]."""


def overlap(box: Box | np.ndarray, other: Box | np.ndarray) -> bool:
    """Return whether two boxes, low and high corner (2, 2), overlap."""
    return all(bool(box[0][k] < other[1][k] and other[0][k] < box[1][k]) for k in (0, 1))


def _box(text: str, anchor: str, point: list[float], height_px: float) -> Box:
    """Return the corners of a label at a point of the image, (2,) [image heights]."""
    width, height = (CHAR_EM * len(text) + PADDING_EM) * EM_PX / height_px, LINE_EM * EM_PX / height_px
    vertical, horizontal = anchor.split("-")
    left, low = point[0] + _SHIFT[horizontal] * width, point[1] + _SHIFT[vertical] * height
    return (left, low), (left + width, low + height)


MAX_ALERT_LABELS = 6  # most labels at once; overlapping ones are omitted


def alert_labels(fleet_arrays: FleetArrays, shown: dict[int, Vehicle], selected: int | None, unit: float) -> list[Tag]:
    """Return labels at the most severe UAVs.

    `shown` are the snapshots in the panels, by UAV; `unit` is the drawn span of an aircraft [10 m].
    """
    listed = [(shown.get(v.uav, v), i) for v, i in fleet_arrays.exceptional if v.uav != selected and not v.ended]
    exceptional = [(v, i) for v, i in listed if display_status(v, fleet_arrays.now) in (MISMATCH, LOST)]
    rows = sorted(exceptional, key=lambda entry: severity(entry[0], fleet_arrays.now))[:MAX_ALERT_LABELS]
    above = np.array([0.0, 0.0, 0.9 * unit])
    return [
        Tag(
            f"uav{v.uav}",
            f"▲ {v.name}" if fleet_arrays.large_fleet else alert_text(v, fleet_arrays.now),
            fleet_arrays.at[i] + above,
            "bottom-center",
        )
        for v, i in rows
    ]


def alert_text(vehicle: Vehicle, now: float) -> str:
    """Describe the problems of a UAV in a short label."""
    record = vehicle.record(now)
    if record.state is TwinState.LINK_LOST:
        return f"{STATE_STYLE[TwinState.LINK_LOST][0]} {vehicle.name} {lost_text(record)}"
    kinds = ", ".join(dict.fromkeys(alert.kind.value.replace("_", " ") for alert in vehicle.alerts.values()))
    if vehicle.mismatch is not None and in_force(vehicle.mismatch):
        kinds = ", ".join(filter(None, (short_text(vehicle.mismatch), kinds)))
    return f"▲ {vehicle.name} {kinds}"
