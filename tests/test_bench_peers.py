"""What stands between a peer and its score: no peer is needed, only made-up ones of known quality."""

import numpy as np
import pytest

from tests.bench.identification import gusty, peers
from tests.bench.identification.flight import Flight
from tests.bench.identification.measure import run, summary
from tests.bench.identification.sparse import Polynomial
from tests.bench.identification.statespace import StateSpace, assembled, chosen
from tests.bench.identification.windows import spans

DT = 0.04
A = np.array([[0.97, 0.08, 0.0], [-0.08, 0.97, 0.0], [0.0, 0.0, 0.9]])
B = np.array([[0.1, 0.0], [0.0, 0.2], [0.1, 0.1]])
C = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -0.5]])
D = np.array([[0.0, 0.3], [0.0, 0.0]])


def simulated(n: int, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Outputs and inputs of a known system under random inputs."""
    rng = np.random.default_rng(4)
    u, x, y = rng.standard_normal((n, 2)), np.array([1.0, -1.0, 0.5]), np.empty((n, 2))
    for k in range(n):
        y[k] = C @ x + D @ u[k]
        x = A @ x + B @ u[k]
    return y + noise * rng.standard_normal(y.shape), u


@pytest.mark.parametrize("K", [None, np.full((3, 2), 5.0)], ids=["no gain", "an unstable gain"])
def test_a_true_model_starts_from_the_true_state_and_foretells_everything(K):
    y, u = simulated(600)
    model = assembled((A, B, C, D, K), y[:400], u[:400], DT)
    assert np.allclose(model.forecast(u[400:]), y[400:], atol=1e-6)
    for k in (1, 25):
        assert np.allclose(model.kstep(y[400:], u[400:], k), y[400 + k :], atol=1e-6)
    assert np.abs(np.linalg.eigvals(A - model.K @ C)).max() < 1


def test_the_gain_corrects_what_the_start_got_wrong():
    y, u = simulated(600)
    model = assembled((A, B, C, D, None), y[:400], u[:400], DT)
    model.x = model.x + 5.0
    told = model.kstep(y[400:], u[400:], 1)
    assert np.abs(told[0] - y[401]).max() > 0.3 and np.abs(told[150:] - y[551:]).max() < 0.05


def test_a_package_that_gives_no_finite_model_has_failed():
    y, u = simulated(100)
    with pytest.raises(ValueError, match="not finite"):
        assembled((A * np.nan, B, C, None, None), y, u, DT)


def test_the_choice_is_made_on_data_held_back_and_fitted_on_all():
    y, u = simulated(400, noise=0.01)
    fitted = []

    def fit(y, u, dt, scale) -> StateSpace:
        fitted.append((scale, len(y)))
        if scale == 0.0:
            raise SystemExit("no such order")
        return assembled((A * scale, B, C, D, None), y, u, dt)

    model = chosen(fit, (0.0, 0.9, 1.0, 1.01), y, u, DT)
    assert np.array_equal(model.A, A) and model.ms > 0
    assert fitted[-1] == (1.0, 400) and all(n == 300 for _, n in fitted[:-1])
    assert len(fitted) == 5
    fitted.clear()
    with pytest.raises(SystemExit):
        chosen(fit, (0.0,), y, u, DT)
    assert fitted == [(0.0, 400)]


def test_a_polynomial_is_integrated_as_its_equation_says():
    powers = np.array([[0, 0], [1, 0], [0, 1], [2, 0]])
    model = Polynomial(powers, np.array([[0.0, -2.0, 2.0, 0.0]]), DT, np.array([3.0]))
    told = model.forecast(np.ones((50, 1)))[:, 0]
    assert told == pytest.approx(1 + 2 * np.exp(-2 * DT * np.arange(50)), abs=1e-6)
    assert model.kstep(told[:, None], np.ones((50, 1)), 10)[:, 0] == pytest.approx(told[10:], abs=1e-5)
    burst = Polynomial(powers, np.array([[0.0, 0.0, 0.0, 9.0]]), DT, np.array([3.0]))
    assert np.isfinite(burst.forecast(np.ones((500, 1)))).all()


def window(u: np.ndarray) -> Flight:
    n = len(u)
    x = np.random.default_rng(1).standard_normal((n, 9))
    return Flight("made-up", 0, DT, DT * np.arange(n), x, u, np.full(n, np.nan), np.ones(n, bool), 2.0)


def test_a_peer_is_not_given_inputs_that_stand_still_or_repeat_another():
    u = np.random.default_rng(2).standard_normal((300, 4))
    u[:, 2] = -0.3 * u[:, 0] + 0.1  # the rudder is mixed from the aileron
    u[:, 3] = 0.4
    assert peers.standard(window(u), "lat").inputs == [0]
    assert peers.standard(window(u), "lon").inputs == [1]
    u[:, 1] = 0.0
    like = peers.standard(window(u), "lon")
    assert like.inputs == [1] and np.isfinite(like.u(u)).all()
    scaled = like.y(window(u), "lon")
    assert np.allclose(scaled.mean(axis=0), 0) and np.allclose(scaled.std(axis=0), 1)


def last_value(x: np.ndarray, u: np.ndarray, dt: float, axis: str):
    """A peer that knows one thing, and gives up on the lateral axis now and then."""
    if axis == "lat" and x[-1, 0] > 0:
        raise SystemExit("an order was not found")
    print("a noisy package")
    n = x.shape[1]
    model = assembled((np.eye(n), np.zeros((n, u.shape[1])), np.eye(n), None, np.eye(n)), x, u, dt)
    model.x, model.ms = x[-1], 7.0
    return model


def test_a_failed_axis_is_said_and_the_other_one_counts(capsys):
    cases = gusty.cases("calm", 3)[:3]
    laid = spans(cases, 40.0, 40.0, None)
    found = summary(run(lambda: peers.Peer(last_value), cases, laid))
    assert 0 < found["failed"] < 15 and found["trouble"] == ["lat: SystemExit: an order was not found"]
    assert found["lon40"] > -60 and found["lat_step_quartiles"][0] == -100.0
    assert found["ms_cold"] in (7.0, 14.0) and capsys.readouterr().out == ""


def test_whatever_is_absent_is_named():
    said = peers.absent()
    assert set(said) <= set(peers.PEERS) and all("skipped" in why for why in said.values())
    there = [key for key in peers.PEERS if key not in said]
    assert all(callable(peers.method(key)) for key in there) and isinstance(peers.versions(there), dict)


@pytest.mark.filterwarnings("ignore")  # of the packages, not ours
@pytest.mark.parametrize("key", sorted(peers.PEERS))
def test_a_peer_that_is_there_finds_a_system_it_can_find(key):
    if key in peers.absent():
        pytest.skip(peers.absent()[key])
    y, u = simulated(1000, noise=0.01)
    identify = peers.PEERS[key][1]()
    model = identify(y[:800], u[:800], DT, "lon")
    e = y[800:] - model.forecast(u[800:])
    assert model.ms > 0
    assert np.linalg.norm(e) / np.linalg.norm(y[800:]) < {"pysindy": 1.5, "jax-sysid": 0.9}.get(key, 0.35)
