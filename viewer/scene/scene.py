"""Fleet in 3-D on one page: about fifteen nodes, independent of its size."""

from collections.abc import Callable
from typing import Any

import numpy as np

from viewer.scene.fleet_arrays import CHUNKS, LOST, MISMATCH, STEPS, Flock
from viewer.scene.glyphs import Glyphs
from viewer.scene.ground import Ground
from viewer.scene.routes import NOTHING, Route, circle
from viewer.scene.strokes import Strokes, chain, dash_lines, faded, rounded
from viewer.store.vehicle import Vehicle
from viewer.theme.palette import Palette, mix, rgb

DASHES, FEW = 30, 60  # dashes of one predicted path; half as many, without ground marks, in a larger fleet
LOOK_S = 60.0  # longest look-ahead drawn for UAVs that are not selected [s]
PARTS = 3  # points per second of trail in a small fleet
ALERT_DASHES = 18  # dashes of the alert ring on the ground


class Scene:
    """Nodes of the fleet: ground, aircraft, trails, predicted paths, stems, alert rings, routes."""

    def __init__(self, scene: Any, palette: Palette, clicked: Callable[[int], None]) -> None:
        self._palette = palette
        self.ground = Ground(scene, palette)
        self.glyphs = Glyphs(scene, palette, clicked)
        self.trails = [Strokes(scene, f"/fleet/trail{i}", 2.0) for i in range(CHUNKS)]
        self.head = Strokes(scene, "/fleet/head", 2.0)
        self.predicted = Strokes(scene, "/fleet/predicted", 1.8)
        self.stems = Strokes(scene, "/fleet/stems", 1.2)
        self.routes = Strokes(scene, "/fleet/routes", 1.4)
        self.alert = Strokes(scene, "/alert", 2.2)
        self._drawn: tuple = (None, -1)  # revision and selection, and closed chunks, when the trails were last drawn
        self._looks = np.zeros(0, int)  # statuses they were coloured by
        self._head_looks = np.zeros(0, int)

    def draw_trails(self, flock: Flock, selected: int | None) -> None:
        """Draw changed chunks: one when a chunk closes, all when the drawn UAVs or the selection change."""
        closed, recoloured = flock.beats // STEPS, not np.array_equal(flock.looks, self._looks)
        changes, before = self._drawn
        if (who := (flock.changes, selected)) == changes and closed == before and not recoloured:
            return
        fresh = range(CHUNKS) if who != changes or closed > before + 1 else range(closed - before)
        if fresh == range(1):  # the node of the oldest chunk draws the newest; the others only fade
            self.trails = [self.trails[-1], *self.trails[:-1]]
        colours, parts = self.glyphs.colours(flock), _parts(flock)
        for age, strokes in enumerate(self.trails):
            ages = age * STEPS + np.linspace(STEPS, 0, parts * STEPS // flock.stride + 1)
            shares = np.interp(ages, [-STEPS, CHUNKS * STEPS], [0.95, 0.03]) * (0.6 if flock.crowd else 1.0)
            shades = faded(colours, rgb(self._palette.ground), shares)
            if age >= flock.chunks:
                strokes.draw(NOTHING.legs)
            elif age in fresh:
                strokes.draw(chain(rounded(_bare(flock, flock.chunk(age), selected), parts)), shades.reshape(-1, 2, 3))
            else:
                strokes.colour(shades.reshape(-1, 2, 3), shades.shape[0] * shades.shape[1])
        self._drawn, self._looks = (who, closed), flock.looks.copy()

    def draw_heads(self, flock: Flock, selected: int | None) -> None:
        """Draw the newest stretch of every trail up to the aircraft; the array size is constant."""
        lines = chain(rounded(_bare(flock, flock.head(), selected), _parts(flock)))
        if np.array_equal(flock.looks, self._head_looks):
            return self.head.draw(lines)
        self._head_looks = flock.looks.copy()
        share = 0.55 if flock.crowd else 0.95
        colours = self.glyphs.colours(flock) * share + rgb(self._palette.ground) * (1 - share)
        self.head.draw(lines, np.repeat(colours, lines.shape[1], axis=0))

    def draw_predicted(self, flock: Flock, now: float, selected: int | None) -> None:
        """Draw the predicted paths dashed, up to the horizon or 60 s; the selected UAV has its tube instead."""
        who = [v for v in predicted(flock) if v.uav != selected]
        if not who:
            return self.predicted.draw(NOTHING.legs)
        dashes = DASHES if len(flock.uavs) <= FEW else DASHES // 2
        told = [(v.forecast, v.clock(now)) for v in who if v.forecast is not None]
        lines = [cut_at_horizon(one.ahead, one.path, clock - one.t, one.until, dashes) for one, clock in told]
        looks = flock.looks[[i for v in who if (i := flock.index(v.uav)) is not None]]
        tints = 0.35 * np.array([rgb(c) for c in self._palette.looks()]) + 0.65 * rgb(self._palette.ink)
        shades = faded(tints, rgb(self._palette.ground), np.linspace(0.9, 0.1, 2 * dashes))[:, ::2]
        self.predicted.draw(np.concatenate(lines), shades[looks].reshape(-1, 2, 3))

    def draw_stems(self, flock: Flock) -> None:
        """Draw vertical stems from aircraft to the ground; none in a large fleet."""
        if flock.crowd or not flock.uavs:
            return self.stems.draw(NOTHING.legs)
        foot = flock.at * [1, 1, 0] + [0, 0, self.ground.height + 0.05]
        hexagon = circle(np.zeros(3), 0.3 * self.glyphs.unit, 6)[: 6 if len(flock.uavs) <= FEW else 0]
        lines = np.concatenate([np.stack([flock.at, foot], axis=1)[:, None], foot[:, None, None] + hexagon], axis=1)
        tints = np.array([mix(colour, self._palette.ground, 0.5) for colour in self._palette.looks()])
        self.stems.draw(lines.reshape(-1, 2, 3), np.repeat(tints[flock.looks], lines.shape[1], axis=0))

    def draw_alerts(self, flock: Flock) -> None:
        """Draw a ground ring and a stem under exceptional UAVs; lost links only in a small fleet."""
        who = flock.looks == MISMATCH if flock.crowd else flock.exceptions
        at, looks = flock.at[who], flock.looks[who]
        foot = at * [1, 1, 0] + [0, 0, self.ground.height + 0.1]
        ring = circle(np.zeros(3), (2.0 if flock.crowd else 1.1) * self.glyphs.unit, 2 * ALERT_DASHES)[::2]
        lines = np.concatenate([foot[:, None, None] + ring, np.stack([at, foot], axis=1)[:, None]], axis=1)
        colours = np.where((looks == LOST)[:, None], rgb(self._palette.lost), rgb(self._palette.mismatch))
        self.alert.draw(lines.reshape(-1, 2, 3), np.repeat(colours, ALERT_DASHES + 1, axis=0))

    def draw_routes(self, routes: list[Route]) -> None:
        """Draw the routes of the other UAVs in a muted colour."""
        lines = [part for r in routes for part in (r.legs, r.circles, dash_lines(r.back, 4.0))]
        self.routes.draw(np.concatenate([*lines, NOTHING.legs]), mix(self._palette.route, self._palette.ground, 0.45))


def _bare(flock: Flock, points: np.ndarray, selected: int | None) -> np.ndarray:
    """Collapse the trail of the selected UAV in points (n, k, 3), as it has a finer path."""
    if (row := flock.index(selected)) is not None:
        points = points.copy()
        points[row] = points[row, :1]
    return points


def _parts(flock: Flock) -> int:
    """Return the number of curve points per trail step."""
    return PARTS if len(flock.uavs) <= FEW else 1


def predicted(flock: Flock) -> list[Vehicle]:
    """Return the UAVs with drawn predictions: all, in a large fleet the exceptional ones."""
    if not flock.crowd:
        return [v for v in flock.fleet if v.forecast is not None and flock.index(v.uav) is not None]
    return [v for v, _ in flock.needy if v.forecast is not None]


def cut_at_horizon(ahead: np.ndarray, path: np.ndarray, start: float, until: float, dashes: int = DASHES) -> np.ndarray:
    """Cut a path into dashes of equal duration between two look-aheads, at most `MAX_AHEAD_S`.

    Args:
        ahead: look-ahead of each point, increasing, (n,) [s]
        path: positions, (n, 3)
        start: first look-ahead [s]
        horizon_s: last look-ahead [s]
        dashes: number of dashes
    Returns:
        (dashes, 2, 3); zero length beyond the horizon
    """
    at = np.minimum(max(start, 0.0) + np.linspace(0.0, LOOK_S, 2 * dashes), until)
    points = np.stack([np.interp(at, ahead, path[:, i]) for i in range(3)], axis=-1)
    return chain(points)[::2]
