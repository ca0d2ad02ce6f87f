"""Probability that a predicted flight descends below a minimum height above home; terrain is unknown."""

import numpy as np
from scipy.special import ndtr

from fleet.contract import AlertKind
from fleet.frames import Origin
from twin_worker.alerts.gaussian_forecast import Forecast
from twin_worker.alerts.hysteresis import Finding

WINGS_M, ROTORS_M = 30.0, 5.0  # minimum height above home outside landings, fixed wings and multirotors [m]
_SLIGHT = 0.02  # below this probability no alert text is composed [-]
_OVER = "no descent below the minimum height predicted"


def above(flight: Forecast, home: Origin) -> np.ndarray:
    """Return the mean height above home, (n,) [m]."""
    return (flight.made.origin[2] - home.alt_mm) * 1e-3 - flight.path[:, 2]


def sinks(flight: Forecast, home: Origin, margin: float, until: float = np.inf) -> Finding:
    """Compute the probability of descending below a height above home [m], up to an instant [s since 1970].

    The vertical error is one draw for the whole flight, so the worst instant determines the probability:

        p = max over t of Phi((margin - height(t)) / sigma(t))
    """
    k = max(int(np.searchsorted(flight.t, until, side="right")), 1)
    height, sigma = above(flight, home)[:k], flight.sigma[:k, 2]
    z = (margin - height) / sigma
    p = float(ndtr(z.max()))
    if p < _SLIGHT:
        return Finding(AlertKind.GROUND, p, "", _OVER)
    first = int(
        np.flatnonzero(z >= min(z.max(), 0.0))[0]
    )  # where the mean goes below the margin, else the lowest point
    at = float(flight.t[first])
    danger = (
        f"{p:.0%} chance that it sinks below {margin:.0f} m above home (terrain unknown) in "
        f"{max(at - flight.made.t, 0.0):.0f} s; lowest {height.min():.0f} m"
    )
    return Finding(AlertKind.GROUND, p, danger, _OVER, -1, at, flight.place(first))
