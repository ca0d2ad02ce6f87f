"""Position of an aircraft relative to the predicted path of an option and its prediction region.

    d = p - path(t),  resolved along the course of the path, across it (right positive) and down
    inside: |d_along| <= a_along, |d_cross| <= a_cross, |d_down| <= a_vertical
    a = sqrt(r^2 + e^2),  r: half-axis of the region, e: error of the received position

The region is that of the aircraft, and near its start it is narrower than the error of a position of its receiver:
without `e` a flight on its path would be reported as off it in the first seconds.
"""

from math import cos, sin
from typing import NamedTuple

import numpy as np

from fleet.contract import ProposedPath
from fleet.export.geometry import MAX_REACH_M, PredictedPath
from fleet.frames import Origin, to_ned

POSITION_ERROR_M = (3.0, 2.0, 3.0)
"""Error of a received position against the path, within a minute: of the satellite receiver across and vertically,
along the path also of its time stamp, 0.1 s at 20 m/s (along, cross, vertical) [m]; limits, not calibrated."""
_WORDS = (("ahead of", "behind"), ("right of", "left of"), ("below", "above"))  # positive and negative, by axis


class Deviation(NamedTuple):
    """Deviation of a position from a predicted path at the same time."""

    errors: tuple[float, float, float]  # along, cross, down [m]
    half_axes: tuple[float, float, float]  # along, cross, vertical, with the error of the position [m]

    @property
    def is_inside(self) -> bool:
        """Return whether the position is within the prediction region."""
        return all(abs(error) <= axis for error, axis in zip(self.errors, self.half_axes, strict=True))

    def __str__(self) -> str:
        ratios = [abs(error) / max(axis, 1e-3) for error, axis in zip(self.errors, self.half_axes, strict=True)]
        worst = int(np.argmax(ratios))
        error = self.errors[worst]
        return f"{abs(error):.0f} m {_WORDS[worst][error < 0]} it (its region reaches {self.half_axes[worst]:.0f} m)"


def deviation(path: ProposedPath, elapsed_s: float, position: np.ndarray) -> Deviation | None:
    """Return the deviation of a position from a path; None before its start and after its end.

    Args:
        path: predicted path
        elapsed_s: time since the proposal [s]
        position: latitude, longitude, altitude, (3,) [1e-7 deg, 1e-7 deg, mm]
    Raises:
        ValueError: when the arrays of the path disagree or are not finite.
    """
    predicted = read_path(path)
    if not predicted.ahead[0] <= elapsed_s <= predicted.ahead[-1]:
        return None
    at = np.array([elapsed_s])
    ned, half_axes = predicted.at(at)
    course = float(predicted.headings(at)[0])
    north, east, down = to_ned(predicted.origin, *(np.array([x], float) for x in position))[0] - ned[0]
    along, cross = cos(course) * north + sin(course) * east, cos(course) * east - sin(course) * north
    a, b, c = np.hypot(half_axes[0], POSITION_ERROR_M).tolist()
    return Deviation((float(along), float(cross), float(down)), (a, b, c))


def read_path(path: ProposedPath) -> PredictedPath:
    """Check the arrays of a path.

    Raises:
        ValueError: when they disagree or are not finite.
    """
    ahead, ned, half_axes = (
        array.numpy().astype(float) for array in (path.ahead, path.path, path.prediction_region_half_axes)
    )
    n = ahead.shape[0] if ahead.ndim == 1 else 0
    agree = n >= 2 and ned.shape == half_axes.shape == (n, 3) and bool((np.diff(ahead) > 0).all())
    if not agree or not np.abs(ned).max() <= MAX_REACH_M or not (half_axes >= 0).all():
        raise ValueError(f"found an invalid path of uav-{path.uav}, expected finite points in order of time")
    return PredictedPath(ahead, ned, half_axes, Origin(*path.origin), float(ahead[-1]))
