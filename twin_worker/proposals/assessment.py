"""Compare the predicted path of an experiment with that of the present plan: delay, energy, deviation, clearance."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fleet.contract import Prediction
from fleet.frames import to_geodetic, to_ned
from twin_worker.alerts.gaussian_forecast import STEP, GaussianForecast

_STEP_S = 1.0  # grid of the comparison [s]
_MAX_SHIFT_S = 90.0  # largest delay or gain that is looked for [s]
_LIFT_TO_DRAG = 10.0  # of a small fixed wing at cruise [-]


class Cost(NamedTuple):
    """What a changed plan costs."""

    delay_s: float  # later than the present plan at the end of the look-ahead; negative: earlier [s]
    energy: float  # relative to the present plan for the same route [-]
    deviation_m: float  # largest distance from the present path [m]


@dataclass(frozen=True)
class Comparison:
    """Present plan of one aircraft, with which its experiments are compared.

    Attributes:
        prediction: of the present plan
        wind: NED, (3,) [m/s]
        has_wings: flies on wings
    """

    prediction: Prediction
    wind: np.ndarray
    has_wings: bool

    def cost(self, changed: Prediction, *, interrupts: bool) -> Cost:
        """Return the cost of a changed plan; `interrupts`: the mission is not continued, so all of it is late."""
        before, after = _on_grid(self.prediction), _on_grid(changed)
        after = _in_frame_of(self.prediction, changed, after)
        n = min(len(before), len(after))
        delay = float(_STEP_S * (n - 1)) if interrupts else _delay(before[:n], after[:n])
        duration = _STEP_S * (n - 1)
        power = _mean_power(after[:n], self.wind, self._speed(before), self.has_wings)
        present = _mean_power(before[:n], self.wind, self._speed(before), self.has_wings)
        energy = power / present * (1.0 if interrupts else (duration + delay) / duration)
        return Cost(delay, float(energy), _deviation(before, after))

    def _speed(self, path: np.ndarray) -> float:
        """Return the mean airspeed of a path [m/s]."""
        return float(np.linalg.norm(np.diff(path, axis=0) / _STEP_S - self.wind, axis=1).mean())


def _on_grid(prediction: Prediction) -> np.ndarray:
    """Return the path every second, (n, 3) [m]."""
    ahead, path = prediction.ahead.numpy().astype(float), prediction.path.numpy().astype(float)
    grid = np.arange(0.0, ahead[-1] + 1e-6, _STEP_S)
    return np.column_stack([np.interp(grid, ahead, column) for column in path.T])


def _in_frame_of(prediction: Prediction, other: Prediction, path: np.ndarray) -> np.ndarray:
    """Return the path of another prediction in the frame of the first, (n, 3) [m]."""
    if prediction.origin == other.origin:
        return path
    return to_ned(prediction.ned_origin(), *to_geodetic(other.ned_origin(), path).T)


def _deviation(before: np.ndarray, after: np.ndarray) -> float:
    """Return the largest distance of the points of a path, (k, 3), from another path, (n, 3) [m]."""
    step, offset = np.diff(before, axis=0), after[:, None, :] - before[None, :-1, :]
    s = np.clip(np.einsum("kni,ni->kn", offset, step) / np.maximum(np.sum(step**2, axis=1), 1e-9), 0.0, 1.0)
    return float(np.linalg.norm(offset - s[..., None] * step, axis=2).min(axis=1).max())


def _delay(before: np.ndarray, after: np.ndarray) -> float:
    """Return how much later the end of the shorter way is reached [s]; paths every second, (n, 3) [m].

    The end of the changed path is looked for on the present one, or reversely where the changed one is ahead of it.
    """
    span = int(_MAX_SHIFT_S / _STEP_S)
    late = np.linalg.norm(before[-span:, :2] - after[-1, :2], axis=1)[::-1]
    early = np.linalg.norm(after[-span:, :2] - before[-1, :2], axis=1)[::-1]
    return _STEP_S * float(late.argmin() if late.min() <= early.min() else -early.argmin())


def _mean_power(path: np.ndarray, wind: np.ndarray, V_0: float, has_wings: bool) -> float:
    """Return the mean power along a path, relative to level flight at the airspeed `V_0` [m/s].

    On wings, parasitic and induced drag are taken as equal at `V_0`, and climbing lifts the weight:

        P / P_0 = ((V / V_0)^3 + V_0 / V) / 2 + (L/D) h_dot / V_0

    but never below 0. On rotors the power to hover is taken as constant.
    Source: Beard & McLain 2012, 4.3; Anderson, "Aircraft performance and design", 5.6 (power required).
    """
    if not has_wings or not V_0 > 0.1:
        return 1.0
    velocity = np.diff(path, axis=0) / _STEP_S
    ratio = np.maximum(np.linalg.norm(velocity - wind, axis=1) / V_0, 0.3)
    power = 0.5 * (ratio**3 + 1.0 / ratio) + _LIFT_TO_DRAG * -velocity[:, 2] / V_0
    return float(np.maximum(power, 0.0).mean())


class Approach(NamedTuple):
    """Closest approach of two mean paths."""

    distance: float  # [m]
    above: float  # height of the first above the second then [m]


def closest_approach(one: GaussianForecast, other: GaussianForecast) -> Approach | None:
    """Return the closest approach of two mean paths; None if they have no common time.

    The motion between two instants of the grid is a straight line.
    """
    start = max(one.first, other.first)
    stop = min(one.first + len(one.path), other.first + len(other.path))
    if stop - start < 2:
        return None
    theirs = _in_frame_of(one.prediction, other.prediction, other.path[start - other.first : stop - other.first])
    relative = one.path[start - one.first : stop - one.first] - theirs
    step = np.diff(relative, axis=0)
    s = np.clip(-np.sum(relative[:-1] * step, axis=1) / np.maximum(np.sum(step**2, axis=1), 1e-9), 0.0, 1.0)
    nearest = relative[:-1] + s[:, None] * step
    k = int(np.linalg.norm(nearest, axis=1).argmin())
    return Approach(float(np.linalg.norm(nearest[k])), float(-nearest[k, 2]))


def look_ahead_s(forecast: GaussianForecast) -> float:
    """Return the look-ahead of a forecast [s]."""
    return STEP * (len(forecast.path) - 1)
