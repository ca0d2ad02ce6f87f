"""Made-up predictions with known answers."""

import numpy as np

from fleet.contract import Array, Prediction, TwinState
from fleet.frames import Origin

T = 1_700_000_000.0
HERE = Origin(470_000_000, 80_000_000, 500_000)
AHEAD = np.concatenate([np.arange(0.0, 61.0), np.arange(63.0, 181.0, 3.0)])


def straight(
    uav: int = 1,
    p=(0.0, 0.0, -100.0),
    v=(20.0, 0.0, 0.0),
    *,
    half=(10.0, 5.0, 4.0),
    grow: float = 0.0,
    ahead: np.ndarray = AHEAD,
    **more,
) -> Prediction:
    """Fly straight on from `p` [m] at `v` [m/s]; the tube's half-axes grow by `grow` [m/s]."""
    path = np.asarray(p, float) + ahead[:, None] * np.asarray(v, float)
    tube = np.asarray(half, float) + grow * ahead[:, None]
    what = {"t": T, "state": TwinState.PREDICTING, "method": "dynamics", "origin": tuple(HERE)} | more
    return Prediction(
        uav=uav, ahead=Array.of(ahead), path=Array.of(path), prediction_region_half_axes=Array.of(tube), **what
    )
