"""Probability that a predicted flight descends below a minimum height above home; terrain is unknown."""

import numpy as np
from scipy.special import ndtr

from fleet.contract import AlertKind
from fleet.frames import Origin
from twin_worker.alerts.gaussian_forecast import GaussianForecast
from twin_worker.alerts.hysteresis import HazardEstimate

MIN_HEIGHT_WINGS_M, MIN_HEIGHT_ROTORS_M = (
    30.0,
    5.0,
)  # minimum height above home outside landings, fixed wings and multirotors [m]
_MIN_PROBABILITY = 0.02  # below this probability no alert text is composed [-]
_GROUND_CLEAR_TEXT = "no descent below the minimum height predicted"


def height_above_home(flight: GaussianForecast, home: Origin) -> np.ndarray:
    """Return the mean height above home, (n,) [m]."""
    return (flight.prediction.origin[2] - home.alt_mm) * 1e-3 - flight.path[:, 2]


def ground_hazard(flight: GaussianForecast, home: Origin, margin: float, until: float = np.inf) -> HazardEstimate:
    """Compute the probability of descending below a height above home [m], up to an instant [s since 1970].

    The vertical error is one draw for the whole flight, so the worst instant determines the probability:

        p = max over t of Phi((margin - height(t)) / sigma(t))
    """
    k = max(int(np.searchsorted(flight.t, until, side="right")), 1)
    height, sigma = height_above_home(flight, home)[:k], flight.sigma[:k, 2]
    z = (margin - height) / sigma
    probability = float(ndtr(z.max()))
    if probability < _MIN_PROBABILITY:
        return HazardEstimate(AlertKind.GROUND, probability, "", _GROUND_CLEAR_TEXT)
    first = int(
        np.flatnonzero(z >= min(z.max(), 0.0))[0]
    )  # where the mean goes below the margin, else the lowest point
    t = float(flight.t[first])
    message = (
        f"{probability:.0%} chance that it sinks below {margin:.0f} m above home (terrain unknown) in "
        f"{max(t - flight.prediction.t, 0.0):.0f} s; lowest {height.min():.0f} m"
    )
    return HazardEstimate(AlertKind.GROUND, probability, message, _GROUND_CLEAR_TEXT, -1, t, flight.position(first))
