"""Distribution of a type from the data of its aircraft: recovered from drawn ones, differences, bad data refused."""

from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as with_fields

from fleet.airframes import GENERIC, load
from fleet.contract import Array, SiblingData, Siblings
from fleet.frames import G
from fleet.physics.wrench import NAMES
from tests.support.examples import EXAMPLES
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel, prior
from twin_worker.identification.fixed_wing.siblings import (
    TERMS,
    data_defect,
    estimate_type,
    prior_of_type,
    sibling_data,
    type_defect,
)

AIRFRAME = load(GENERIC)
V, THROTTLE = 22.0, 0.5
NOMINAL, SIGMA = prior(AIRFRAME, np.array([V, 0.0]), np.array([0.0, 0.0, 0.0, THROTTLE]), np.zeros(2))
CENTRE = np.array([*(NOMINAL[NAMES.index(name)] for name in TERMS[:-1]), 0.0]) * 1.2  # not where the prior is
SCALE = np.array([*(SIGMA[NAMES.index(name)] for name in TERMS[:-1]), 2.0])
SPREAD = 0.05 * np.abs(CENTRE) + 1e-3 * SCALE
DRAG = -NOMINAL[NAMES.index("X_u")] * V / 4.5


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(8)


def fleet(count: int, rng: np.random.Generator, precision: float = 50.0) -> dict[int, SiblingData]:
    """Draw aircraft, each with data that determine its terms to 1 / `precision` of their prior."""
    information = np.diag((precision / SCALE) ** 2)
    out = {}
    for uav in range(count):
        theta = CENTRE + SPREAD * rng.standard_normal(len(TERMS))
        measured = theta + SCALE / precision * rng.standard_normal(len(TERMS))
        out[uav] = data(information, measured)
    return out


def data(information: np.ndarray, theta: np.ndarray) -> SiblingData:
    score = Array.of(information @ theta, "<f8")
    return SiblingData(
        airframe_type="x", airspeed=V, throttle=THROTTLE, information=Array.of(information, "<f8"), score=score
    )


def test_mean_and_spread_are_recovered(rng: np.random.Generator) -> None:
    found = estimate_type(fleet(30, rng), AIRFRAME)
    assert found is not None and found.uavs == tuple(range(30)) and not type_defect(found)
    sigma = np.sqrt(np.diag(found.covariance.numpy()))
    assert np.all(np.abs(found.mean.numpy() - CENTRE) < 0.3 * sigma + 0.02 * SCALE)
    big = np.abs(CENTRE) > 0.2 * SCALE  # elsewhere the least spread of a type counts
    assert np.all((sigma[big] > 0.5 * SPREAD[big]) & (sigma[big] < 2.5 * SPREAD[big]))


def test_what_the_data_do_not_tell_stays_as_the_airframe_says(rng: np.random.Generator) -> None:
    silent = {uav: data(np.zeros((len(TERMS),) * 2), CENTRE) for uav in range(5)}
    found = estimate_type(silent, AIRFRAME)
    assert found is not None
    np.testing.assert_allclose(found.mean.numpy(), CENTRE / 1.2, atol=1e-9)
    assert np.all(np.diag(found.covariance.numpy()) > 0.9 * SCALE**2)


def test_an_aircraft_with_more_drag_is_named_with_its_size(rng: np.random.Generator) -> None:
    ordinary = fleet(12, rng)
    found = estimate_type(ordinary, AIRFRAME)
    assert found is not None and found.differences == ()
    information = ordinary[3].information.numpy()
    theta = CENTRE.copy()
    theta[-1] -= 0.5 * DRAG
    found = estimate_type({**ordinary, 3: data(information, theta)}, AIRFRAME)
    assert found is not None and [(one.uav, one.group) for one in found.differences] == [(3, "drag")]
    (one,) = found.differences
    assert one.ratio == pytest.approx(0.5, abs=0.1) and one.p < 1e-3
    assert one.sentence == f"uav-3: drag {one.ratio:.0%} above its 11 siblings"


def test_too_few_aircraft_tell_nothing(rng: np.random.Generator) -> None:
    assert estimate_type(fleet(2, rng), AIRFRAME) is None


def test_derivatives_are_referred_to_another_airspeed(rng: np.random.Generator) -> None:
    found = estimate_type(fleet(5, rng), AIRFRAME)
    assert found is not None
    rows, mean, covariance = prior_of_type(found, 2.0 * found.airspeed)
    values = dict(zip((NAMES[k] for k in rows), mean / found.mean.numpy()[:-1], strict=True))
    assert (values["Z_w"], values["M_de"], values["X_dt"]) == (2.0, 4.0, 1.0)
    assert np.all(np.linalg.eigvalsh(covariance) > 0.0)


def model(fisher: np.ndarray, par: np.ndarray) -> DerivativesModel:
    precision = np.diag(SIGMA**-2.0)
    trim = np.array([V, 1.1])
    return DerivativesModel(par, trim, fisher, NOMINAL, precision, np.ones(9), (NOMINAL, precision), 0.0, 30.0, 1)


def test_the_prior_of_an_aircraft_is_no_data() -> None:
    one = sibling_data(model(np.zeros((37, 37)), NOMINAL), THROTTLE, "x")
    assert one is not None and not data_defect(one)
    assert np.abs(one.information.numpy()).max() < 1e-6 and np.abs(one.score.numpy()).max() < 1e-6


def test_the_data_of_an_aircraft_are_told_whatever_its_prior() -> None:
    """The posterior of data about `truth` and of the prior: the data alone say `truth`, thrust minus drag included."""
    truth, fisher = 1.3 * NOMINAL, np.diag(1e4 * SIGMA**-2.0)
    precision = np.diag(SIGMA**-2.0)
    par = np.linalg.solve(fisher + precision, fisher @ truth + precision @ NOMINAL)
    one = sibling_data(model(fisher, par), THROTTLE, "x")
    assert one is not None
    estimate = dict(zip(TERMS, np.linalg.solve(one.information.numpy(), one.score.numpy()), strict=True))
    for name in ("Z_w", "L_p", "M_q", "X_dt"):
        assert estimate[name] == pytest.approx(truth[NAMES.index(name)], rel=1e-3)
    x_trim = truth[NAMES.index("X_0")] + THROTTLE * truth[NAMES.index("X_dt")]
    assert estimate["excess"] == pytest.approx(x_trim - G * 1.1 / V, rel=1e-2)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"information": Array.of(np.eye(3), "<f8")}, "shapes"),
        ({"information": Array.of(-np.eye(len(TERMS)), "<f8")}, "not positive"),
        ({"information": Array.of(np.triu(np.ones((len(TERMS),) * 2)), "<f8")}, "not symmetric"),
        ({"score": Array.of(np.full(len(TERMS), np.nan), "<f8")}, "not finite"),
        ({"airspeed": float("inf")}, "airspeed"),
    ],
)
def test_bad_data_are_refused(change: dict, text: str, rng: np.random.Generator) -> None:
    good = fleet(3, rng)[0]
    assert data_defect(good) == ""
    assert text in data_defect(with_fields(good, **change))


def test_bad_distributions_are_refused() -> None:
    (good,) = EXAMPLES[Siblings].types
    assert type_defect(good) == ""
    assert "positive definite" in type_defect(with_fields(good, covariance=Array.of(np.zeros((30, 30)), "<f8")))
    assert "shapes" in type_defect(with_fields(good, uavs=(1, 2)))
    assert "not finite" in type_defect(with_fields(good, airspeed=float("nan")))


def test_a_model_states_how_many_siblings_its_prior_has() -> None:
    assert model(np.eye(37), NOMINAL).siblings == 0
    assert replace(model(np.eye(37), NOMINAL), siblings=9).siblings == 9
