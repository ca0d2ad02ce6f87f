"""Probability that a predicted flight breaches the geofence in the autopilot parameters.

Supported are a circle around home and height limits above home. Polygon fences (ArduPilot polygons, PX4 fence items)
are not parameters and are not received; the alert text names them as not monitored.
Source: ArduPilot "Geofencing" (FENCE_*), PX4 "Geofence" (GF_*).
"""

from collections.abc import Mapping
from math import isfinite
from typing import NamedTuple

import numpy as np

from fleet.contract import AlertKind
from fleet.frames import Origin, to_ned
from twin_worker.alerts.gaussian_forecast import Forecast
from twin_worker.alerts.hysteresis import Finding

_CEILING, _CIRCLE, _POLYGON, _FLOOR = 1, 2, 4, 8  # FENCE_TYPE
_OVER = "no geofence breach predicted"


class Fence(NamedTuple):
    """Geofence limits around home; infinite where there is none."""

    radius: float = np.inf  # horizontal [m]
    ceiling: float = np.inf  # height above home [m]
    floor: float = -np.inf  # height above home [m]
    unseen: str = ""  # part of the fence that is not monitored

    def limits(self) -> bool:
        """Return whether there is any limit."""
        return bool(np.isfinite(self[:3]).any())


def fence(params: Mapping[str, float]) -> Fence:
    """Read the active geofence from autopilot parameters; without one all limits are infinite."""
    if "GF_MAX_HOR_DIST" in params or "GF_MAX_VER_DIST" in params:
        wide, high = (_positive(params.get(name)) for name in ("GF_MAX_HOR_DIST", "GF_MAX_VER_DIST"))
        return Fence(wide, high)
    if not (params.get("FENCE_ENABLE", 0.0) > 0 or params.get("FENCE_AUTOENABLE", 0.0) > 0):
        return Fence()
    told = params.get("FENCE_TYPE", np.nan)
    kinds = int(told) if isfinite(told) and 0 <= told < 256 else _CEILING | _CIRCLE | _FLOOR
    low = params.get("FENCE_ALT_MIN", np.nan)
    points = params.get("FENCE_TOTAL", 0.0)
    return Fence(
        _positive(params.get("FENCE_RADIUS")) if kinds & _CIRCLE else np.inf,
        _positive(params.get("FENCE_ALT_MAX")) if kinds & _CEILING else np.inf,
        low if kinds & _FLOOR and isfinite(low) else -np.inf,
        f"its polygon of {points:.0f} points was not received" if kinds & _POLYGON and points > 0 else "",
    )


def _positive(value: float | None) -> float:
    """Return a distance limit; infinite if it is absent, not positive or not finite."""
    return value if value is not None and isfinite(value) and value > 0 else np.inf


def leaves(flight: Forecast, limit: Fence, home: Origin, until: float = np.inf) -> Finding:
    """Compute the probability of a geofence breach around `home`, up to an instant [s since 1970]."""
    centre = to_ned(flight.made.ned_origin(), *(np.array([x]) for x in home))[0]
    place = flight.draws(until) - centre
    away, height = np.hypot(place[..., 0], place[..., 1]), -place[..., 2]
    out: np.ndarray = np.stack([away > limit.radius, height > limit.ceiling, height < limit.floor])
    ever: np.ndarray = np.any(out, axis=0)  # (draws, instants)
    hit: np.ndarray = np.any(ever, axis=1)
    p = float(hit.mean())
    if not p:
        return Finding(AlertKind.GEOFENCE, 0.0, "", _OVER)
    k = int(np.sort(ever[hit].argmax(axis=1))[hit.sum() // 2])
    which = int(out[:, :, k].sum(axis=1).argmax())
    name = f"{('circle', 'ceiling', 'floor')[which]} of {limit[which]:.0f} m"
    at = float(flight.t[k])
    when = f"in {at - flight.made.t:.0f} s" if k else "now"
    said = f"{p:.0%} chance that it leaves the geofence, {name} about home, {when}"
    return Finding(AlertKind.GEOFENCE, p, "; ".join(filter(None, (said, limit.unseen))), _OVER, -1, at, flight.place(k))
