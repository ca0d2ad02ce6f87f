"""Selected UAV in 3-D: tube, rings, horizon, route, flown path, hindcast and labels."""

from typing import Any

import numpy as np

from fleet.contract import State
from viewer.scene import mismatch_lines
from viewer.scene.labels import Sight, Tag
from viewer.scene.routes import NOTHING, Route
from viewer.scene.selection.hindcast import hindcast
from viewer.scene.selection.pins import Pins
from viewer.scene.selection.plan import Plan, seq_in_force
from viewer.scene.selection.tube import curtain, marks, rings, samples, skin
from viewer.scene.strokes import Sheaf, Strokes, chain, closed, dashed, disc
from viewer.store.forecast import Forecast
from viewer.store.store import Feed
from viewer.store.vehicle import Vehicle
from viewer.text import mismatch_text
from viewer.text.words import CLAIMS_S, fit
from viewer.theme.palette import Palette, mix, rgb, triple

BANDS, BAND_STEPS = 5, 12  # fading bands of the tube, slices per band
BEYOND_S = 20.0  # look-ahead of the grey dashes beyond the horizon [s]
SAMPLES, SAMPLE_STEPS = 6, 40  # sample paths, points per path


class Selection:
    """Nodes of the selected UAV on one page."""

    def __init__(self, scene: Any, palette: Palette) -> None:
        self._scene, self._palette = scene, palette
        faces = skin(BAND_STEPS + 1)
        flat = np.zeros((int(faces.max()) + 1, 3), np.float32)
        self._bands = [
            self._sheet(f"/selected/band{b}", flat, faces, 0.34 * (1.2 - 0.2 * b), palette.tube) for b in range(BANDS)
        ]
        steps = BANDS * BAND_STEPS + 1
        self._curtain = self._sheet("/selected/curtain", *curtain(np.zeros((steps, 3)), 0.0), 0.10, palette.tube)
        self._thin = Strokes(scene, "/selected/thin", 1.3)
        self._flown = Strokes(scene, "/selected/flown", 1.6)
        self._mismatch = Strokes(scene, "/selected/mismatch", 5.5)
        self._bold = Strokes(scene, "/selected/bold", 2.6)
        self._horizon = Strokes(scene, "/selected/horizon", 4.0)
        self._pins, self._plan = Pins(scene, palette), Plan(scene, palette)
        self._since = np.inf  # start of the bright newest stretch of the path [s since 1970]
        self._flown_colour = mix(palette.flown, palette.ground, 0.5)
        self.tube = True
        self.tags: list[Tag] = []  # moving labels
        self.marks: list[Tag] = []  # labels at fixed positions

    def _sheet(self, name: str, vertices: np.ndarray, faces: np.ndarray, opacity: float, colour: str) -> Any:
        return self._scene.add_mesh_simple(
            name,
            vertices,
            faces,
            color=triple(colour),
            opacity=opacity,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
            visible=False,
        )

    def clear(self) -> None:
        """Hide everything when no UAV is selected."""
        for strokes in (self._thin, self._flown, self._bold, self._horizon, self._mismatch):
            strokes.draw(NOTHING.legs)
        self._hide_tube()
        self.tags, self.marks = [], []

    def draw(self, vehicle: Vehicle, feed: Feed, now: float, *, ground: float, unit: float) -> None:
        """Draw the moving content of the UAV; `unit` is the drawn span of an aircraft [10 m]."""
        at, p = vehicle.where(now), self._palette
        if at is None:
            return self.clear()
        thin, bold, clock = Sheaf(), Sheaf(), vehicle.clock(now)
        self.tags = [Tag("name", caption(vehicle, now), at + np.array([0, 0, 0.85 * unit]), "bottom-center")]
        foot = at * [1, 1, 0] + [0, 0, ground + 0.06]
        bold.add(closed(disc(foot, 1.1 * unit)), rgb(p.ink))
        bold.add(closed(disc(at, 0.85 * unit)), rgb(p.ink))
        thin.add(np.stack([at, foot]), rgb(p.ink))
        trail = feed.trail(vehicle)
        self._since = trail[0, 0] if len(trail) > 1 else np.inf
        if len(trail) > 1:
            own = np.vstack([trail[::2], trail[-1:]])
            sound = ~mismatch_text.within(own[:, 0], vehicle.mismatch)[1:]
            bold.add(chain(own[:, 1:4])[sound], rgb(p.flown))
        self._draw_forecast(vehicle, clock, ground, thin, bold)
        lines, said = hindcast(feed.past(vehicle), trail, clock)
        thin.add(lines, mix(p.horizon, p.ground, 0.85))
        self.tags += [said] if said is not None else []
        self._thin.draw(*thin.all())
        self._bold.draw(*bold.all())

    def _draw_forecast(self, vehicle: Vehicle, clock: float, ground: float, thin: Sheaf, bold: Sheaf) -> None:
        told, p = vehicle.forecast, self._palette
        start = max(clock - told.t, 0.0) if told is not None else 0.0
        if told is None or start >= told.until - 0.2:
            return self._no_tube(told, start, thin)
        until = told.until
        at = np.linspace(start, until, BANDS * BAND_STEPS + 1)
        path, axes = told.at(at), told.width(at)
        hoops = rings(path, axes)
        for b, band in enumerate(self._bands):
            band.vertices = hoops[b * BAND_STEPS : (b + 1) * BAND_STEPS + 1].reshape(-1, 3)
            band.visible = self.tube
        self._curtain.vertices, self._curtain.visible = curtain(path, ground)[0], self.tube
        bold.add(chain(path), rgb(p.ink))
        foot = path * [1, 1, 0] + [0, 0, ground + 0.05]
        thin.add(chain(foot), mix(p.tube, p.ground, 0.5))
        thin.add(np.stack([path[-1], foot[-1]]), mix(p.horizon, p.ground, 0.5))
        if self.tube:
            some = np.linspace(start, until, SAMPLE_STEPS)
            drawn = samples(told.at(some), told.width(some), SAMPLES, vehicle.uav)
            thin.add(chain(drawn), mix(p.tube, p.ground, 0.6))
        self._draw_marks(told, start, thin)
        thin.add(_beyond(told, until), rgb(p.muted))

    def _draw_marks(self, told: Forecast, start: float, thin: Sheaf) -> None:
        """Draw rings of the tube at marked look-aheads and at the horizon."""
        p, until = self._palette, told.until
        steps = [s for s in marks(until) if s > start + 1.0][-4:]
        hoop = rings(told.at(np.array([0.0, *steps, until])), told.width(np.array([0.0, *steps, until])))[1:]
        thin.add(closed(hoop[:-1]), mix(p.tube, p.ink, 0.7))
        self._horizon.draw(closed(hoop[-1]), rgb(p.horizon))
        said = "below 10 % to the end" if told.message.horizon_open else "error reaches 10 %"
        top = hoop[-1][np.argmax(hoop[-1][:, 2])]
        self.tags.append(Tag("horizon", f"horizon {until:.0f} s: {said}", top, "bottom-left"))
        lows = [ring[np.argmin(ring[:, 2])] for ring in hoop[:-1]]
        self.tags += [Tag(f"+{s:g}", f"+{s:g} s", low) for s, low in zip(steps, lows, strict=True)]

    def _hide_tube(self) -> None:
        for node in (*self._bands, self._curtain):
            node.visible = False
        self._horizon.draw(NOTHING.legs)

    def _no_tube(self, told: Forecast | None, start: float, thin: Sheaf) -> None:
        """Hide band and horizon; draw a path without horizon as grey dashes."""
        self._hide_tube()
        if told is not None:
            thin.add(_beyond(told, start), rgb(self._palette.muted))

    def draw_flight(self, vehicle: Vehicle, rows: np.ndarray, now: float, unit: float) -> None:
        """Draw the flown path (n, 4) before its newest stretch, with events and mismatch; `unit` as for `draw`."""
        sound = ~mismatch_text.within(rows[:, 0], vehicle.mismatch)[1:] & (rows[:-1, 0] < self._since)
        self._flown.draw(chain(rows[:, 1:])[sound] if len(rows) > 1 else NOTHING.legs, self._flown_colour)
        found = vehicle.mismatch
        self._mismatch.draw(mismatch_lines.lines(found, rows), rgb(self._palette.mismatch))
        begun = mismatch_lines.place(found, rows)
        self.marks = self._pins.draw(vehicle.events, rows, vehicle.where(now), unit)
        if found is not None and begun is not None:
            self.marks.insert(0, Tag("mismatch", f"▲ {mismatch_text.short(found)} from here", begun))

    def draw_route(self, vehicle: Vehicle, route: Route, sight: Sight, unit: float) -> None:
        """Draw its mission; numbers face the camera."""
        self._plan.draw(route, seq_in_force(vehicle), sight, unit)


def _beyond(told: Forecast, start: float) -> np.ndarray:
    """Return dashes of the prediction beyond the horizon: (n, 2, 3)."""
    end = min(float(told.ahead[-1]), start + BEYOND_S)
    return dashed(told.at(np.linspace(start, end, 40))) if end > start + 0.5 else np.zeros((0, 2, 3))


def caption(vehicle: Vehicle, now: float) -> str:
    """Describe the selected UAV and its status in one line."""
    told = vehicle.forecast
    if told is None:
        horizon = "  no prediction yet"
    else:
        horizon = f"  horizon {told.until:.0f} s" if told.until >= CLAIMS_S else "  no horizon"
    if late := vehicle.late(now):
        horizon = f"  prediction {late:.0f} s old"
    if vehicle.ended:
        return f"{vehicle.name}  end of the recording"
    lost = f"  link lost {vehicle.age(now):.0f} s" if vehicle.state(now) is State.LINK_LOST else ""
    mean = fit(vehicle)
    return vehicle.name + (lost or (f"  fit {mean:.0f} %" if mean is not None else "") + horizon)
