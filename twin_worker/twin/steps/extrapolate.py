"""Extrapolate a prediction between two rollouts: continue the last path from the newest position."""

from math import exp, inf, sqrt

import msgspec
import numpy as np

from fleet.contract import Array, Message, Prediction
from fleet.frames import to_ned
from fleet.physics.kernel import kernel
from twin_worker.numerics.prediction_errors import along_cross_down, track_frame
from twin_worker.twin.state.state import Twin

MAX_ROLLOUT_AGE_S = 10.0  # maximum age of the continued rollout [s]
MAX_OVERDUE_AGE_S = 150.0  # the same while the next rollout is due and waits for CPU time [s]
_NEAR_S = 5.0  # look-ahead whose region is the scale of a departure [s]
_FADE_TIME_S = 10.0  # time constant of the return to the predicted path [s]


@kernel
def shift_to_position(
    ahead: np.ndarray, path: np.ndarray, elapsed: float, position: np.ndarray, out: np.ndarray
) -> None:
    """Compute the rest of a path, shifted to the aircraft's current position.

    Args:
        ahead, path: look-aheads, rising, and positions, (n,) and (n, 3) [s, m]
        elapsed: time since the start of the path [s]
        position: current position, (3,) [m]
        out: positions at `ahead` from now, (k, 3) [m]; the last at most `elapsed` before the path's end
    """
    offset, k = np.zeros(3), 0
    for i in range(len(out)):
        t = elapsed + ahead[i]
        while k < len(ahead) - 2 and ahead[k + 1] < t:
            k += 1
        fraction = min(max((t - ahead[k]) / (ahead[k + 1] - ahead[k]), 0.0), 1.0)
        fade = exp(-ahead[i] / _FADE_TIME_S)
        for j in range(3):
            nominal = path[k, j] + fraction * (path[k + 1, j] - path[k, j])
            if i == 0:
                offset[j] = position[j] - nominal
            out[i, j] = nominal + fade * offset[j]


@kernel
def widen_tube(ahead: np.ndarray, tube: np.ndarray, elapsed: float, out: np.ndarray) -> None:
    """Compute the half-axes at the rollout's age, never below those of a new one.

    With e(tau) the rollout's error, of independent increments, and phi = exp(-tau / 10 s), the error from now on is
    e(age + tau) - phi e(age):

        h(tau)^2 = h_0(age + tau)^2 - h_0(age)^2 phi (2 - phi)

    Args:
        ahead, tube: look-aheads, rising, and half-axes, (n,) and (n, 3) [s, m]
        elapsed: age of the rollout [s]
        out: half-axes at `ahead` from now, (k, 3) [m]; the last at most `elapsed` before the tube's end
    Source: Bar-Shalom 2001, section 4.3 (covariance propagation of a process with independent increments).
    """
    initial, later, k = np.zeros(3), np.zeros(3), 0
    for i in range(-1, len(out)):
        t = elapsed + (ahead[i] if i >= 0 else 0.0)
        while k < len(ahead) - 2 and ahead[k + 1] < t:
            k += 1
        fraction = min(max((t - ahead[k]) / (ahead[k + 1] - ahead[k]), 0.0), 1.0)
        for j in range(3):
            later[j] = tube[k, j] + fraction * (tube[k + 1, j] - tube[k, j])
        if i < 0:
            initial[:] = later
            continue
        fade = exp(-ahead[i] / _FADE_TIME_S)
        for j in range(3):
            variance = later[j] ** 2 - initial[j] ** 2 * fade * (2.0 - fade)
            out[i, j] = max(sqrt(max(variance, 0.0)), tube[i, j])


def extrapolate(twin: Twin) -> list[Message]:
    """Continue the last rollout from the newest position; return nothing if either is missing."""
    if twin.prediction.last_rollout is None:
        return []
    t, rows = twin.telemetry.history.rows_since(
        "position", max(twin.prediction.last_rollout.t, twin.telemetry.history.newest - 1.0)
    )
    prediction = propagate(twin, float(t[-1]), rows[-1]) if len(t) else None
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
    nominal = np.array([np.interp(elapsed, between, column) for column in path.T])
    error = along_cross_down(track_frame(path, between)[-2], to_ned(rollout.ned_origin(), *rows[-1]) - nominal)
    near = int(ahead.searchsorted(_NEAR_S))
    return float(np.max(np.abs(error) / rollout.prediction_region_half_axes.numpy()[min(near, len(ahead) - 1)]))


def propagate(twin: Twin, t: float, position: np.ndarray) -> Prediction | None:
    """Return the last rollout continued from a position, (3,) [1e-7 deg, mm] at `t`; the twin is not changed.

    The offset d from the path fades:  p(tau) = path(t - t0 + tau) + d exp(-tau / 10 s). The local frame is that of the
    path, since the twin's origin may have moved. The horizon ends at the same time as that of the path.
    """
    rollout = twin.prediction.last_rollout
    if (
        rollout is None
        or twin.telemetry.origin is None
        or not can_propagate(twin, t)
        or not (elapsed := t - rollout.t) > 0.0
    ):
        return None
    ahead = rollout.ahead.numpy()
    n = int(ahead.searchsorted(float(ahead[-1]) - elapsed, side="right"))
    if n < 2:
        return None
    out, tube = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
    shift_to_position(ahead, rollout.path.numpy(), elapsed, to_ned(rollout.ned_origin(), *position), out)  # type: ignore[call-arg]
    widen_tube(ahead, rollout.prediction_region_half_axes.numpy(), elapsed, tube)  # type: ignore[call-arg]
    coverage, coverage_n = twin.confidence.tracker.extrapolated_coverage
    return msgspec.structs.replace(
        rollout,
        t=t,
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
