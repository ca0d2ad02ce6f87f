"""Extrapolate a prediction between two rollouts: continue the last path from the newest position."""

from math import exp, sqrt

import msgspec
import numpy as np

from fleet.contract import Array, Message, Prediction
from fleet.frames import to_ned
from fleet.physics.kernel import kernel
from twin_worker.twin.state.state import Twin

LATEST_S = 10.0  # maximum age of the continued rollout [s]
OVERDUE_S = 150.0  # the same while the next rollout is due and waits for CPU time [s]
_BACK_S = 10.0  # time constant of the return to the predicted path [s]


@kernel
def shifted(ahead: np.ndarray, path: np.ndarray, passed: float, at: np.ndarray, out: np.ndarray) -> None:
    """Compute the rest of a path, shifted to the aircraft's current position.

    Args:
        ahead, path: look-aheads, rising, and positions, (n,) and (n, 3) [s, m]
        elapsed: time since the start of the path [s]
        position: current position, (3,) [m]
        out: positions at `ahead` from now, (k, 3) [m]; the last at most `elapsed` before the path's end
    """
    off, k = np.zeros(3), 0
    for i in range(len(out)):
        t = passed + ahead[i]
        while k < len(ahead) - 2 and ahead[k + 1] < t:
            k += 1
        share = min(max((t - ahead[k]) / (ahead[k + 1] - ahead[k]), 0.0), 1.0)
        fade = exp(-ahead[i] / _BACK_S)
        for j in range(3):
            there = path[k, j] + share * (path[k + 1, j] - path[k, j])
            if i == 0:
                off[j] = at[j] - there
            out[i, j] = there + fade * off[j]


@kernel
def widened(ahead: np.ndarray, tube: np.ndarray, passed: float, out: np.ndarray) -> None:
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
    before, later, k = np.zeros(3), np.zeros(3), 0
    for i in range(-1, len(out)):
        t = passed + (ahead[i] if i >= 0 else 0.0)
        while k < len(ahead) - 2 and ahead[k + 1] < t:
            k += 1
        share = min(max((t - ahead[k]) / (ahead[k + 1] - ahead[k]), 0.0), 1.0)
        for j in range(3):
            later[j] = tube[k, j] + share * (tube[k + 1, j] - tube[k, j])
        if i < 0:
            before[:] = later
            continue
        fade = exp(-ahead[i] / _BACK_S)
        for j in range(3):
            square = later[j] ** 2 - before[j] ** 2 * fade * (2.0 - fade)
            out[i, j] = max(sqrt(max(square, 0.0)), tube[i, j])


def renew(twin: Twin) -> list[Message]:
    """Continue the last rollout from the newest position; return nothing if either is missing."""
    if twin.base is None:
        return []
    t, rows = twin.history.look("position", max(twin.base.t, twin.history.newest - 1.0))
    made = renewed(twin, float(t[-1]), rows[-1]) if len(t) else None
    if made is None:
        return []
    if made.origin == twin.origin:
        twin.record.keep_renewed(made.t, made.method, made.path.numpy(), made.tube.numpy())
    twin.prediction = made
    return [made]


def renewable(twin: Twin, t: float) -> bool:
    """Return whether a recent rollout with telemetry exists to continue at `t`."""
    base = twin.base
    if base is None or twin.lost or twin.broken or base.coast_s:
        return False
    return t < base.t + (OVERDUE_S if overdue(twin, t) else LATEST_S)


def overdue(twin: Twin, t: float) -> bool:
    """Return whether the next rollout is due at `t` but was not made because it waits for CPU time."""
    return t >= twin.predict_t + twin.pace.predict


def renewed(twin: Twin, t: float, position: np.ndarray) -> Prediction | None:
    """Return the last rollout continued from a position, (3,) [1e-7 deg, mm] at `t`; the twin is not changed.

    The offset d from the path fades:  p(tau) = path(t - t0 + tau) + d exp(-tau / 10 s). The local frame is that of the
    path, since the twin's origin may have moved. The horizon ends at the same time as that of the path.
    """
    base = twin.base
    if base is None or twin.origin is None or not renewable(twin, t) or not (passed := t - base.t) > 0.0:
        return None
    ahead = base.ahead.numpy()
    n = int(ahead.searchsorted(float(ahead[-1]) - passed, side="right"))
    if n < 2:
        return None
    out, tube = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
    shifted(ahead, base.path.numpy(), passed, to_ned(base.ned_origin(), *position), out)  # type: ignore[call-arg]
    widened(ahead, base.tube.numpy(), passed, tube)  # type: ignore[call-arg]
    coverage, coverage_n = twin.record.coverage_renewed
    return msgspec.structs.replace(
        base,
        t=t,
        state=twin.state,
        ahead=Array(base.ahead.dtype, (n,), base.ahead.data[: ahead.itemsize * n]),
        path=Array("<f4", (n, 3), out.tobytes()),
        tube=Array("<f4", (n, 3), tube.tobytes()),
        horizon_s=max(base.horizon_s - passed, 0.0),
        rollout_age_s=base.rollout_age_s + passed,
        coverage_renewed=coverage,
        coverage_renewed_n=coverage_n,
        controller=None,
    )
