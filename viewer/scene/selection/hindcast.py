"""What was predicted for now some time ago, beside what happened."""

import numpy as np

from viewer.scene.labels import Tag
from viewer.scene.strokes import dashed
from viewer.store.forecast import Kept

AGE_S, SPAN_S = 25.0, 5.0  # how old the prediction is that is laid beside what happened, give or take [s]
LEAST_S = 5.0  # a shorter stretch says nothing [s]
NONE = np.zeros((0, 2, 3)), None


def hindcast(past: list[Kept], trail: np.ndarray, clock: float) -> tuple[np.ndarray, Tag | None]:
    """Lay an old prediction beside the flown trail, with a whisker every 5 s to where it was then.

    Args:
        past: forecasts, oldest first
        trail: fleet time [s], scene ENU [10 m], (n, 4 or more)
        clock: data time now [s]
    Returns:
        segments (k, 2, 3) and their label
    """
    old = [told for told in past if AGE_S - SPAN_S <= clock - told.t <= AGE_S + SPAN_S]
    if not old or len(trail) < 2:
        return NONE
    told = min(old, key=lambda one: abs(clock - one.t - AGE_S))
    reach = min(clock - told.t, told.until, float(trail[-1, 0] - told.t))  # past its horizon it claimed nothing
    if reach < LEAST_S:
        return NONE
    at = np.arange(5.0, reach, 5.0)
    happened = np.stack([np.interp(told.t + at, trail[:, 0], trail[:, i]) for i in (1, 2, 3)], axis=-1)
    lines = np.concatenate(
        [dashed(told.at(np.linspace(0, reach, 2 * int(reach) + 2))), np.stack([told.at(at), happened], axis=1)]
    )
    return lines, Tag("then", f"predicted {clock - told.t:.0f} s ago", told.at(0.4 * reach))
