"""Prediction in scene coordinates (checked on arrival, transformed on first use), and its error against the flight."""

from functools import cached_property, lru_cache
from math import isfinite
from typing import NamedTuple

import msgspec
import numpy as np

from fleet.contract import Array, Prediction
from viewer.store.place import REACH_M, UNIT_M, SceneFrame

MAX_STEPS, MAX_AHEAD_S = 5_000, 3_600.0  # accepted look-ahead: steps, and time [s]
MAX_ALTERNATIVES = 8  # accepted alternative paths
_CHORD_S, _MAX_PARTS = 1.5, 4  # steps longer than this are subdivided, into at most so many parts
PAST_AHEAD_S = 31.0  # look-ahead kept of a past prediction [s]


class LookAheads(NamedTuple):
    """Look-aheads of predictions: most workers send the same for every aircraft."""

    s: np.ndarray  # (n,) [s]
    is_rising: bool  # increasing, within one hour
    past: np.ndarray  # those stored of a past prediction [s]


@lru_cache(maxsize=64)
def look_aheads(ahead: Array) -> LookAheads:
    """Return the look-aheads of a prediction, (n,) with n of 2 to `MAX_STEPS`."""
    s = ahead.numpy()
    is_rising = (s[1:] > s[:-1]).all() and abs(s[0]) <= MAX_AHEAD_S and abs(s[-1]) <= MAX_AHEAD_S
    return LookAheads(s, bool(is_rising), s[: int(np.searchsorted(s, PAST_AHEAD_S, side="right"))].copy())


class ScenePrediction:
    """Checked prediction with arrays in scene coordinates."""

    def __init__(self, message: Prediction, scene_frame: SceneFrame, received: float) -> None:
        self.t = message.t  # start, data time [s since 1970]
        self.received = received  # arrival, monotonic [s]
        self.message = message
        self.scene_frame = scene_frame

    @cached_property
    def horizon_s(self) -> float:
        """Return the confidence horizon, at most the last look-ahead sent [s]."""
        horizon, last = self.message.horizon_s, float(look_aheads(self.message.ahead).s[-1])
        return float(min(max(horizon if isfinite(horizon) else 0.0, 0.0), last))

    @property
    def ahead(self) -> np.ndarray:
        """Return the look-ahead of each point, increasing, (n,) [s]."""
        return self._refined_path[0]

    @property
    def path(self) -> np.ndarray:
        """Return the mean positions, scene ENU, (n, 3) [10 m]."""
        return self._refined_path[1]

    @cached_property
    def _refined_path(self) -> tuple[np.ndarray, np.ndarray]:
        message = self.message
        ahead, path = (array.numpy().astype(float) for array in (message.ahead, message.path))
        return refined(ahead, self.scene_frame.from_ned(message.ned_origin(), path))

    @cached_property
    def tube(self) -> np.ndarray:
        """Return the half-axes along, cross, vertical, (n, 3) [10 m]."""
        message = self.message
        ahead, tube = (array.numpy().astype(float) for array in (message.ahead, message.prediction_region_half_axes))
        tube = np.clip(np.nan_to_num(tube / UNIT_M), 0.0, 1e4)
        if len(self.ahead) == len(ahead):
            return tube
        return np.stack([np.interp(self.ahead, ahead, column) for column in tube.T], axis=-1)

    def release_arrays(self) -> None:
        """Release the arrays in scene coordinates; they are computed again on their next use."""
        for name in ("_refined_path", "tube"):
            vars(self).pop(name, None)

    def position_at(self, ahead: np.ndarray | float) -> np.ndarray:
        """Interpolate the mean path at look-aheads (k,) [s] -> (k, 3) [10 m]; constant beyond both ends."""
        return np.stack([np.interp(ahead, self.ahead, self.path[:, i]) for i in range(3)], axis=-1)

    @cached_property
    def alternatives(self) -> tuple["ScenePrediction", ...]:
        """Return the paths that may be flown instead, each with the region of this prediction."""
        message = self.message
        return tuple(
            ScenePrediction(msgspec.structs.replace(message, path=one.path, alternatives=()), self.scene_frame, 0.0)
            for one in message.alternatives
        )

    def half_axes_at(self, ahead: np.ndarray) -> np.ndarray:
        """Interpolate the half-axes at look-aheads (k,) [s] -> (k, 3) [10 m]."""
        return np.stack([np.interp(ahead, self.ahead, self.tube[:, i]) for i in range(3)], axis=-1)

    def to_past(self) -> "PastPrediction":
        """Return the reduced record of this prediction; records share their look-aheads."""
        ahead = look_aheads(self.message.ahead).past
        ned = self.message.path.numpy()[: len(ahead)].copy()
        return PastPrediction(self.t, self.horizon_s, ahead, ned, self.message.origin, self.scene_frame)


class PastPrediction(NamedTuple):
    """Reduced record of a past prediction, as sent: a few hundred bytes."""

    t: float  # start, data time [s since 1970]
    horizon_s: float  # horizon [s]
    ahead: np.ndarray  # (n,) [s]
    ned: np.ndarray  # from `origin`, (n, 3) [m]
    origin: tuple[int, int, int]  # lat, lon [1e-7 deg], alt [mm]
    scene_frame: SceneFrame

    def position_at(self, ahead: np.ndarray | float) -> np.ndarray:
        """Interpolate the mean path at look-aheads (k,) [s] -> (k, 3) [10 m]."""
        path = self.scene_frame.from_ned(self.origin, self.ned)
        return np.stack([np.interp(ahead, self.ahead, path[:, i]) for i in range(3)], axis=-1)


def check_prediction(message: Prediction, scene_frame: SceneFrame, received: float) -> ScenePrediction | None:
    """Check a prediction; return None when it has no path.

    Raises:
        ValueError: when its arrays disagree, are not finite or not increasing in time; the worker must resend.
        OutOfRangeError: when it is farther than 100 km from the fleet.
    """
    ahead, path, tube = message.ahead, message.path.numpy(), message.prediction_region_half_axes.numpy()
    n = ahead.shape[0] if len(ahead.shape) == 1 else -1
    if n == 0 and not ahead.numpy().size:  # raises when the array is invalid
        return None
    if not 2 <= n <= MAX_STEPS or path.shape != (n, 3) or tube.shape != (n, 3):
        raise ValueError(
            f"uav-{message.uav}: prediction has shapes {ahead.shape} {path.shape} {tube.shape}, "
            f"expected (n,) (n, 3) (n, 3) with 2 to {MAX_STEPS} steps; resend"
        )
    if not look_aheads(ahead).is_rising or not isfinite(message.t):
        raise ValueError(f"uav-{message.uav}: prediction has times that do not increase within one hour; resend")
    others = [one.path.numpy() for one in message.alternatives]
    if len(others) > MAX_ALTERNATIVES or any(other.shape != (n, 3) for other in others):
        raise ValueError(
            f"uav-{message.uav}: prediction has {len(others)} alternatives of shapes {[x.shape for x in others[:3]]}, "
            f"expected at most {MAX_ALTERNATIVES} of (n, 3); resend"
        )
    if not all(_is_within_reach(one) for one in (path, *others)):
        raise ValueError(f"uav-{message.uav}: prediction has a path that is not finite or beyond 100 km; resend")
    scene_frame.from_geodetic_point(*message.origin)
    return ScenePrediction(message, scene_frame, received)


def _is_within_reach(path: np.ndarray) -> bool:
    """Return whether all coordinates (n, 3) [m] are finite and at most `REACH_M`."""
    flat = path.reshape(-1)
    if flat.dtype.kind == "f" and np.vdot(flat, flat) <= 0.5 * REACH_M**2:  # bounds each of them, in one call
        return True
    return bool(path.min() >= -REACH_M and path.max() <= REACH_M)  # also rejects NaN


def refined(ahead: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Insert points between look-aheads that are seconds apart, as chords cut turns by metres."""
    steps = np.diff(ahead)
    if steps.max() <= _CHORD_S or len(ahead) < 4:
        return ahead, path
    parts = np.minimum(np.ceil(steps / _CHORD_S), _MAX_PARTS).astype(int)
    at = np.interp(np.arange(parts.sum() + 1), np.concatenate([[0], np.cumsum(parts)]), ahead)
    return at, _cubic(ahead, path, at)


def _cubic(ahead: np.ndarray, path: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate points (n, 3) at look-aheads (k,) with cubic Hermite splines: (k, 3)."""
    slope = np.gradient(path, ahead, axis=0, edge_order=2)
    i = np.clip(np.searchsorted(ahead, at, side="right") - 1, 0, len(ahead) - 2)
    h = (ahead[i + 1] - ahead[i])[:, None]
    s = (at - ahead[i])[:, None] / h
    ends = (1 + 2 * s) * (1 - s) ** 2 * path[i] + s**2 * (3 - 2 * s) * path[i + 1]
    return ends + h * s * (1 - s) * ((1 - s) * slope[i] - s * slope[i + 1])


LOOK_AHEADS_S = np.arange(1.0, 31.0)  # look-aheads at which errors are measured [s]
MIN_PREDICTIONS = 3  # fewer errors at a look-ahead give no RMS


def prediction_errors(predictions: list[PastPrediction], trail: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the position error of every prediction at every look-ahead, from a trail (n, 4 or more).

    Returns:
        issue times (k,) [s] and errors (k, 30) [m]; NaN where the flown position is not available
    """
    if not predictions or len(trail) < 2:
        return np.zeros(0), np.zeros((0, len(LOOK_AHEADS_S)))
    issued = np.array([predicted.t for predicted in predictions])
    due = issued[:, None] + LOOK_AHEADS_S
    actual = np.stack([np.interp(due, trail[:, 0], trail[:, i]) for i in (1, 2, 3)], axis=-1)
    predicted = np.stack([prediction.position_at(LOOK_AHEADS_S) for prediction in predictions])
    distances = UNIT_M * np.linalg.norm(predicted - actual, axis=-1)
    claimed_s = np.array([min(prediction.horizon_s, float(prediction.ahead[-1])) for prediction in predictions])
    unavailable = (due > trail[-1, 0]) | (due < trail[0, 0]) | (claimed_s[:, None] < LOOK_AHEADS_S)
    return issued, np.where(unavailable, np.nan, distances)


def rms_by_look_ahead(distances: np.ndarray) -> np.ndarray:
    """Return the RMS error at each look-ahead, (30,) [m]; NaN for fewer than `MIN_PREDICTIONS` errors."""
    n = np.isfinite(distances).sum(axis=0)
    mean = np.nansum(distances**2, axis=0) / np.maximum(n, 1)
    return np.where(n >= MIN_PREDICTIONS, np.sqrt(mean), np.nan)
