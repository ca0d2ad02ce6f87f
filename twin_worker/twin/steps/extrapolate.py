"""Extrapolate a prediction between two rollouts: continue the last path from the newest position and velocity."""

from math import exp, inf, sqrt

import msgspec
import numpy as np

from fleet.contract import Array, Message, Prediction
from fleet.frames import to_ned
from fleet.physics.kernel import no_alloc_kernel
from twin_worker.numerics.prediction_errors import along_cross_down, track_frame
from twin_worker.telemetry.velocity import MEAN_S, corrected_velocity
from twin_worker.twin.state.state import Twin

MAX_ROLLOUT_AGE_S = 10.0  # maximum age of the continued rollout [s]
MAX_OVERDUE_AGE_S = 150.0  # the same while the next rollout is due and waits for CPU time [s]
_NEAR_S = 5.0  # look-ahead whose region is the scale of a departure [s]
_RETURN_S = 4.0  # time constant of the return to the predicted path, across it and vertically [s]
_SPEED_S = 8.0  # time constant of the return to the predicted ground speed [s]
_MIN_SPEED = 1.0  # slower predicted paths have no direction [m/s]
_MAX_SLOWER = 0.5  # largest speed deficit used, as a share of the predicted speed [-]


@no_alloc_kernel
def _interpolate(ahead: np.ndarray, path: np.ndarray, t: float, j: int) -> float:
    """Return coordinate j of a path (n, 3) at time t, beyond its ends along its first or last segment."""
    k, last = 0, len(ahead) - 2
    while k < last:  # bisection
        middle = (k + last + 1) // 2
        if ahead[middle] <= t:
            k = middle
        else:
            last = middle - 1
    fraction = (t - ahead[k]) / (ahead[k + 1] - ahead[k])
    return path[k, j] + fraction * (path[k + 1, j] - path[k, j])  # type: ignore[no-any-return]


@no_alloc_kernel
def continue_path(
    ahead: np.ndarray, path: np.ndarray, elapsed: float, position: np.ndarray, velocity: np.ndarray, out: np.ndarray
) -> bool:
    """Compute the rest of a path from the position and velocity of the aircraft.

    Guidance returns to the route and the altitude, but nothing makes up for time: an offset d_a along the path remains,
    and a difference of ground speed v_a decays. With the ground speed V of the path p at `elapsed`:

        lead(tau) = (d_a + v_a T_a (1 - exp(-tau / T_a))) / V,  T_a = 8 s
        out(tau) = p(elapsed + tau + lead(tau)) + (d + (w + d / T) tau) exp(-tau / T),  T = 4 s

    d and w are the differences of position and velocity that the lead leaves, critically damped. Without a velocity
    v_a and w are 0. A path slower than 1 m/s has no lead.

    Args:
        ahead, path: look-aheads, rising, and positions, (n,) and (n, 3) [s, m]
        elapsed: time since the start of the path [s]
        position: current position, (3,) [m]
        velocity: current ground velocity, (3,), nan if unknown [m/s]
        out: positions at `ahead` from now, (k, 3) [m]; the last at most `elapsed` before the path's end
    Returns:
        whether an offset along the path remains
    """
    north = _interpolate(ahead, path, elapsed + 0.5, 0) - _interpolate(ahead, path, elapsed - 0.5, 0)
    east = _interpolate(ahead, path, elapsed + 0.5, 1) - _interpolate(ahead, path, elapsed - 0.5, 1)
    speed = sqrt(north**2 + east**2)
    known = abs(velocity[0]) + abs(velocity[1]) + abs(velocity[2]) < inf  # false for nan
    moves = speed > _MIN_SPEED
    lead, faster = 0.0, 0.0  # [s, -]
    if moves:
        offset_n = position[0] - _interpolate(ahead, path, elapsed, 0)
        offset_e = position[1] - _interpolate(ahead, path, elapsed, 1)
        lead = (offset_n * north + offset_e * east) / speed**2
        if known:
            faster = max((velocity[0] * north + velocity[1] * east) / speed**2 - 1.0, -_MAX_SLOWER)
    for j in range(3):
        start = elapsed + lead
        offset = position[j] - _interpolate(ahead, path, start, j)
        slope = _interpolate(ahead, path, start + 0.5, j) - _interpolate(ahead, path, start - 0.5, j)
        drift = velocity[j] - slope * (1.0 + faster) if known else 0.0
        for i in range(len(out)):
            tau = ahead[i]
            t = start + tau + faster * _SPEED_S * (1.0 - exp(-tau / _SPEED_S))
            fade = exp(-tau / _RETURN_S)
            out[i, j] = _interpolate(ahead, path, t, j) + (offset + (drift + offset / _RETURN_S) * tau) * fade
    return moves


@no_alloc_kernel
def widen_tube(ahead: np.ndarray, tube: np.ndarray, elapsed: float, keeps_along: bool, out: np.ndarray) -> None:
    """Compute the half-axes at the rollout's age, never below those of a new one.

    With e(tau) the rollout's error, of independent increments, and phi the share of the present offset that is left,
    1 along the path and (1 + tau / T) exp(-tau / T) otherwise, the error from now on is e(age + tau) - phi e(age):

        h(tau)^2 = h_0(age + tau)^2 - h_0(age)^2 phi (2 - phi)

    Args:
        ahead, tube: look-aheads, rising, and half-axes along, across, down, (n,) and (n, 3) [s, m]
        elapsed: age of the rollout [s]
        keeps_along: the offset along the path remains, see `continue_path`
        out: half-axes at `ahead` from now, (k, 3) [m]; the last at most `elapsed` before the tube's end
    Source: Bar-Shalom 2001, section 4.3 (covariance propagation of a process with independent increments).
    """
    for j in range(3):
        initial = _interpolate(ahead, tube, elapsed, j)
        for i in range(len(out)):
            share = 1.0 if keeps_along and j == 0 else (1.0 + ahead[i] / _RETURN_S) * exp(-ahead[i] / _RETURN_S)
            variance = _interpolate(ahead, tube, elapsed + ahead[i], j) ** 2 - initial**2 * share * (2.0 - share)
            out[i, j] = max(sqrt(max(variance, 0.0)), tube[i, j])


def extrapolate(twin: Twin) -> list[Message]:
    """Continue the last rollout from the newest position and velocity; return nothing without a recent position."""
    if twin.prediction.last_rollout is None:
        return []
    since = twin.telemetry.history.newest - 2.0 * MEAN_S
    t, rows = twin.telemetry.history.rows_since("position", since)
    current = len(t) > 0 and t[-1] > max(twin.prediction.last_rollout.t, twin.telemetry.history.newest - 1.0)
    velocity = twin.telemetry.history.rows_since("velocity", since)
    prediction = propagate(twin, t, rows, *velocity) if current else None
    if prediction is None:
        return []
    if prediction.origin == twin.telemetry.origin:
        twin.confidence.tracker.add_extrapolated(
            prediction.t, prediction.method, prediction.path.numpy(), prediction.prediction_region_half_axes.numpy()
        )
    twin.prediction.publish(prediction)
    return [prediction]


def can_propagate(twin: Twin, t: float) -> bool:
    """Return whether a recent rollout with telemetry exists to continue at `t`."""
    rollout = twin.prediction.last_rollout
    if rollout is None or twin.telemetry.link_lost or twin.prediction.position_lost or rollout.coast_s:
        return False
    return t < rollout.t + (MAX_OVERDUE_AGE_S if rollout_overdue(twin, t) else MAX_ROLLOUT_AGE_S)


def rollout_overdue(twin: Twin, t: float) -> bool:
    """Return whether the longest period between rollouts is over at `t`: the next one waits for CPU time."""
    return t >= twin.prediction.predict_timer.last + twin.config.schedule.longest_predict


def _item_changed(t: np.ndarray, item: np.ndarray, since: float) -> bool:
    """Return whether the newest reported mission item is another than that of time `since` [s since 1970]."""
    before = max(int(t.searchsorted(since, side="right")) - 1, 0)
    return len(t) > 0 and bool(item[-1] != item[before])


def departure(twin: Twin) -> float:
    """Return the distance of the aircraft from its last rollout, along, cross and vertical in half-axes, the largest.

    inf where it cannot be extrapolated, or where the aircraft is on another mission item than at the rollout.
    """
    rollout, history = twin.prediction.last_rollout, twin.telemetry.history
    t, rows = history.rows_since("position", history.newest - 1.0)
    if rollout is None or not len(t) or not can_propagate(twin, float(t[-1])):
        return inf
    leg_t, leg = history.rows_since("leg")
    elapsed, ahead = float(t[-1]) - rollout.t, rollout.ahead.numpy()
    k = int(ahead.searchsorted(elapsed, side="right"))
    if not 0 < k < len(ahead) or _item_changed(leg_t, leg[:, 0], rollout.t):
        return inf
    part = slice(max(k - 2, 0), k + 1)
    path, between = rollout.path.numpy()[part].astype(float), ahead[part].astype(float)
    nominal = path[-2] + (elapsed - between[-2]) / (between[-1] - between[-2]) * (path[-1] - path[-2])
    error = along_cross_down(track_frame(path, between)[-2], to_ned(rollout.ned_origin(), *rows[-1]) - nominal)
    near = int(ahead.searchsorted(_NEAR_S))
    return float(np.max(np.abs(error) / rollout.prediction_region_half_axes.numpy()[min(near, len(ahead) - 1)]))


def propagate(twin: Twin, t: np.ndarray, rows: np.ndarray, velocity_t: np.ndarray, v: np.ndarray) -> Prediction | None:
    """Return the last rollout continued from the newest position and velocity; the twin is not changed.

    The local frame is that of the path, since the twin's origin may have moved. The horizon ends at the same time as
    that of the path. See `continue_path`.

    Args:
        twin: the aircraft's twin
        t, rows: times and positions, newest last, (n,) and (n, 3) [s since 1970; 1e-7 deg, mm]
        velocity_t, v: times and ground velocities, newest last, NED, (k,) and (k, 3) [s since 1970, m/s]
    """
    rollout = twin.prediction.last_rollout
    if (
        rollout is None
        or twin.telemetry.origin is None
        or not can_propagate(twin, float(t[-1]))
        or not (elapsed := float(t[-1]) - rollout.t) > 0.0
    ):
        return None
    ahead = rollout.ahead.numpy()
    n = int(ahead.searchsorted(float(ahead[-1]) - elapsed, side="right"))
    if n < 2:
        return None
    out, tube = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
    positions = to_ned(rollout.ned_origin(), *rows.T)
    velocity = corrected_velocity(t, positions, velocity_t, v)
    keeps_along = continue_path(ahead, rollout.path.numpy(), elapsed, positions[-1], velocity, out)  # type: ignore[call-arg]
    widen_tube(ahead, rollout.prediction_region_half_axes.numpy(), elapsed, keeps_along, tube)  # type: ignore[call-arg]
    coverage, coverage_n = twin.confidence.tracker.extrapolated_coverage
    return msgspec.structs.replace(
        rollout,
        t=float(t[-1]),
        state=twin.prediction.state,
        ahead=Array(rollout.ahead.dtype, (n,), rollout.ahead.data[: ahead.itemsize * n]),
        path=Array("<f4", (n, 3), out.tobytes()),
        prediction_region_half_axes=Array("<f4", (n, 3), tube.tobytes()),
        horizon_s=max(rollout.horizon_s - elapsed, 0.0),
        rollout_age_s=rollout.rollout_age_s + elapsed,
        coverage_propagated=coverage,
        coverage_propagated_n=coverage_n,
        controller=None,
    )
