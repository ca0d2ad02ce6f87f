"""Hindcast: an earlier prediction compared with the flown path."""

import numpy as np

from viewer.scene.labels import Tag
from viewer.scene.strokes import dashed
from viewer.store.forecast import PastPrediction

AGE_S, SPAN_S = 25.0, 5.0  # age of the compared prediction and its tolerance [s]
MIN_REACH_S = 5.0  # shortest stretch drawn [s]
NO_HINDCAST = np.zeros((0, 2, 3)), None


def hindcast(past: list[PastPrediction], trail: np.ndarray, clock: float) -> tuple[np.ndarray, Tag | None]:
    """Return an earlier prediction and error lines to the flown trail every 5 s.

    Args:
        past: predictions, oldest first
        trail: data time [s], scene ENU [10 m], (n, 4 or more)
        clock: current data time [s]
    Returns:
        segments (k, 2, 3) and their label
    """
    old = [prediction for prediction in past if AGE_S - SPAN_S <= clock - prediction.t <= AGE_S + SPAN_S]
    if not old or len(trail) < 2:
        return NO_HINDCAST
    prediction = min(old, key=lambda candidate: abs(clock - candidate.t - AGE_S))
    reach = min(clock - prediction.t, prediction.horizon_s, float(trail[-1, 0] - prediction.t))  # at most the horizon
    if reach < MIN_REACH_S:
        return NO_HINDCAST
    at = np.arange(5.0, reach, 5.0)
    actual = np.stack([np.interp(prediction.t + at, trail[:, 0], trail[:, i]) for i in (1, 2, 3)], axis=-1)
    lines = np.concatenate(
        [
            dashed(prediction.position_at(np.linspace(0, reach, 2 * int(reach) + 2))),
            np.stack([prediction.position_at(at), actual], axis=1),
        ]
    )
    return lines, Tag("then", f"predicted {clock - prediction.t:.0f} s ago", prediction.position_at(0.4 * reach))
