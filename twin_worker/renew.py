"""A prediction between two flights ahead: the path of the last one, begun at the newest position."""

import msgspec
import numpy as np

from fleet.contract import Array, Message
from fleet.frames import to_ned
from twin_worker.memory import Twin
from twin_worker.predict import LEAST_AHEAD_S

LATEST_S = 10.0  # after a flight ahead it is renewed no longer [s]
_BACK_S = 10.0  # in which an aircraft is back on the path that was foreseen [s]


def renew(twin: Twin) -> list[Message]:
    """Give the last path that was flown ahead, from the newest position on; nothing where there is neither.

    The departure so far, d, fades:  p(tau) = path(t - t0 + tau) + d exp(-tau / 10 s).
    """
    base = twin.base
    if base is None or twin.origin is None or twin.lost or twin.broken or base.coast_s:
        return []
    t, rows = twin.history.rows("position", max(base.t, twin.history.newest - 1.0))
    if not len(t) or not 0.0 < (passed := float(t[-1]) - base.t) < LATEST_S:
        return []
    ahead = base.ahead.numpy().astype(float)
    keep = ahead <= ahead[-1] - passed
    ahead = ahead[keep]
    if not len(ahead) or ahead[-1] < LEAST_AHEAD_S:
        return []
    at, path = base.ahead.numpy().astype(float), base.path.numpy().astype(float)
    on = np.column_stack([np.interp(passed + ahead, at, column) for column in path.T])
    off = to_ned(twin.origin, *rows[-1:].T)[0] - on[0]
    twin.prediction = msgspec.structs.replace(
        base,
        t=float(t[-1]),
        state=twin.state,
        ahead=Array.of(ahead),
        path=Array.of(on + np.exp(-ahead / _BACK_S)[:, None] * off),
        tube=Array.of(base.tube.numpy()[keep]),
        controller=None,
    )
    return [twin.prediction]
