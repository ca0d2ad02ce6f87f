"""Regions of paths that turn or climb: an aircraft that is early or late is off across or vertically there."""

import numpy as np

from tests.support.made_up import GROUP, LINE, V
from twin_worker.confidence.calibration.fit_table import fit
from twin_worker.confidence.calibration.scored_predictions import ScoredPredictions, concatenate
from twin_worker.confidence.calibration_table import UncertaintyFeatures
from twin_worker.numerics.prediction_errors import AHEAD, displacement_along_path, path_length


def test_who_is_late_on_a_circle_is_off_across_and_in_a_climb_vertically():
    radius, late, angle = 240.0, 30.0, AHEAD / 12.0
    circle = np.column_stack([radius * np.sin(angle), radius * (1 - np.cos(angle)), -0.1 * radius * angle])
    displacement = displacement_along_path(np.stack([circle, LINE]), np.full((2, len(AHEAD)), late))
    assert np.allclose(displacement[0, 5:55, 1], radius * (1 - np.cos(late / radius)), rtol=0.03)
    assert np.allclose(displacement[0, 5:55, 2], 0.1 * late, rtol=0.01)
    assert np.allclose(displacement[1], 0.0, atol=1e-9) and (displacement[..., 0] == 0.0).all()
    assert displacement[0, 0, 1] > 0.0  # the path has no past, so the aircraft is early
    beyond = displacement_along_path(circle, np.full(len(AHEAD), 1e9))
    assert np.isfinite(beyond).all() and np.isfinite(displacement_along_path(0.0 * circle, np.ones(len(AHEAD)))).all()


def _turning(rng: np.random.Generator, starts: int, flight: str) -> ScoredPredictions:
    """Make up predictions with a right-angle turn at a random time, flown early or late by about a second."""
    turn_s, late_s = rng.uniform(10.0, 50.0, starts), rng.normal(0.0, 1.0, starts)

    def at(t: np.ndarray) -> np.ndarray:
        before, after = np.minimum(t, turn_s[:, None]), np.maximum(t - turn_s[:, None], 0.0)
        return V * np.stack([before, after, np.zeros_like(before)], axis=-1)

    path, flown = at(np.tile(AHEAD, (starts, 1))), at(AHEAD - late_s[:, None]) + rng.normal(0, 0.2, (starts, 91, 3))
    length = np.tile(path_length(LINE, V), (starts, 1))
    spread = np.full_like(path, 0.1)
    names = np.full(starts, flight)
    return ScoredPredictions(
        np.arange(starts) * 5.0,
        path,
        UncertaintyFeatures(spread, spread, path),
        flown,
        length,
        length,
        np.full(starts, GROUP),
        np.full(starts, "route"),
        names,
    )


def test_a_region_is_wide_across_the_path_only_where_the_path_turns():
    rng = np.random.default_rng(8)
    table = fit(concatenate([_turning(rng, 60, f"flight-{i}") for i in range(8)]), GROUP)
    fresh = _turning(rng, 1000, "fresh")
    cross, column = table.half_axes(fresh.features, AHEAD)[..., 1], 30
    late_after_turn = 30.0 - np.argmax(fresh.path[..., 1] > 0, axis=1)
    straight, turned = np.abs(late_after_turn) > 5, (late_after_turn >= 0) & (late_after_turn <= 1)
    assert np.median(cross[turned, column]) > 4.0 * np.median(cross[straight, column])
    inside = np.abs(fresh.errors()[:, column, 1]) <= cross[:, column]
    assert inside[straight].mean() >= 0.9 and inside[turned].mean() >= 0.8
