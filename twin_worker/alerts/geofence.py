"""Probability that a predicted flight breaches the geofence, enters a no-fly area, or sinks below the minimum height.

The geofence consists of a circle around home and height limits above home, from the autopilot parameters, of the fence
items on board, and of areas that the operator gives for all aircraft. The minimum height counts above the terrain where
its heights are given, else above home.
Source: ArduPilot "Geofencing" (FENCE_*), PX4 "Geofence" (GF_*).
"""

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from fleet.contract import AlertKind, Item
from fleet.frames import Origin, to_geodetic, to_ned
from fleet.terrain.areas import Area, read_fence_items
from fleet.terrain.raster import Raster
from twin_worker.alerts.gaussian_forecast import GaussianForecast
from twin_worker.alerts.hysteresis import HazardEstimate

_CEILING, _CIRCLE, _POLYGON, _FLOOR = 1, 2, 4, 8  # FENCE_TYPE
_UNION = 2  # FENCE_OPTIONS: inside one of the inclusion areas is enough
_CLEAR_TEXT = "no geofence breach predicted"
_REACH_SIGMAS = 5.0  # areas further away than this from the mean path are not reached by any draw


class GeofenceLimits(NamedTuple):
    """Geofence limits around home; infinite where there is none.

    Attributes:
        radius: horizontal [m]
        ceiling, floor: heights above home [m]
        unmonitored: part of the fence that is not monitored
        inclusions: groups of areas; the aircraft has to be in one of each group
        exclusions: areas to stay out of
    """

    radius: float = np.inf
    ceiling: float = np.inf
    floor: float = -np.inf
    unmonitored: str = ""
    inclusions: tuple[tuple[Area, ...], ...] = ()
    exclusions: tuple[Area, ...] = ()

    def any_limit(self) -> bool:
        """Return whether there is any limit."""
        return bool(np.isfinite(self[:3]).any() or self.inclusions or self.exclusions)

    def without_floors(self) -> "GeofenceLimits":
        """Return the limits without lower ends, as during take-off and landing."""
        groups = (tuple(area._replace(floor=-np.inf) for area in group) for group in self.inclusions)
        return self._replace(floor=-np.inf, inclusions=tuple(groups))


def read_geofence(
    params: Mapping[str, float], items: tuple[Item, ...] = (), areas: Sequence[Area] = ()
) -> GeofenceLimits:
    """Read the active geofence; without one all limits are infinite.

    Args:
        params: autopilot parameters
        items: fence items on board
        areas: given by the operator; with several inclusion areas one of them is enough
    """
    on_board, unread = read_fence_items(items)
    limits, enabled = _limits_of_params(params, has_items=bool(items))
    on_board = on_board if enabled else ()
    inside = tuple(area for area in on_board if not area.exclusion)
    is_union = _is_px4(params) or _bits(params.get("FENCE_OPTIONS"), 0) & _UNION
    of_operator = tuple(area for area in areas if not area.exclusion)
    groups = ((inside,) if is_union else tuple((area,) for area in inside), (of_operator,))
    return limits._replace(
        unmonitored="; ".join(filter(None, (limits.unmonitored, unread if enabled else ""))),
        inclusions=tuple(group for part in groups for group in part if group),
        exclusions=tuple(area for area in (*on_board, *areas) if area.exclusion),
    )


def _is_px4(params: Mapping[str, float]) -> bool:
    return "GF_MAX_HOR_DIST" in params or "GF_MAX_VER_DIST" in params


def _limits_of_params(params: Mapping[str, float], *, has_items: bool) -> tuple[GeofenceLimits, bool]:
    """Return the limits of the parameters, and whether fence items on board are in force."""
    if _is_px4(params):
        max_horizontal, max_vertical = (
            _distance_limit(params.get(name)) for name in ("GF_MAX_HOR_DIST", "GF_MAX_VER_DIST")
        )
        return GeofenceLimits(max_horizontal, max_vertical), True
    if not (params.get("FENCE_ENABLE", 0.0) > 0 or params.get("FENCE_AUTOENABLE", 0.0) > 0):
        return GeofenceLimits(), False
    kinds = _bits(params.get("FENCE_TYPE"), _CEILING | _CIRCLE | _FLOOR)
    low = params.get("FENCE_ALT_MIN", np.nan)
    points = params.get("FENCE_TOTAL", 0.0)
    limits = GeofenceLimits(
        _distance_limit(params.get("FENCE_RADIUS")) if kinds & _CIRCLE else np.inf,
        _distance_limit(params.get("FENCE_ALT_MAX")) if kinds & _CEILING else np.inf,
        low if kinds & _FLOOR and isfinite(low) else -np.inf,
        f"its {points:.0f} fence items were not received" if kinds & _POLYGON and points > 0 and not has_items else "",
    )
    return limits, bool(kinds & _POLYGON)


def _bits(value: float | None, default: int) -> int:
    """Return a bit mask; the default if it is absent or no mask of eight bits."""
    return int(value) if value is not None and 0 <= value < 256 else default


def _distance_limit(value: float | None) -> float:
    """Return a distance limit; infinite if it is absent, not positive or not finite."""
    return value if value is not None and isfinite(value) and value > 0 else np.inf


def geofence_hazard(
    flight: GaussianForecast, limits: GeofenceLimits, home: Origin, until: float = np.inf
) -> HazardEstimate:
    """Compute the probability of a geofence breach, up to an instant [s since 1970].

    Args:
        flight: the prediction; limits: the geofence around `home`
    """
    breaches = {name: breached for name, breached in _breaches(flight, limits, home, until).items() if breached.any()}
    if not breaches:
        return HazardEstimate(AlertKind.GEOFENCE, 0.0, "", _CLEAR_TEXT)
    stacked = np.stack(list(breaches.values()))  # (limits, draws, instants)
    breached: np.ndarray = np.any(stacked, axis=0)
    breaching: np.ndarray = np.any(breached, axis=1)
    probability = float(breaching.mean())
    k = int(np.sort(breached[breaching].argmax(axis=1))[breaching.sum() // 2])
    what = list(breaches)[int(stacked[:, :, k].sum(axis=1).argmax())]
    breach_t = float(flight.t[k])
    when = f"in {breach_t - flight.prediction.t:.0f} s" if k else "now"
    message = f"{probability:.0%} chance that it {what}, {when}"
    return HazardEstimate(
        AlertKind.GEOFENCE,
        probability,
        "; ".join(filter(None, (message, limits.unmonitored))),
        _CLEAR_TEXT,
        -1,
        breach_t,
        flight.position(k),
    )


def _breaches(flight: GaussianForecast, limits: GeofenceLimits, home: Origin, until: float) -> dict[str, np.ndarray]:
    """Return where draws of the path breach each limit, (draws, instants), by what happens there."""
    origin, draws = flight.prediction.ned_origin(), flight.draws(until)
    n, e, d = np.moveaxis(draws - to_ned(origin, *(np.array([x]) for x in home))[0], -1, 0)
    out = {
        f"leaves the geofence, circle of {limits.radius:.0f} m about home": np.hypot(n, e) > limits.radius,
        f"leaves the geofence, ceiling of {limits.ceiling:.0f} m about home": -d > limits.ceiling,
        f"leaves the geofence, floor of {limits.floor:.0f} m about home": -d < limits.floor,
    }
    k = draws.shape[1]
    path, reach = flight.path[:k], _REACH_SIGMAS * flight.sigma[:k].max(axis=1)
    for group in limits.inclusions:
        bounded = any(np.isfinite([area.floor, area.ceiling]).any() for area in group)  # heights have a reach, too
        if bounded or np.any(_depth(group, path, origin) < reach):
            names = " or ".join(area.name for area in group[:3])
            out[f"leaves the geofence, {names}"] = _depth(group, draws, origin) < 0.0
    for area in limits.exclusions:
        if np.any(area._replace(floor=-np.inf, ceiling=np.inf).depth(path, origin) > -reach):
            out[f"enters a no-fly area, {area.name}"] = area.depth(draws, origin) >= 0.0
    return out


def _depth(group: tuple[Area, ...], points: np.ndarray, origin: Origin) -> np.ndarray:
    """Return how far points, (..., 3), are inside at least one area of a group, negative outside, (...) [m]."""
    depth: np.ndarray = np.max([area.depth(points, origin) for area in group], axis=0)
    return depth


def area_margin(flight: GaussianForecast, limits: GeofenceLimits, until: float) -> float:
    """Return the smallest distance of the mean path to the edges of all areas, up to an instant [s since 1970].

    It is negative where the path is outside an inclusion area or inside a no-fly area, and infinite without any.
    """
    origin = flight.prediction.ned_origin()
    path = flight.path[: max(int(np.searchsorted(flight.t, until, side="right")), 1)]
    margins = [_depth(group, path, origin) for group in limits.inclusions]
    margins += [-area.depth(path, origin) for area in limits.exclusions]
    return float(np.min(margins)) if margins else np.inf


MIN_HEIGHT_WINGS_M = 30.0  # minimum height above ground of fixed wings outside landings [m]
MIN_HEIGHT_ROTORS_M = 5.0  # the same of multirotors [m]
_MIN_PROBABILITY = 0.02  # below this probability no alert text is composed [-]
_GROUND_CLEAR_TEXT = "no descent below the minimum height predicted"


def height_above_home(flight: GaussianForecast, home: Origin) -> np.ndarray:
    """Return the mean height above home, (n,) [m]."""
    return (flight.prediction.origin[2] - home.alt_mm) * 1e-3 - flight.path[:, 2]


class GroundClearance(NamedTuple):
    """Height above the terrain; above home where the terrain is unknown."""

    height: np.ndarray  # mean, (n,) [m]
    sigma: np.ndarray  # standard deviation, (n,) [m]
    known: np.ndarray  # whether the terrain is known, (n,)


def ground_clearance(
    flight: GaussianForecast, home: Origin, terrain: Raster | None, until: float = np.inf
) -> GroundClearance:
    """Compute the height above the terrain up to an instant [s since 1970].

    The terrain counts relative to its height at home, so that an error of the altitude at home cancels:

        h(t) = height above home(t) - (terrain(p(t)) - terrain(p_home))

    Mean and standard deviation are those of 128 draws of the path, so steep terrain beside it counts.
    Source: ArduPilot "Terrain Following", terrain offset at arming.
    """
    k = max(int(np.searchsorted(flight.t, until, side="right")), 1)
    height, sigma = height_above_home(flight, home)[:k], flight.sigma[:k, 2]
    if terrain is None:
        return GroundClearance(height, sigma, np.zeros(k, bool))
    draws = flight.draws(until)
    lat_e7, lon_e7, alt_mm = np.moveaxis(to_geodetic(flight.prediction.ned_origin(), draws), -1, 0)
    rise = terrain.sample(lat_e7 * 1e-7, lon_e7 * 1e-7) - terrain.sample(
        np.array(home.lat_e7 * 1e-7), np.array(home.lon_e7 * 1e-7)
    )
    known = np.isfinite(rise).all(axis=0)
    clearance = (alt_mm - home.alt_mm) * 1e-3 - rise
    return GroundClearance(
        np.where(known, clearance.mean(axis=0), height), np.where(known, clearance.std(axis=0), sigma), known
    )


def lowest_after(flight: GaussianForecast, home: Origin, terrain: Raster | None, since: float) -> float:
    """Return the lowest mean height above the ground after an instant [s since 1970]; infinite at the end [m]."""
    k = max(int(np.searchsorted(flight.t, since, side="right")), 1)
    return float(ground_clearance(flight, home, terrain).height[k:].min(initial=np.inf))


def ground_hazard(
    flight: GaussianForecast, home: Origin, margin: float, until: float = np.inf, terrain: Raster | None = None
) -> HazardEstimate:
    """Compute the probability of descending below a height above ground [m], up to an instant [s since 1970].

    The ground is the terrain, or the height of home where the terrain is unknown. The vertical error is one draw for
    the whole flight, so the worst instant determines the probability:

        p = max over t of Phi((margin - height(t)) / sigma(t))
    """
    height, sigma, known = ground_clearance(flight, home, terrain, until)
    z = (margin - height) / sigma
    probability = float(ndtr(z.max()))
    if probability < _MIN_PROBABILITY:
        return HazardEstimate(AlertKind.GROUND, probability, "", _GROUND_CLEAR_TEXT)
    first = int(np.flatnonzero(z >= min(z.max(), 0.0))[0])  # where the mean is below the margin, else the lowest point
    t = float(flight.t[first])
    ground = "the terrain" if known[first] else "home (terrain unknown)"
    message = (
        f"{probability:.0%} chance that it sinks below {margin:.0f} m above {ground} in "
        f"{max(t - flight.prediction.t, 0.0):.0f} s; lowest {height.min():.0f} m"
    )
    return HazardEstimate(AlertKind.GROUND, probability, message, _GROUND_CLEAR_TEXT, -1, t, flight.position(first))
