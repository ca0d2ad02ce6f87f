"""Probability that a predicted flight breaches the geofence in the autopilot parameters, or the minimum height.

The minimum height counts above the terrain where its heights are given, else above home.

Supported are a circle around home and height limits above home. Polygon fences (ArduPilot polygons, PX4 fence items)
are not parameters and are not received; the alert text names them as not monitored.
Source: ArduPilot "Geofencing" (FENCE_*), PX4 "Geofence" (GF_*).
"""

from collections.abc import Mapping
from math import isfinite
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from fleet.contract import AlertKind
from fleet.frames import Origin, to_geodetic, to_ned
from fleet.terrain.raster import Raster
from twin_worker.alerts.gaussian_forecast import GaussianForecast
from twin_worker.alerts.hysteresis import HazardEstimate

_CEILING, _CIRCLE, _POLYGON, _FLOOR = 1, 2, 4, 8  # FENCE_TYPE
_CLEAR_TEXT = "no geofence breach predicted"


class GeofenceLimits(NamedTuple):
    """Geofence limits around home; infinite where there is none."""

    radius: float = np.inf  # horizontal [m]
    ceiling: float = np.inf  # height above home [m]
    floor: float = -np.inf  # height above home [m]
    unmonitored: str = ""  # part of the fence that is not monitored

    def any_limit(self) -> bool:
        """Return whether there is any limit."""
        return bool(np.isfinite(self[:3]).any())


def read_geofence(params: Mapping[str, float]) -> GeofenceLimits:
    """Read the active geofence from autopilot parameters; without one all limits are infinite."""
    if "GF_MAX_HOR_DIST" in params or "GF_MAX_VER_DIST" in params:
        max_horizontal, max_vertical = (
            _distance_limit(params.get(name)) for name in ("GF_MAX_HOR_DIST", "GF_MAX_VER_DIST")
        )
        return GeofenceLimits(max_horizontal, max_vertical)
    if not (params.get("FENCE_ENABLE", 0.0) > 0 or params.get("FENCE_AUTOENABLE", 0.0) > 0):
        return GeofenceLimits()
    fence_type = params.get("FENCE_TYPE", np.nan)
    kinds = int(fence_type) if isfinite(fence_type) and 0 <= fence_type < 256 else _CEILING | _CIRCLE | _FLOOR
    low = params.get("FENCE_ALT_MIN", np.nan)
    points = params.get("FENCE_TOTAL", 0.0)
    return GeofenceLimits(
        _distance_limit(params.get("FENCE_RADIUS")) if kinds & _CIRCLE else np.inf,
        _distance_limit(params.get("FENCE_ALT_MAX")) if kinds & _CEILING else np.inf,
        low if kinds & _FLOOR and isfinite(low) else -np.inf,
        f"its polygon of {points:.0f} points was not received" if kinds & _POLYGON and points > 0 else "",
    )


def _distance_limit(value: float | None) -> float:
    """Return a distance limit; infinite if it is absent, not positive or not finite."""
    return value if value is not None and isfinite(value) and value > 0 else np.inf


def geofence_hazard(
    flight: GaussianForecast, limits: GeofenceLimits, home: Origin, until: float = np.inf
) -> HazardEstimate:
    """Compute the probability of a geofence breach around `home`, up to an instant [s since 1970]."""
    centre = to_ned(flight.prediction.ned_origin(), *(np.array([x]) for x in home))[0]
    relative = flight.draws(until) - centre
    distance, height = np.hypot(relative[..., 0], relative[..., 1]), -relative[..., 2]
    breaches: np.ndarray = np.stack([distance > limits.radius, height > limits.ceiling, height < limits.floor])
    breached: np.ndarray = np.any(breaches, axis=0)  # (draws, instants)
    breaching: np.ndarray = np.any(breached, axis=1)
    probability = float(breaching.mean())
    if not probability:
        return HazardEstimate(AlertKind.GEOFENCE, 0.0, "", _CLEAR_TEXT)
    k = int(np.sort(breached[breaching].argmax(axis=1))[breaching.sum() // 2])
    index = int(breaches[:, :, k].sum(axis=1).argmax())
    name = f"{('circle', 'ceiling', 'floor')[index]} of {limits[index]:.0f} m"
    breach_t = float(flight.t[k])
    when = f"in {breach_t - flight.prediction.t:.0f} s" if k else "now"
    message = f"{probability:.0%} chance that it leaves the geofence, {name} about home, {when}"
    return HazardEstimate(
        AlertKind.GEOFENCE,
        probability,
        "; ".join(filter(None, (message, limits.unmonitored))),
        _CLEAR_TEXT,
        -1,
        breach_t,
        flight.position(k),
    )


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
