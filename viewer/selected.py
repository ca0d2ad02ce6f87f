"""The selected UAV in 3-D: tube, rings, horizon, route, flown path, hindcast, labels."""

from typing import Any

import numpy as np

from fleet.contract import State
from viewer import mismatch
from viewer.feed import Feed
from viewer.palette import Palette, mix, rgb, triple
from viewer.pins import Pins
from viewer.routes import NOTHING, Route
from viewer.strokes import Strokes, chain, dash_lines, dashed
from viewer.tube import closed, curtain, marks, rings, skin
from viewer.vehicle import Forecast, Vehicle
from viewer.words import CLAIMS_S

BANDS, BAND_STEPS = 4, 20  # the tube fades in bands, each of so many slices
HINDCAST_S = 25.0  # how old the prediction is that is laid beside what happened
BEYOND_S = 20.0  # how far past the horizon the grey dashes go
LABELS = ("name", "horizon", "m0", "m1", "m2", "m3", "then", "mismatch")


class Selection:
    """The nodes of one selected UAV."""

    def __init__(self, server: Any, palette: Palette) -> None:
        self._scene, self._palette = server.scene, palette
        faces = skin(BAND_STEPS + 1)
        flat = np.zeros((int(faces.max()) + 1, 3), np.float32)
        self._bands = [
            self._sheet(f"/selected/band{b}", flat, faces, 0.30 * (1.2 - 0.25 * b), palette.tube) for b in range(BANDS)
        ]
        steps = BANDS * BAND_STEPS + 1
        self._curtain = self._sheet("/selected/curtain", *curtain(np.zeros((steps, 3)), 0.0), 0.09, palette.tube)
        self._thin = Strokes(self._scene, "/selected/thin", 1.4)
        self._flown = Strokes(self._scene, "/selected/flown", 1.6)
        self._pins = Pins(server, palette)
        self._mismatch = Strokes(self._scene, "/selected/mismatch", 4.4)
        self._route = Strokes(self._scene, "/selected/route", 2.0)
        self._bold = Strokes(self._scene, "/selected/bold", 2.7)
        self._horizon = Strokes(self._scene, "/selected/horizon", 3.6)
        self._labels = {name: self._label(name) for name in LABELS}
        self._flown_colour = mix(palette.flown, palette.ground, 0.5)
        self.tube = True
        self._clear_of = 0.0  # room round a label [10 m]

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

    def _label(self, name: str) -> Any:
        scale, anchor = {"name": (0.95, "bottom-center"), "horizon": (0.8, "bottom-left")}.get(
            name, (0.75, "top-center")
        )
        return self._scene.add_label(
            f"/selected/label_{name}", "", font_screen_scale=scale, anchor=anchor, depth_test=False, visible=False
        )

    def say(self, name: str, text: str, at: np.ndarray | None) -> None:
        """Write a label at a place (3,) [10 m]; None hides it."""
        label = self._labels[name]
        label.visible = at is not None
        if at is not None:
            label.text, label.position = text, tuple(float(x) for x in at)

    def clear(self) -> None:
        """Hide everything: nobody is selected."""
        for strokes in (self._thin, self._flown, self._route, self._bold, self._horizon, self._mismatch):
            strokes.draw(NOTHING.legs)
        self._pins.draw((), NOTHING.points, None, 1.0)
        for node in (*self._bands, self._curtain, *self._labels.values()):
            node.visible = False

    def draw(self, vehicle: Vehicle, feed: Feed, now: float, *, ground: float, size: float) -> None:
        """Draw all but the route of one UAV; `size` is the drawn span of an aircraft [10 m]."""
        at, p = vehicle.where(now), self._palette
        if at is None:
            return self.clear()
        thin, bold = _Sheaf(), _Sheaf()
        turn = closed(_disc(at * [1, 1, 0] + [0, 0, ground + 0.06], 1.1 * size))
        bold.add(turn, rgb(p.ink))
        thin.add(np.array([[at, at * [1, 1, 0] + [0, 0, ground]]]), rgb(p.ink))
        trail = feed.trail(vehicle)
        flown = trail[:, 1:4]
        if len(flown) > 1:
            bold.add(chain(np.vstack([flown[::2], flown[-1:]])), rgb(p.flown))
        self._clear_of = 1.4 * size
        self._draw_forecast(vehicle.forecast, vehicle.clock(now), ground, thin, bold)
        self._draw_hindcast(feed.past(vehicle), trail, vehicle.clock(now), thin)
        self._thin.draw(*thin.all())
        self._bold.draw(*bold.all())
        self.say("name", caption(vehicle, now), _above(at, 0.8 * size))

    def _draw_forecast(
        self, told: Forecast | None, clock: float, ground: float, thin: "_Sheaf", bold: "_Sheaf"
    ) -> None:
        start = max(clock - told.t, 0.0) if told is not None else 0.0
        if told is None or start >= told.until - 0.2:
            return self._no_tube(told, start, thin)
        p, until = self._palette, told.until
        at = np.linspace(start, until, BANDS * BAND_STEPS + 1)
        path, axes = told.at(at), told.width(at)
        hoops = rings(path, axes)
        for b, band in enumerate(self._bands):
            band.vertices = hoops[b * BAND_STEPS : (b + 1) * BAND_STEPS + 1].reshape(-1, 3)
            band.visible = self.tube
        self._curtain.vertices, self._curtain.visible = curtain(path, ground)[0], self.tube
        bold.add(chain(path), rgb(p.ink))
        thin.add(chain(path * [1, 1, 0] + [0, 0, ground + 0.05]), mix(p.tube, p.ground, 0.5))
        steps = [s for s in marks(until) if s > start + 1.0][-4:]
        hoop = rings(told.at(np.array([0.0, *steps, until])), told.width(np.array([0.0, *steps, until])))[1:]
        thin.add(closed(hoop[:-1]).reshape(-1, 2, 3), mix(p.tube, p.ground, 0.85))
        self._horizon.draw(closed(hoop[-1]), rgb(p.horizon))
        self._say_marks(steps, hoop)
        said = "below 10 % to the end" if told.message.horizon_open else "error reaches 10 %"
        top = hoop[-1][np.argmax(hoop[-1][:, 2])]
        clear = np.linalg.norm(top - path[0]) > self._clear_of  # the aircraft's own label says the horizon too
        self.say("horizon", f"{until:.0f} s: {said}", _above(top, 0.3) if clear else None)
        thin.add(self._beyond(told, until), rgb(p.muted))

    def _say_marks(self, steps: list[float], hoop: np.ndarray) -> None:
        """Label the time rings (k + 1, sides, 3), the last is the horizon; one too near to another stays bare."""
        taken = [hoop[-1].mean(axis=0)]
        for k in range(4):
            low = hoop[k][np.argmin(hoop[k][:, 2])] if k < len(steps) else None
            if low is not None and min(np.linalg.norm(low - other) for other in taken) < self._clear_of:
                low = None
            self.say(f"m{k}", f"+{steps[k]:g} s" if low is not None else "", low)
            taken += [low] if low is not None else []

    def _no_tube(self, told: Forecast | None, start: float, thin: "_Sheaf") -> None:
        """Claim nothing: no band, no horizon; a path without a horizon is grey dashes."""
        for node in (*self._bands, self._curtain):
            node.visible = False
        self._horizon.draw(NOTHING.legs)
        for name in LABELS[1:6]:
            self.say(name, "", None)
        if told is not None:
            thin.add(self._beyond(told, start), rgb(self._palette.muted))

    @staticmethod
    def _beyond(told: Forecast, start: float) -> np.ndarray:
        """Dash what was predicted past the horizon: (n, 2, 3), where nothing is claimed."""
        end = min(float(told.ahead[-1]), start + BEYOND_S)
        return dashed(told.at(np.linspace(start, end, 40))) if end > start + 0.5 else np.zeros((0, 2, 3))

    def _draw_hindcast(self, past: list[Forecast], trail: np.ndarray, clock: float, thin: "_Sheaf") -> None:
        """Lay an old prediction beside what happened, with a whisker every 5 s."""
        old = [told for told in past if HINDCAST_S - 5 <= clock - told.t <= HINDCAST_S + 5]
        if not old or len(trail) < 2:
            return self.say("then", "", None)
        told = min(old, key=lambda one: abs(clock - one.t - HINDCAST_S))
        reach = min(clock - told.t, told.until, float(trail[-1, 0] - told.t))  # past its horizon it claimed nothing
        if reach < 5:
            return self.say("then", "", None)
        colour = mix(self._palette.horizon, self._palette.ground, 0.85)
        thin.add(dashed(told.at(np.linspace(0, reach, 2 * int(reach) + 2))), colour)
        at = np.arange(5.0, reach, 5.0)
        happened = np.stack([np.interp(told.t + at, trail[:, 0], trail[:, i]) for i in (1, 2, 3)], axis=-1)
        thin.add(np.stack([told.at(at), happened], axis=1), colour)
        middle = told.at(0.4 * reach) - [0, 0, 0.6]
        clear = np.linalg.norm(middle - trail[-1, 1:4]) > self._clear_of
        self.say("then", f"predicted {clock - told.t:.0f} s ago", middle if clear else None)

    def draw_flight(self, vehicle: Vehicle, rows: np.ndarray, now: float, size: float) -> None:
        """Draw the whole flown path (n, 4), faintly, with what happened on it; `size` as for `draw`."""
        self._flown.draw(chain(rows[:, 1:]) if len(rows) > 1 else NOTHING.legs, self._flown_colour)
        self._pins.draw(vehicle.events, rows, vehicle.where(now), size)
        found = vehicle.mismatch
        self._mismatch.draw(mismatch.lines(found, rows), rgb(self._palette.mismatch))
        begun = mismatch.place(found, rows)
        said = f"▲ {mismatch.short(found)} from here" if found is not None and begun is not None else ""
        self.say("mismatch", said, begun)

    def draw_route(self, route: Route, size: float) -> None:
        """Draw the mission: legs and loiters solid, jumps and returns dashed, a small ring at each item."""
        p, lines, radius = self._palette, _Sheaf(), min(1.2, 0.9 * size)
        lines.add(np.concatenate([route.legs, route.circles]), mix(p.route, p.ground, 0.8))
        lines.add(dash_lines(route.back, 3.0), mix(p.route, p.ground, 0.6))
        if len(route.points):
            lines.add(
                closed(np.stack([_disc(point, radius, 12) for point in route.points])).reshape(-1, 2, 3), rgb(p.route)
            )
        self._route.draw(*lines.all())


class _Sheaf:
    """Segments of several colours for one node."""

    def __init__(self) -> None:
        self._lines: list[np.ndarray] = []
        self._colours: list[np.ndarray] = []

    def add(self, lines: np.ndarray, colour: np.ndarray) -> None:
        self._lines.append(lines)
        self._colours.append(np.broadcast_to(colour, (len(lines), 3)))

    def all(self) -> tuple[np.ndarray, np.ndarray]:
        return np.concatenate(self._lines), np.concatenate(self._colours)


def _disc(centre: np.ndarray, radius: float, sides: int = 40) -> np.ndarray:
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    return centre + radius * np.stack([np.cos(turn), np.sin(turn), np.zeros(sides)], axis=-1)


def _above(at: np.ndarray, height: float) -> np.ndarray:
    return at + np.array([0.0, 0.0, height])


def caption(vehicle: Vehicle, now: float) -> str:
    """Say in one line who is selected and how it stands."""
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
    return vehicle.name + (lost or horizon)
