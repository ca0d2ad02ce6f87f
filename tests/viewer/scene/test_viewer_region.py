"""The prediction region in the scene: a smooth surface that fades with its width, and time marks in order."""

from types import SimpleNamespace
from unittest.mock import MagicMock

import msgspec
import numpy as np
import pytest

from fleet.contract import AlternativePath, Array, Prediction
from tests.support.pretend_feed import HOME, STAMP, Clock, PretendUav, T, feed_of
from viewer.scene.selection.pins import (
    SIDES,
    TURN_STEPS,
    mark_tags,
    pass_number,
    rings,
    surface_sides,
    tube_faces,
)
from viewer.scene.selection.selected import (
    BAND_STEPS,
    BANDS,
    FAR_OPACITY,
    NEAR_OPACITY,
    Selection,
    band_opacities,
    slice_times,
)
from viewer.store.forecast import MAX_ALTERNATIVES, ScenePrediction, check_prediction
from viewer.store.place import SceneFrame
from viewer.theme.palette import DARK

N = BANDS * BAND_STEPS + 1


def arc(radius: float, angle: float, n: int = N) -> np.ndarray:
    """Give a level left turn that begins eastwards."""
    turn = np.linspace(0, angle, n)
    return np.stack([radius * np.sin(turn), radius * (1 - np.cos(turn)), np.full(n, 10.0)], axis=-1)


def volumes(sections: np.ndarray) -> np.ndarray:
    """Give six times the signed volume of each face's tetrahedron with the middle of its slice: positive is outward."""
    corners, faces = sections.reshape(-1, 3), tube_faces(len(sections))
    a, b, c = (corners[faces[:, k]] for k in range(3))
    middle = sections.mean(axis=1)[faces.min(axis=1) // SIDES]
    return np.einsum("ij,ij->i", np.cross(b - a, c - a), (a + b + c) / 3 - middle)


def test_a_wide_region_does_not_fold_inside_a_turn() -> None:
    path, axes = arc(8.0, np.pi), np.tile([1.0, 12.0, 3.0], (N, 1))
    assert volumes(rings(path, axes)).min() < -1e-3  # in full width it folds
    sides = surface_sides(path, axes)
    assert volumes(rings(path, axes, sides)).min() > -1e-6
    assert np.allclose(sides[:, 1], 12.0) and np.allclose(
        sides[TURN_STEPS + 1 : -TURN_STEPS - 1, 0], 0.9 * 8.0, rtol=0.01
    )
    mirrored = surface_sides(path * [1, -1, 1], axes)
    assert np.allclose(mirrored[:, ::-1], sides)


def test_straight_and_hovering_paths_keep_their_full_width() -> None:
    axes = np.linspace(1, 9, N)[:, None] * np.ones(3)
    straight = np.linspace([0, 0, 5.0], [60, 20, 5.0], N)
    still = np.tile([3.0, 4.0, 5.0], (N, 1)) + np.random.default_rng(1).normal(0, 1e-3, (N, 3))
    for path in (straight, still):
        assert np.allclose(surface_sides(path, axes), axes[:, 1:2])
    assert np.isfinite(surface_sides(np.zeros((N, 3)), axes)).all()


def test_the_surface_fades_where_it_is_wide_and_nowhere_vanishes() -> None:
    unit = 4.0
    narrow = np.full((N, 3), 0.1 * unit)
    later = band_opacities(narrow, unit)
    assert later[0] == NEAR_OPACITY and (np.diff(later) < 0).all() and later[-1] < 0.4 * NEAR_OPACITY
    growing = band_opacities(np.linspace(0.2, 60, N)[:, None] * np.ones(3), unit)
    assert growing.shape == (BANDS,) and (np.diff(growing) <= 0).all()
    assert growing[-1] == pytest.approx(FAR_OPACITY) and growing[0] > 2 * growing[-1]
    assert np.isfinite(band_opacities(np.zeros((N, 3)), unit)).all()


def test_marks_of_one_place_share_a_label_in_the_order_of_time() -> None:
    lows = np.array([[0, 0, 0], [50, 0, 0], [0.5, 0, 0], [90, 0, 0]], float)
    tags = mark_tags([5, 10, 20, 30], lows, [1, 1, 2, 1], 2.0)
    assert [tag.text for tag in tags] == ["+5 s, +20 s pass 2", "+10 s", "+30 s"]
    assert np.allclose(tags[0].at, lows[0]) and len({tag.key for tag in tags}) == 3
    assert mark_tags([], lows[:0], [], 2.0) == []


def test_passes_through_one_place_are_counted() -> None:
    circles = arc(10.0, 4.5 * np.pi, 400)  # two and a quarter rounds
    assert pass_number(circles, 0, 1.0) == 1 and pass_number(circles, 100, 1.0) == 1
    assert pass_number(circles, 100 + round(2 / 4.5 * 399), 1.0) == 2
    eight = np.stack([np.sin(np.linspace(0, 2 * np.pi, 300)), np.sin(np.linspace(0, 4 * np.pi, 300))], -1) * 30
    crossing = np.column_stack([eight, np.zeros(300)])
    assert pass_number(crossing, 150, 1.0) == 2 and pass_number(crossing, 100, 1.0) == 1


def test_slices_follow_the_turns_of_a_path() -> None:
    """A minute straight ahead, then two minutes of a circle flown six times: no chord turns by more than 30 degrees."""

    def position_at(at: np.ndarray) -> np.ndarray:
        turn = 2 * np.pi * 6 * np.clip(at - 60.0, 0.0, None) / 120.0
        east = 1.5 * np.minimum(at, 60.0) + 4 * np.sin(turn)
        return np.stack([east, 4 * (1 - np.cos(turn)), np.full(len(at), 10.0)], axis=-1)

    def sharpest(at: np.ndarray) -> float:
        legs = np.diff(position_at(at), axis=0)
        course = np.unwrap(np.arctan2(legs[:, 1], legs[:, 0]))
        return float(np.degrees(np.abs(np.diff(course)).max()))

    at = slice_times(SimpleNamespace(position_at=position_at), 2.0, 180.0)
    assert len(at) == N and at[0] == 2.0 and at[-1] == 180.0 and (np.diff(at) > 0).all()
    assert sharpest(at) < 31.0 < sharpest(np.linspace(2.0, 180.0, N))
    hovering = SimpleNamespace(position_at=lambda at: np.zeros((len(at), 3)))
    assert np.allclose(slice_times(hovering, 0.0, 60.0), np.linspace(0.0, 60.0, N))


# --- alternative paths -----------------------------------------------------------------------------------------------


def doubtful(n: int = 1, rows: int | None = None) -> Prediction:
    """A prediction with other paths, each 200 m further north."""
    message = PretendUav(0).prediction(T, 0.0)
    paths = [message.path.numpy()[:rows] + np.array([200.0 * (k + 1), 0.0, 0.0]) for k in range(n)]
    others = tuple(
        AlternativePath(probability=0.25, path=Array.of(path), sentence="continues the mission: why") for path in paths
    )
    return msgspec.structs.replace(message, alternatives=others)


@pytest.mark.parametrize("message", [doubtful(rows=3), doubtful(MAX_ALTERNATIVES + 1)])
def test_alternatives_of_another_shape_or_too_many_are_refused(message: Prediction) -> None:
    assert check_prediction(doubtful(2), SceneFrame(HOME), 0.0) is not None
    with pytest.raises(ValueError, match="alternatives of shapes"):
        check_prediction(message, SceneFrame(HOME), 0.0)


def test_an_alternative_has_the_region_of_the_prediction_on_a_path_of_its_own() -> None:
    forecast = ScenePrediction(doubtful(), SceneFrame(HOME), 0.0)
    (other,) = forecast.alternatives
    at = np.linspace(0.0, 20.0, 5)
    assert other.position_at(at) - forecast.position_at(at) == pytest.approx(np.tile([0.0, 20.0, 0.0], (5, 1)), abs=0.1)
    assert np.array_equal(other.half_axes_at(at), forecast.half_axes_at(at))


def test_an_alternative_is_drawn_dashed_with_its_region_and_probability() -> None:
    feed, _, bus = feed_of(Clock())
    scene = MagicMock()
    scene.add_mesh_simple.return_value.opacity = 0.0
    selection = Selection(scene, DARK)
    drawn = []
    for message in (doubtful(0), doubtful(2)):
        bus.publish(msgspec.structs.replace(message, t=message.t + 0.1 * (len(drawn) + 1)), STAMP)
        vehicle = feed.get(0)
        assert vehicle is not None
        selection._thin.draw_parts = lambda parts: drawn.append(sum(len(x.reshape(-1, 2, 3)) for x, _ in parts))  # type: ignore[method-assign]
        selection.draw(vehicle, feed, 0.5, ground=0.0, unit=1.0)
    assert drawn[1] > drawn[0] + 2 * 50
    assert [tag.text for tag in selection.tags if tag.key.startswith("alternative")] == [
        "25 %: continues the mission",
        "25 %: continues the mission",
    ]
