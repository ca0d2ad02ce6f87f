"""The compiled loops of a prediction give what numpy gives, to the last bit."""

import numpy as np
import pytest

from twin_worker.calibration.miss import AHEAD, track_frame
from twin_worker.compiled.straight import straight


@pytest.mark.parametrize("beyond", [None, np.nan])
@pytest.mark.parametrize("n", [1, 2, 7, 150])
def test_straight_lines_are_those_of_numpy(n: int, beyond: float | None) -> None:
    rng = np.random.default_rng(n)
    t, x = np.cumsum(rng.uniform(0.01, 2.0, n)), 1e3 * rng.standard_normal((n, 3))
    x[n // 2, 1] = np.nan
    at = np.concatenate([rng.uniform(-5.0, t[-1] + 5.0, 60), t])
    rng.shuffle(at)
    wanted = np.column_stack([np.interp(at, t, column, right=beyond) for column in x.T])
    assert np.array_equal(straight(at, t, x, beyond), wanted, equal_nan=True)


def test_a_track_frame_is_the_slope_of_second_order() -> None:
    path = np.cumsum(20.0 * np.random.default_rng(1).standard_normal((4, len(AHEAD), 3)), axis=1)
    path[0, :5] = path[0, 0]  # it stands
    slope = np.gradient(path[..., :2], AHEAD, axis=-2)
    length = np.linalg.norm(slope, axis=-1)
    found = track_frame(path)
    assert np.allclose(found[length > 1e-6], (slope / np.maximum(length, 1e-9)[..., None])[length > 1e-6], atol=1e-12)
    assert (found[length <= 1e-6] == [1.0, 0.0]).all() and (length <= 1e-6).sum() == 4
    assert np.array_equal(track_frame(path[2, :40]), track_frame(path[:, :40])[2])
