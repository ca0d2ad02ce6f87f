"""What is said of an aircraft whose twin is being worked on: its last path, from the position heard last."""

import numpy as np

from fleet.contract import Message, Prediction
from twin_worker.claims.keeper import Held
from twin_worker.engine.pace import SOON
from twin_worker.renew import LATEST_S, renewed

_FARTHEST = 2e9  # positions beyond are noise [1e-7 deg, mm]


def stand_in(held: Held) -> Prediction | None:
    """Renew a prediction for a twin that is locked, which may be for seconds on a busy machine; it stays as it is."""
    twin, rows = held.twin, held.placed
    if rows is None or not held.ready:
        return None
    try:
        t, x = rows.t.numpy(), rows.x.numpy().astype(float)
    except ValueError:
        return None
    if not len(t) or x.shape != (len(t), 3) or not (np.abs(x[-1]) < _FARTHEST).all():
        return None
    said = max(held.stood, twin.prediction.t if twin.prediction else -np.inf)
    if not t[-1] >= said + SOON * min(twin.pace.renew, twin.pace.predict):
        return None
    made = renewed(twin, float(t[-1]), x[-1])
    if made is not None:
        held.stood = made.t
    return made


def said_already(result: Message, held: Held) -> bool:
    """Tell whether a prediction, come late, is older than what was said meanwhile."""
    return isinstance(result, Prediction) and held.stood - LATEST_S < result.t <= held.stood
