"""Hindcast: an earlier prediction compared with the flown path."""

import numpy as np

from viewer.scene.labels import Tag
from viewer.scene.strokes import dashed
from viewer.store.forecast import Kept

AGE_S, SPAN_S = 25.0, 5.0  # age of the compared prediction and its tolerance [s]
LEAST_S = 5.0  # shortest stretch drawn [s]
NONE = np.zeros((0, 2, 3)), None


def hindcast(past: list[Kept], trail: np.ndarray, clock: float) -> tuple[np.ndarray, Tag | None]:
    """Return an earlier prediction and error lines to the flown trail every 5 s.

    Args:
        past: predictions, oldest first
        trail: data time [s], scene ENU [10 m], (n, 4 or more)
        clock: current data time [s]
    Returns:
        segments (k, 2, 3) and their label
    """
    old = [told for told in past if AGE_S - SPAN_S <= clock - told.t <= AGE_S + SPAN_S]
    if not old or len(trail) < 2:
        return NONE
    told = min(old, key=lambda one: abs(clock - one.t - AGE_S))
    reach = min(clock - told.t, told.until, float(trail[-1, 0] - told.t))  # at most the horizon
    if reach < LEAST_S:
        return NONE
    at = np.arange(5.0, reach, 5.0)
    happened = np.stack([np.interp(told.t + at, trail[:, 0], trail[:, i]) for i in (1, 2, 3)], axis=-1)
    lines = np.concatenate(
        [dashed(told.at(np.linspace(0, reach, 2 * int(reach) + 2))), np.stack([told.at(at), happened], axis=1)]
    )
    return lines, Tag("then", f"predicted {clock - told.t:.0f} s ago", told.at(0.4 * reach))
