"""A prediction between two flights ahead: the path of the last one, begun at the newest position."""

from math import exp

import msgspec
import numpy as np

from fleet.contract import Array, Message, Prediction
from fleet.frames import to_ned
from fleet.physics.kernel import kernel
from twin_worker.memory import Twin

LATEST_S = 10.0  # after a flight ahead it is renewed no longer [s]
OVERDUE_S = 150.0  # the same where the next is due and has to wait for CPU time: better than nothing [s]
_BACK_S = 10.0  # in which an aircraft is back on the path that was foreseen [s]


@kernel
def shifted(ahead: np.ndarray, path: np.ndarray, passed: float, at: np.ndarray, out: np.ndarray) -> None:
    """Fill in the rest of a path from where the aircraft is now.

    Args:
        ahead, path: look-aheads, rising, and positions, (n,) and (n, 3) [s, m]
        passed: time since it began [s]
        at: where the aircraft is, (3,) [m]
        out: positions `ahead` from now, (k, 3) [m]; the last at most `passed` before the path's end
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


def renew(twin: Twin) -> list[Message]:
    """Give the last path that was flown ahead, from the newest position on; nothing where there is neither."""
    if twin.base is None:
        return []
    t, rows = twin.history.look("position", max(twin.base.t, twin.history.newest - 1.0))
    made = renewed(twin, float(t[-1]), rows[-1]) if len(t) else None
    if made is None:
        return []
    twin.prediction = made
    return [made]


def renewable(twin: Twin, t: float) -> bool:
    """Tell whether there is a path to renew at `t`: flown while telemetry came, and not long before."""
    base = twin.base
    if base is None or twin.lost or twin.broken or base.coast_s:
        return False
    return t < base.t + (OVERDUE_S if overdue(twin, t) else LATEST_S)


def overdue(twin: Twin, t: float) -> bool:
    """Tell whether at `t` the next flight ahead is due, but was not made: it waits for CPU time."""
    return t >= twin.predict_t + twin.pace.predict


def renewed(twin: Twin, t: float, position: np.ndarray) -> Prediction | None:
    """Give the last path that was flown ahead from a position on, (3,) [1e-7 deg, mm] at `t`; the twin stays as it is.

    The departure so far, d, fades:  p(tau) = path(t - t0 + tau) + d exp(-tau / 10 s).
    """
    base = twin.base
    if base is None or twin.origin is None or not renewable(twin, t) or not (passed := t - base.t) > 0.0:
        return None
    ahead = base.ahead.numpy()
    n = int(ahead.searchsorted(float(ahead[-1]) - passed, side="right"))
    if n < 2:
        return None
    out = np.empty((n, 3), np.float32)
    shifted(ahead, base.path.numpy(), passed, to_ned(twin.origin, *position), out)  # type: ignore[call-arg]
    return msgspec.structs.replace(
        base,
        t=t,
        state=twin.state,
        ahead=Array(base.ahead.dtype, (n,), base.ahead.data[: ahead.itemsize * n]),
        path=Array("<f4", (n, 3), out.tobytes()),
        tube=Array(base.tube.dtype, (n, 3), base.tube.data[: ahead.itemsize * 3 * n]),
        controller=None,
    )
