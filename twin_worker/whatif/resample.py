"""Look-ahead times of a query, and a prediction resampled to them."""

import msgspec
import numpy as np
from scipy.interpolate import CubicSpline

from fleet.contract import Array, Prediction
from twin_worker.confidence.tube_and_horizon import AHEAD


def read_grid(settings: dict[str, str]) -> np.ndarray | None:
    """Read `?horizon=30;step=0.5` into look-ahead times [s]; None without either.

    Raises:
        ValueError: when they are not numbers or would give more than 1,000 points.
    """
    if not settings.keys() & {"horizon", "step"}:
        return None
    try:
        horizon, step = float(settings.get("horizon", AHEAD[-1])), float(settings.get("step", 1.0))
    except ValueError:
        raise ValueError(
            f"query: found {settings}, expected numbers, e.g. ?horizon=30;step=0.5; correct them"
        ) from None
    if not (0 < horizon <= AHEAD[-1] and 0 < step <= 60 and horizon / step <= 1000):
        raise ValueError(
            f"query: found horizon {horizon}, step {step}, expected at most {AHEAD[-1]:.0f} s and 1,000 points; "
            "correct them"
        )
    return np.arange(0.0, horizon + 1e-9, step)


def resample(prediction: Prediction, grid: np.ndarray | None) -> Prediction:
    """Return the prediction on other look-ahead times, (n,) [s], up to its end; unchanged for None."""
    if grid is None:
        return prediction
    ahead = prediction.ahead.numpy().astype(float)
    grid = grid[grid <= ahead[-1] + 1e-6]
    path = CubicSpline(ahead, prediction.path.numpy())(
        grid
    )  # linear interpolation over 4 s of a turn has errors of metres
    tube = np.column_stack(
        [np.interp(grid, ahead, column) for column in prediction.prediction_region_half_axes.numpy().T]
    )
    return msgspec.structs.replace(
        prediction, ahead=Array.of(grid), path=Array.of(path), prediction_region_half_axes=Array.of(tube)
    )
