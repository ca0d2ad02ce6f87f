"""Selected UAV in 3-D: tube, rings, horizon, route, flown path, hindcast, mismatch lines and labels."""

from functools import lru_cache
from math import isfinite
from typing import Any, NamedTuple

import numpy as np

from fleet.contract import DiagnosisOutcome, Mismatch, TwinState
from viewer.scene.labels import CameraView, Tag, overlap
from viewer.scene.routes import NOTHING, RouteLines
from viewer.scene.selection.ghosts import GhostPaths
from viewer.scene.selection.pins import (
    EventMarkers,
    curtain,
    curtain_corners,
    mark_tags,
    marked_look_aheads,
    pass_number,
    path_frame,
    rings,
    sample_paths,
    surface_sides,
    tube_faces,
)
from viewer.scene.strokes import Strokes, chain, circle, closed_loops, dash_lines, dashed
from viewer.store.forecast import PastPrediction, ScenePrediction
from viewer.store.store import FleetStore
from viewer.store.track import positions_at
from viewer.store.vehicle import StatusRecord, Vehicle
from viewer.text.words import (
    fit_text,
    horizon_text,
    is_located,
    lag_text,
    located_spans,
    lost_text,
    short_text,
)
from viewer.theme.palette import Palette, mix, rgb
from viewer.theme.shapes import digit_strokes, face_camera

MAX_CLAIM = 40  # length of the text of an alternative path [characters]
ALTERNATIVE_STEPS, ALTERNATIVE_RINGS = 24, 5  # of an alternative path: steps between rings, and rings
MAX_NUMBERS = 60  # items up to which numbers are drawn
NUMBER_SIZE, NUMBER_SHIFT = 0.36, 0.34  # height of a number and its offset from the item [drawn spans of an aircraft]
Parts = list[tuple[np.ndarray, np.ndarray]]  # segments (n, 2, 3) [10 m] and their colour (3,)


def active_seq(vehicle: Vehicle) -> int:
    """Return the active mission item from telemetry, prediction or mission; -1 when unknown."""
    predicted_seq = vehicle.prediction.seq if vehicle.prediction is not None else -1
    mission_seq = vehicle.mission.seq if vehicle.mission is not None else -1
    return next((seq for seq in (vehicle.detector_state.seq, predicted_seq, mission_seq) if seq >= 0), -1)


AGE_S, SPAN_S = 25.0, 5.0  # age of the compared prediction and its tolerance [s]
MIN_REACH_S = 5.0  # shortest stretch drawn [s]
NO_HINDCAST = np.zeros((0, 2, 3)), None


def hindcast(past: list[PastPrediction], trail: np.ndarray, clock: float) -> tuple[np.ndarray, Tag | None]:
    """Return an earlier prediction and error lines to the flown trail every 5 s: segments (k, 2, 3) and a label.

    `past` is oldest first, `trail` (n, 4 or more), `clock` the current data time [s].
    """
    old = [prediction for prediction in past if AGE_S - SPAN_S <= clock - prediction.t <= AGE_S + SPAN_S]
    if not old or len(trail) < 2:
        return NO_HINDCAST
    prediction = min(old, key=lambda candidate: abs(clock - candidate.t - AGE_S))
    reach = min(clock - prediction.t, prediction.horizon_s, float(trail[-1, 0] - prediction.t))  # at most the horizon
    if reach < MIN_REACH_S:
        return NO_HINDCAST
    at, steps = np.arange(5.0, reach, 5.0), np.linspace(0, reach, 2 * int(reach) + 2)
    actual = np.stack([np.interp(prediction.t + at, trail[:, 0], trail[:, i]) for i in (1, 2, 3)], axis=-1)
    points = prediction.position_at(np.concatenate([steps, at, [0.4 * reach]]))  # at once: each call maps the path
    lines = np.concatenate([dashed(points[: len(steps)]), np.stack([points[len(steps) : -1], actual], axis=1)])
    return lines, Tag("then", f"predicted {clock - prediction.t:.0f} s ago", points[-1])


BANDS, BAND_STEPS = 5, 20  # fading bands of the tube, slices per band
FINE_STEPS, TURN_SHARE = 360, 0.65  # steps in which turns are measured; share of the slices that follows them [-]
NEAR_OPACITY, FAR_OPACITY = 0.42, 0.05  # of the tube where it is narrow, and at least
LATE_SHARE = 0.3  # of this opacity that remains at the horizon [-]
TUBE_SHADE = 0.7  # share of the tube colour in its surface, as the lights of the scene brighten it
NARROW = 0.5  # half-axis up to which the tube has its full opacity; beyond it fades in proportion [drawn spans]
MARK_STEP_S = 0.5  # step of the path in which passes through one place are counted [s]
BEYOND_S = 20.0  # look-ahead of the grey dashes beyond the horizon [s]
SHORTEST_S = 0.2  # shortest stretch of tube drawn before the horizon [s]
SAMPLES = 6  # sample paths


def _show(node: Any, *, visible: bool) -> None:
    if node.visible != visible:
        node.visible = visible


class Marks(NamedTuple):
    """Rings of the tube at marked look-aheads and at the horizon, as drawn."""

    forecast: ScenePrediction
    steps: list[float]  # marked look-aheads [s]
    horizon_s: float
    sections: np.ndarray  # corners of the rings, the last at the horizon, (n, SIDES, 3) [10 m]


class Selection:
    """Nodes of the selected UAV on one page."""

    def __init__(self, scene: Any, palette: Palette) -> None:
        self._scene, self._palette = scene, palette
        faces = tube_faces(BAND_STEPS + 1)
        flat = np.zeros((int(faces.max()) + 1, 3), np.float32)
        self._bands = [self._mesh(f"/selected/band{b}", (flat, faces), NEAR_OPACITY, "front") for b in range(BANDS)]
        steps = BANDS * BAND_STEPS + 1
        self._curtain = self._mesh("/selected/curtain", curtain(np.zeros((steps, 3)), 0.0), 0.10, "double")
        self._thin = Strokes(scene, "/selected/thin", 1.3)
        self._track = Strokes(scene, "/selected/flown", 1.6)
        self._mismatch = Strokes(scene, "/selected/mismatch", 5.5)
        self._bold = Strokes(scene, "/selected/bold", 2.6)
        self._horizon = Strokes(scene, "/selected/horizon", 4.0)
        self._route = Strokes(scene, "/selected/route", 1.6)
        self._leg = Strokes(scene, "/selected/leg", 3.0)
        self._event_markers = EventMarkers(scene, palette)
        self._ghosts = GhostPaths(scene, palette)
        self._trail_start = np.inf  # start of the bright newest stretch of the path [s since 1970]
        self._track_colour = mix(palette.actual, palette.ground, 0.5)
        self._ground, self._unit = 0.0, 1.0  # height of the ground, drawn span of an aircraft [10 m]
        self._label_boxes: list[np.ndarray] = []  # labels shown last
        self._hidden_numbers = np.zeros(0, bool)  # items whose number a label covers
        self._marks: Marks | None = None  # as drawn
        self._drawn_route: tuple[Vehicle, RouteLines, CameraView, float] | None = None
        self.tube = True
        self.tags: list[Tag] = []  # moving labels
        self.marks: list[Tag] = []  # labels at fixed positions

    def _mesh(self, name: str, surface: tuple[np.ndarray, np.ndarray], opacity: float, side: str) -> Any:
        """Add a translucent surface, corners (n, 3) and triangles (m, 3), in a shade below that of the aircraft."""
        vertices, faces = surface
        shade = mix(self._palette.tube, self._palette.ground, TUBE_SHADE).astype(int)
        return self._scene.add_mesh_simple(
            name,
            vertices,
            faces,
            color=tuple(shade.tolist()),
            opacity=opacity,
            side=side,
            cast_shadow=False,
            receive_shadow=False,
            visible=False,
        )

    def clear(self) -> None:
        """Hide everything when no UAV is selected."""
        for strokes in (self._thin, self._track, self._bold, self._horizon, self._mismatch):
            strokes.draw(NOTHING.legs)
        self._hide_tube()
        self._ghosts.clear()
        self.tags, self.marks, self._drawn_route = [], [], None

    def draw(self, vehicle: Vehicle, store: FleetStore, now: float, *, ground: float, unit: float) -> None:
        """Draw the moving content of the UAV; `unit` is the drawn span of an aircraft [10 m]."""
        at, p = vehicle.position(now), self._palette
        if at is None:
            return self.clear()
        clock = vehicle.data_time(now)
        self.tags = [Tag("name", selection_text(vehicle, now), at + np.array([0, 0, 0.85 * unit]), "bottom-center")]
        foot = at * [1, 1, 0] + [0, 0, ground + 0.06]
        bold = [(circle(foot, 1.1 * unit, 40), rgb(p.ink)), (circle(at, 0.85 * unit, 40), rgb(p.ink))]
        thin = [(np.stack([at, foot]), rgb(p.ink))]
        trail = store.trail(vehicle)
        self._trail_start = np.inf
        if len(trail) > 1:
            self._trail_start = trail[0, 0]
            path = np.vstack([trail[::2], trail[-1:]])
            normal = ~is_located(path[:, 0], vehicle.mismatch)[1:]
            bold.append((chain(path[:, 1:4])[normal], rgb(p.actual)))
        self._ground, self._unit = ground, unit
        self._draw_forecast(vehicle, vehicle.record(now), clock, (thin, bold))
        self.tags += self._ghosts.draw(vehicle.open_proposals(), clock)
        lines, label = hindcast(store.past(vehicle), trail, clock)
        thin.append((lines, mix(p.horizon, p.ground, 0.85)))
        self.tags += [label] if label is not None else []
        self._thin.draw_parts(thin)
        self._bold.draw_parts(bold)

    def _draw_forecast(
        self, vehicle: Vehicle, record: StatusRecord, clock: float, strokes: tuple[Parts, Parts]
    ) -> None:
        (thin, bold), forecast, p, ground = strokes, vehicle.forecast, self._palette, self._ground
        if forecast is None:
            return self._hide_tube()
        start, horizon_s = max(clock - forecast.t, 0.0), record.horizon_s
        if not horizon_s:
            self._hide_tube()
            return thin.append((_beyond_horizon(forecast, start), rgb(p.muted)))
        start = min(start, horizon_s - SHORTEST_S)
        at = slice_times(forecast, start, horizon_s)
        path, axes = forecast.position_at(at), forecast.half_axes_at(at)
        frame = path_frame(path)
        sections = rings(path, axes, surface_sides(path, axes, frame), frame)
        opacities = band_opacities(axes, self._unit)
        for b, band in enumerate(self._bands):
            band.vertices = sections[b * BAND_STEPS : (b + 1) * BAND_STEPS + 1].reshape(-1, 3)
            _show(band, visible=self.tube)
            if abs(band.opacity - opacities[b]) > 0.02:
                band.opacity = float(opacities[b])
        self._curtain.vertices = curtain_corners(path, ground)
        _show(self._curtain, visible=self.tube)
        bold.append((chain(path), rgb(p.ink)))
        foot = path * [1, 1, 0] + [0, 0, ground + 0.05]
        thin.append((chain(foot), mix(p.tube, p.ground, 0.5)))
        thin.append((np.stack([path[-1], foot[-1]]), mix(p.horizon, p.ground, 0.5)))
        if self.tube:
            paths = sample_paths(path, axes, SAMPLES, vehicle.uav, frame)
            thin.append((chain(paths), mix(p.tube, p.ground, 0.6)))
        self._draw_marks(forecast, record, start, thin)
        for k, (other, claim) in enumerate(zip(forecast.alternatives, forecast.message.alternatives, strict=True)):
            self._draw_alternative(other, (start, horizon_s), thin)
            text = f"{100 * claim.probability:.0f} %: {claim.sentence.partition(':')[0][:MAX_CLAIM]}"
            self.tags.append(Tag(f"alternative{k}", text, other.position_at(horizon_s), "bottom-left"))
        thin.append((_beyond_horizon(forecast, horizon_s), rgb(p.muted)))

    def _draw_marks(self, forecast: ScenePrediction, record: StatusRecord, start: float, thin: Parts) -> None:
        """Draw rings of the tube at marked look-aheads and at the horizon."""
        p, horizon_s = self._palette, record.horizon_s
        steps = [s for s in marked_look_aheads(horizon_s) if s > start + 1.0][-4:]
        if self._marks is None or self._marks[:3] != (forecast, steps, horizon_s):
            at = np.array([0.0, *steps, horizon_s])
            self._marks = Marks(
                forecast, steps, horizon_s, rings(forecast.position_at(at), forecast.half_axes_at(at))[1:]
            )
            self._horizon.draw(closed_loops(self._marks.sections[-1]), rgb(p.horizon))
        sections = self._marks.sections
        thin.append((closed_loops(sections[:-1]), mix(p.tube, p.ink, 0.7)))
        claim = "below 10 % to the end" if record.horizon_open else "error reaches 10 %"
        top = sections[-1][np.argmax(sections[-1][:, 2])]
        self.tags.append(Tag("horizon", f"horizon {horizon_text(record)}: {claim}", top, "bottom-left"))
        lows = np.array([ring[np.argmin(ring[:, 2])] for ring in sections[:-1]]).reshape(-1, 3)
        path = forecast.position_at(np.arange(start, horizon_s, MARK_STEP_S))
        passes = [pass_number(path, int((step - start) / MARK_STEP_S), self._unit) for step in steps]
        self.tags += mark_tags(steps, lows, passes, self._unit)

    def _draw_alternative(self, other: ScenePrediction, span: tuple[float, float], thin: Parts) -> None:
        """Draw a path that may be flown instead between two look-aheads [s]: dashed, with rings of the region."""
        p, at = self._palette, np.linspace(*span, ALTERNATIVE_STEPS * ALTERNATIVE_RINGS)
        thin.append((dashed(other.position_at(at)), rgb(p.ink)))
        at = at[ALTERNATIVE_STEPS - 1 :: ALTERNATIVE_STEPS]
        thin.append((closed_loops(rings(other.position_at(at), other.half_axes_at(at))), mix(p.tube, p.ink, 0.7)))

    def _hide_tube(self) -> None:
        self._marks = None
        for node in (*self._bands, self._curtain):
            _show(node, visible=False)
        self._horizon.draw(NOTHING.legs)

    def draw_flight(self, vehicle: Vehicle, rows: np.ndarray, now: float, unit: float) -> None:
        """Draw the flown path (n, 4) before its newest stretch, with events and mismatch; `unit` as for `draw`."""
        normal = ~is_located(rows[:, 0], vehicle.mismatch)[1:] & (rows[:-1, 0] < self._trail_start)
        self._track.draw(chain(rows[:, 1:])[normal] if len(rows) > 1 else NOTHING.legs, self._track_colour)
        mismatch = vehicle.mismatch
        self._mismatch.draw(lines(mismatch, rows), rgb(self._palette.mismatch))
        onset = onset_position(mismatch, rows)
        self.marks = self._event_markers.draw(vehicle.events, rows, vehicle.position(now), unit)
        if mismatch is not None and onset is not None:
            self.marks.insert(0, Tag("mismatch", f"▲ {short_text(mismatch)} from here", onset))

    def move_numbers(self, boxes: list[np.ndarray], camera_view: CameraView) -> None:
        """Draw the route again when labels, (2, 2) [image heights], cover other numbers than before."""
        self._label_boxes = boxes
        if self._drawn_route is not None:
            _, route, _, unit = self._drawn_route
            if not np.array_equal(self._hidden_numbers, self._covered(route, camera_view, unit)):
                self.draw_route(*self._drawn_route[:2], camera_view, unit)

    def _covered(self, route: RouteLines, camera_view: CameraView, unit: float) -> np.ndarray:
        """Return a mask (n,) of the items whose number lies in the box of a label."""
        right, up = camera_view.axes()
        size = NUMBER_SIZE * unit
        corners = [np.zeros(3), 2 * size * right + size * up] + NUMBER_SHIFT * unit * (right + up)
        covered = np.zeros(len(route.points), bool)
        for k, point in enumerate(route.points if self._label_boxes else ()):
            number, depth = camera_view.project(point + corners)
            covered[k] = (depth > 0).all() and any(overlap(number, box) for box in self._label_boxes)
        return covered

    def draw_route(self, vehicle: Vehicle, route: RouteLines, camera_view: CameraView, unit: float) -> None:
        """Draw its mission: legs and loiters solid, jumps and returns dashed, a ring and a number at each item.

        The numbers face the camera and give way to labels. The active item and its leg are highlighted. `unit` is as
        for `draw`.
        """
        self._drawn_route = vehicle, route, camera_view, unit
        self._hidden_numbers = self._covered(route, camera_view, unit)
        p, seq = self._palette, active_seq(vehicle)
        right, up = camera_view.axes()
        lines = [
            (np.concatenate([route.legs, route.circles]), mix(p.route, p.ground, 0.7)),
            (dash_lines(route.returns, 1.2 * unit), mix(p.route, p.ground, 0.5)),
        ]
        leg = []
        for point, item, hidden in zip(route.points, route.items.tolist(), self._hidden_numbers, strict=True):
            ring = circle(point, 0.22 * unit, 14)
            if item == seq:
                leg.append((ring, rgb(p.ink)))
            else:
                lines.append((ring, rgb(p.route)))
            if len(route.items) <= MAX_NUMBERS and not hidden:
                number = face_camera(digit_strokes(str(item), NUMBER_SIZE * unit), right, up)
                colour = rgb(p.ink) if item == seq else mix(p.ink, p.route, 0.35)
                lines.append((number + point + NUMBER_SHIFT * unit * (right + up), colour))
        leg.append((route.legs[route.ends == seq], rgb(p.route)))
        self._route.draw_parts(lines)
        self._leg.draw_parts(leg)


def slice_times(forecast: ScenePrediction, start: float, end: float) -> np.ndarray:
    """Return look-aheads of the slices of the tube, (BANDS BAND_STEPS + 1,) [s]: in turns they are closer together."""
    at = np.linspace(start, end, FINE_STEPS + 1)
    legs = np.diff(forecast.position_at(at), axis=0)
    length = np.linalg.norm(legs, axis=1)
    cosine = np.sum(legs[1:] * legs[:-1], axis=1) / np.maximum(length[1:] * length[:-1], 1e-9)
    angle = np.zeros(FINE_STEPS)  # turned along each leg [rad]
    angle[1:] = np.where(length[1:] * length[:-1] > 1e-9, np.arccos(np.clip(cosine, -1, 1)), 0.0)
    weight = (1 - TURN_SHARE) / FINE_STEPS + TURN_SHARE * angle / max(float(angle.sum()), np.pi)
    share = np.concatenate([[0.0], np.cumsum(weight)])
    return np.interp(np.linspace(0, share[-1], BANDS * BAND_STEPS + 1), share, at)


def band_opacities(axes: np.ndarray, unit: float) -> np.ndarray:
    """Return the opacity of each band of the tube, (BANDS,), from its half-axes (BANDS BAND_STEPS + 1, 3) [10 m].

    The near, narrow part is the visible one; a later or wider part is fainter, so that it hides no aircraft or path.
    """
    widths = axes[:-1, 1:].mean(axis=1).reshape(BANDS, BAND_STEPS).mean(axis=1)
    by_width = np.clip(NARROW * unit / np.maximum(widths, 1e-6), 0.0, 1.0)
    return np.clip(NEAR_OPACITY * by_width * np.linspace(1.0, LATE_SHARE, BANDS), FAR_OPACITY, NEAR_OPACITY)


@lru_cache(maxsize=16)
def _beyond_horizon(forecast: ScenePrediction, start: float) -> np.ndarray:
    """Return dashes of the prediction beyond the horizon: (n, 2, 3)."""
    end = min(float(forecast.ahead[-1]), start + BEYOND_S)
    return dashed(forecast.position_at(np.linspace(start, end, 40))) if end > start + 0.5 else np.zeros((0, 2, 3))


def selection_text(vehicle: Vehicle, now: float) -> str:
    """Describe the selected UAV and its status in one line."""
    if vehicle.ended:
        return f"{vehicle.name}  end of the recording"
    record = vehicle.record(now)
    lag = f"  {lag_text(record)}" if record.prediction_lag_s else ""
    if record.state is TwinState.LINK_LOST:
        return f"{vehicle.name}  {lost_text(record)}{lag}"
    horizon = f"  horizon {horizon_text(record)}" if record.horizon_s else "  no horizon"
    return f"{vehicle.name}  fit {fit_text(record)}{horizon if record.prediction_age_s is not None else ''}{lag}"


MAX_POINTS = 200  # points of a segment


def lines(mismatch: Mismatch | None, track: np.ndarray) -> np.ndarray:
    """Return the located stretches of the flown path, (m, 4) data time [s], scene ENU [10 m], as (n, 2, 3) [10 m]."""
    segments = [NOTHING.legs]
    for begin, last in located_spans(mismatch, float(track[-1, 0])) if len(track) > 1 else []:
        if last > (first := max(begin, float(track[0, 0]))):
            points = positions_at(track, np.linspace(first, last, min(int(last - first) + 2, MAX_POINTS)))
            segments.append(chain(points[np.isfinite(points).all(axis=1)]))
    return np.concatenate(segments)


def onset_position(mismatch: Mismatch | None, track: np.ndarray) -> np.ndarray | None:
    """Return the position of the mismatch onset, (3,) [10 m]; None when it is unknown."""
    if mismatch is None or mismatch.outcome is DiagnosisOutcome.NONE:
        return None
    if mismatch.onset is None or not isfinite(mismatch.onset):
        return None
    (point,) = positions_at(track, np.array([mismatch.onset]))
    return point if np.isfinite(point).all() else None
