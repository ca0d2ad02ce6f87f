"""Separation of two aircraft: the probability against its closed form, frames, screening, and one word per conflict."""

from dataclasses import dataclass

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from fleet.contract import Alert, AlertKind, Array, Prediction
from fleet.frames import Origin, to_geodetic, to_ned
from tests.support.predicted import AHEAD, HERE, T, straight
from twin_worker.alerts.conflict_probability import Separation
from twin_worker.alerts.gaussian_forecast import axis_z, to_gaussian
from twin_worker.alerts.traffic import TrafficMonitor
from twin_worker.confidence.calibration.fit_table import conformal_factors

Z = axis_z(0.9)


def probability(a: Prediction, b: Prediction, separation: Separation = Separation()) -> float:  # noqa: B008
    """What the lower id's judge finds; 0 where it follows nothing up."""
    traffic = TrafficMonitor(separation)
    for made in (a, b):
        traffic.receive(made)
    found = traffic._conflicts(min(a.uav, b.uav), T)
    return found[0].probability if found else 0.0


def crossing(miss: float, above: float, sigma: float, at: float = 60.0) -> tuple[Prediction, Prediction]:
    """Two that cross at right angles after `at` s, the other `miss` m late in its own frame and `above` m higher."""
    half = np.full(3, Z * sigma)
    a = straight(1, (-20.0 * at, 0.0, -100.0), (20.0, 0.0, 0.0), half=half)
    b = straight(2, (0.0, -20.0 * at - miss * np.sqrt(2), -100.0 - above), (0.0, 20.0, 0.0), half=half)
    return a, b


@settings(max_examples=60)
@given(
    miss=st.floats(-400, 400),
    above=st.floats(-60, 60),
    sigma=st.floats(2.0, 80.0),
    at=st.floats(30.0, 120.0),
)
def test_a_straight_crossing_has_its_closed_form(miss: float, above: float, sigma: float, at: float) -> None:
    """Paielli & Erzberger: the miss is across the relative velocity, at right angles with sigma sqrt(2)."""
    wide, high = 50.0, 20.0
    s = sigma * np.sqrt(2)
    closed = (norm.cdf((wide - miss) / s) - norm.cdf((-wide - miss) / s)) * (
        norm.cdf((high - above) / s) - norm.cdf((-high - above) / s)
    )
    found = probability(*crossing(miss, above, sigma, at))
    given_up = found == 0.0 and closed < 0.1  # 32 draws without a hit: half of what an alert needs, at most
    assert given_up or found == pytest.approx(closed, abs=0.06)


@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("miss", [0.0, 60.0, 150.0])
def test_the_probability_is_that_of_the_errors_the_region_was_calibrated_on(miss: float, together: bool) -> None:
    """Monte Carlo: normal errors in each axis, of one size in all three or of three; one overtakes the other."""
    rng, sigma, n = np.random.default_rng(4), np.array([60.0, 70.0, 3.0]), 40_000
    size = np.abs(rng.standard_normal((2, n, 1 if together else 3))) * np.ones(3)
    error = rng.choice([-1.0, 1.0], (2, n, 3)) * size * sigma
    factor, alone = conformal_factors(size[0][:, None], np.ones(n))
    assert (size[0] <= factor).all(axis=1).mean() == pytest.approx(0.9, abs=0.01)  # it is the region's quantile
    half = {"half": factor * sigma, "axis_quantile": alone}
    a, b = straight(1, **half), straight(2, (-900.0, miss, -100.0), (30.0, 0.0, 0.0), **half)
    apart = error[1] - error[0] + np.array([0.0, miss, 0.0])  # when it passes, whenever that is
    lost = (np.abs(apart[:, 1]) < 50.0) & (np.abs(apart[:, 2]) < 20.0)
    assert probability(a, b) == pytest.approx(lost.mean(), abs=0.02)


def test_certain_and_impossible() -> None:
    assert probability(*crossing(0.0, 0.0, 1.0)) == 1.0
    assert probability(*crossing(0.0, 60.0, 1.0)) == 0.0
    assert probability(*crossing(150.0, 0.0, 5.0)) == 0.0
    assert probability(*crossing(10.0, 0.0, 1.0), Separation(5.0, 20.0)) == 0.0


def test_flying_abreast_clear_is_no_conflict_and_closing_in_slowly_is() -> None:
    assert probability(straight(1), straight(2, (0.0, 120.0, -100.0))) == 0.0
    assert probability(straight(1), straight(2, (0.0, 300.0, -100.0), (20.0, -1.8, 0.0))) == 1.0
    assert probability(straight(1, v=(0.0, 0.0, 0.0)), straight(2, (10.0, 0.0, -100.0), (0.0, 0.0, 0.0))) == 1.0


def test_heights_that_cross_elsewhere_are_no_conflict() -> None:
    """Within one step both limits are broken, but not at one instant."""
    a = straight(1, v=(0.0, 0.0, 0.0), half=(0.2, 0.2, 0.2))
    b = straight(2, (-60.0 * 61, 0.0, -100.0 - 61 * 30.0 + 60.0), (60.0, 0.0, 30.0), half=(0.2, 0.2, 0.2))
    assert probability(a, b) == 0.0


@settings(max_examples=40)
@given(lat=st.floats(-60, 60), lon=st.floats(-180, 179.9), north=st.floats(-2e4, 2e4), east=st.floats(-2e4, 2e4))
def test_origins_do_not_matter(lat: float, lon: float, north: float, east: float) -> None:
    """The same flight about another origin, also across the date line."""
    here = Origin(round(lat * 1e7), round(lon * 1e7), 300_000)
    there = Origin(*map(int, to_geodetic(here, np.array([north, east, 50.0]))))
    a, b = crossing(30.0, 5.0, 20.0)
    a, b = (straight_about(here, one) for one in (a, b))
    moved = about(there, b)
    assert probability(a, moved) == pytest.approx(probability(a, b), abs=0.02)
    (near,) = judged(a, moved)
    (same,) = judged(a, b)
    assert abs(near.predicted_t - same.predicted_t) < 0.5 and near.other == 2
    assert abs(near.lat - same.lat) <= 2 and abs(near.alt - same.alt) <= 2


def straight_about(origin: Origin, one: Prediction) -> Prediction:
    return remade(one, origin=tuple(origin))


def about(origin: Origin, one: Prediction) -> Prediction:
    """The same flight, written about another origin."""
    corners = to_geodetic(one.ned_origin(), np.array([[0.0, 0.0, 0.0], [1e5, 1e5, 1e5]]))
    image = to_ned(origin, *corners.T)
    path = one.path.numpy() * (image[1] - image[0]) / 1e5 + image[0]
    return remade(one, origin=tuple(origin), path=Array.of(path, "<f8"))


def remade(one: Prediction, **changes) -> Prediction:
    return msgspec.structs.replace(one, **changes)


def judged(a: Prediction, b: Prediction, seconds: int = 9) -> list[Alert]:
    """What is raised when both predictions are repeated for a while."""
    traffic, out = TrafficMonitor(), []
    for one in (a, b):
        traffic.receive(one)
    for k in range(seconds):
        out += traffic.assess(1, T + k)
    return out


def test_another_continent_is_far() -> None:
    a, b = crossing(0.0, 0.0, 5.0)
    for origin in (Origin(-330_000_000, 1_510_000_000, 0), Origin(470_000_000, -1_790_000_000, 500_000)):
        assert judged(a, remade(b, origin=tuple(origin))) == []


# --- once -----------------------------------------------------------------------------------------------------------


@dataclass
class Two:
    """Two aircraft that fly on and predict every second."""

    a: Prediction
    b: Prediction
    sigma_per_s: float = 0.5

    def alerts(self, seconds: int, uav: int = 1) -> list[Alert]:
        traffic, out = TrafficMonitor(), []
        for k in range(seconds):
            for one in (self.a, self.b):
                path = one.path.numpy().astype(float)
                step = path[1] - path[0]
                tube = 2.0 + self.sigma_per_s * Z * AHEAD[:, None] * np.ones(3) * [1.0, 0.2, 0.1]
                traffic.receive(
                    remade(one, t=T + k, path=Array.of(path + k * step), prediction_region_half_axes=Array.of(tube))
                )
            out += traffic.assess(uav, T + k + 0.3)
        return out


def test_a_crossing_is_told_once_before_and_taken_back_once_after() -> None:
    raised, over = Two(*crossing(10.0, 2.0, 1.0, at=90.0)).alerts(120)
    assert raised.active and not over.active and (raised.uav, raised.other, raised.kind) == (1, 2, AlertKind.CONFLICT)
    assert raised.t < T + 60 and T + 90 < over.t < T + 102
    assert raised.predicted_t == pytest.approx(T + 90, abs=1.5) and 0.2 <= raised.probability <= 1
    place = to_geodetic(HERE, np.array([0.0, 0.0, -100.0]))
    assert abs(raised.lat - place[0]) < 400 and abs(raised.lon - place[1]) < 600 and abs(raised.alt - place[2]) < 2_000
    assert raised.sentence.startswith("uav-1: ") and "uav-2" in raised.sentence and "50 m" in raised.sentence
    assert over.predicted_t is None and over.lat is None and over.probability is None and "uav-2" in over.sentence


def test_a_clear_pass_is_never_told() -> None:
    assert Two(*crossing(150.0, 0.0, 1.0, at=90.0)).alerts(120) == []
    assert Two(*crossing(0.0, 60.0, 1.0, at=90.0)).alerts(120) == []


def test_the_higher_id_says_nothing() -> None:
    assert Two(*crossing(0.0, 0.0, 1.0, at=90.0)).alerts(60, uav=2) == []


def test_predictions_that_cease_withdraw_the_alert() -> None:
    a, b = crossing(0.0, 0.0, 5.0)
    traffic, out = TrafficMonitor(), []
    for one in (a, b):
        traffic.receive(one)
    for k in range(30):
        out += traffic.assess(1, T + k)
    assert [x.active for x in out] == [True, False] and 10 < out[1].t - T < 18
    assert traffic.active(1) == []


def test_a_judge_that_is_asked_often_judges_once_a_second() -> None:
    traffic = TrafficMonitor()
    for one in crossing(0.0, 0.0, 5.0, at=30.0):
        traffic.receive(one)
    assert [traffic.assess(1, T + 0.05 * k) for k in range(40)] == [[]] * 40  # 2 s, and it must last
    assert len(traffic.assess(1, T + 2.0)) == 1
    assert [alert.other for alert in traffic.active(1)] == [2]
    assert traffic.assess(1, float("nan")) == [] and traffic.assess(9, T) == []


# --- hostile --------------------------------------------------------------------------------------------------------

NAN, INF = float("nan"), float("inf")
BAD = {
    "nan path": {"path": Array.of(np.full((len(AHEAD), 3), NAN))},
    "far path": {"path": Array.of(np.full((len(AHEAD), 3), 1e20))},
    "nan tube": {"prediction_region_half_axes": Array.of(np.full((len(AHEAD), 3), NAN))},
    "negative tube": {"prediction_region_half_axes": Array.of(np.full((len(AHEAD), 3), -1.0))},
    "times that stand still": {"ahead": Array.of(np.zeros(len(AHEAD)))},
    "nan times": {"ahead": Array.of(np.full(len(AHEAD), NAN))},
    "shapes that disagree": {"path": Array.of(np.zeros((5, 3)))},
    "flat arrays": {"path": Array.of(np.zeros(3))},
    "nothing": {
        "ahead": Array.of([]),
        "path": Array.of(np.zeros((0, 3))),
        "prediction_region_half_axes": Array.of(np.zeros((0, 3))),
    },
    "broken bytes": {"path": Array("<f4", (3, 3), b"")},
    "quantile 1": {"quantile": 1.0},
    "quantile nan": {"quantile": NAN},
    "nan time": {"t": NAN},
    "endless time": {"t": INF},
    "no earth": {"origin": (2_000_000_000, 0, 0)},
    "the pole": {"origin": (900_000_000, 0, 0)},
}


@pytest.mark.parametrize("changes", BAD.values(), ids=BAD.keys())
def test_a_prediction_that_cannot_be_judged_raises_nothing_and_harms_nobody(changes: dict) -> None:
    a, b = crossing(0.0, 0.0, 5.0)
    c = remade(straight(3, (0.0, 0.0, -100.0)), **changes)
    assert to_gaussian(c) is None
    traffic, out = TrafficMonitor(), []
    for one in (a, b, c):
        traffic.receive(one)
    for k in range(9):
        out += traffic.assess(1, T + k) + traffic.assess(3, T + k)
    assert [(x.uav, x.other) for x in out] == [(1, 2)]


def test_a_prediction_of_one_point_is_judged() -> None:
    one = np.array([0.0])
    a, b = straight(1, ahead=one), straight(2, (10.0, 0.0, -100.0), ahead=one)
    assert T % 2 == 0 and probability(a, b) == 1.0
    assert probability(remade(a, t=T + 0.5), b) == 0.0  # between two instants of the grid it says nothing


def test_strangers_do_not_fill_the_memory() -> None:
    traffic = TrafficMonitor()
    made = straight(1, ahead=np.array([0.0, 1.0, 2.0]))
    for uav in range(5_000):
        traffic.receive(remade(made, uav=uav))
    traffic.assess(1, T)
    assert len(traffic.picture.uav) <= 8_192


def test_a_forecast_is_the_prediction_on_whole_steps() -> None:
    made = straight(1, t=T + 0.7, grow=0.5)
    found = to_gaussian(made)
    assert found is not None and found.t[0] == T + 2.0 and (np.diff(found.t) == 2.0).all()
    assert found.t[-1] <= T + 0.7 + 180
    np.testing.assert_allclose(found.path[:, 0], 20.0 * (found.t - T - 0.7), atol=1e-3)
    np.testing.assert_allclose(found.sigma[10] * Z, [10, 5, 4] + 0.5 * (found.t[10] - T - 0.7), rtol=1e-5)
    draws = found.draws()
    held = (np.abs(draws - found.path) <= found.sigma * Z).all(axis=2)  # path is north: along is north
    assert held.mean() == pytest.approx(0.9, abs=0.03)


def test_a_half_axis_is_as_many_sigma_as_an_axis_alone_holds() -> None:
    assert axis_z(0.9) == pytest.approx(2.114, abs=1e-3) and axis_z(0.9, 0.9) == pytest.approx(1.645, abs=1e-3)
    assert axis_z(0.9, 0.94) == pytest.approx(norm.ppf(0.97))
    for odd in (0.0, 0.5, 0.99, 1.0, NAN, INF):  # cannot be of a region that holds 0.9
        assert axis_z(0.9, odd) == axis_z(0.9)


def test_covariance_turns_with_the_path() -> None:
    found = to_gaussian(straight(1, v=(15.0, 15.0, 0.0), half=(20.0, 5.0, 3.0)))
    assert found is not None
    nn, ne, ee, dd = found.covariance()[5]
    assert np.allclose(np.linalg.eigvalsh([[nn, ne], [ne, ee]]), np.array([5.0, 20.0]) ** 2 / Z**2) and ne > 0
    assert dd == pytest.approx(9 / Z**2)
    spread = np.cov((found.draws()[:, 5] - found.path[5]).T)
    assert np.allclose(spread[:2, :2], [[nn, ne], [ne, ee]], rtol=0.1)
