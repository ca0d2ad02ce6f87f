"""The second step: gradients are gradients, biased starts get better, nothing non-finite comes back."""

import numpy as np
import pytest
from test_subspace import closed_loop, system

from twin_worker.identification.linear.multiple_shooting import (
    SensorErrors,
    refine_with_starts,
    residuals_and_jacobian,
    segments_of,
)
from twin_worker.identification.linear.prediction_error_method import free_run, normal_equations, refine


def truth() -> np.ndarray:
    return np.hstack([*system(), np.full((4, 1), 0.05)])


def flight(n: int = 1500, noise: float = 0.02, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Outputs of the true [A B c] under smooth inputs, with measurement noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal((n // 10, 2)), 10, axis=0)
    y = np.empty((n, 4))
    free_run(truth(), np.zeros(4), u, y)
    return y + noise * rng.standard_normal(y.shape), u


def error(D: np.ndarray, y: np.ndarray, u: np.ndarray, length: int = 50) -> float:
    """Root mean square of free runs from measured states."""
    out = np.empty_like(y)
    for k in range(0, len(y), length):
        free_run(D, y[k], u[k : k + length], out[k : k + length])
    return float(np.sqrt(np.mean((y - out) ** 2)))


def refined(start: np.ndarray, y: np.ndarray, u: np.ndarray, ok: np.ndarray | None = None, **more) -> np.ndarray:
    ok = np.ones(len(y), bool) if ok is None else ok
    options = {"prior": start, "precision": np.full(start.shape, 1e-3), "length": 50} | more
    return refine(start, y, u, ok, **options)


def biased(seed: int = 5, share: float = 0.03) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return truth() + share * rng.standard_normal(truth().shape)


def test_free_run_by_hand():
    out = np.empty((4, 1))
    free_run(np.array([[0.5, 2.0, 1.0]]), np.array([8.0]), np.array([[0.0], [1.0], [1.0], [9.0]]), out)
    assert out[:, 0].tolist() == [8.0, 5.0, 5.5, 5.75]


def test_cost_is_the_sum_of_squared_errors_of_free_runs():
    y, u = flight(200)
    D, W, length = biased(), np.array([1.0, 2.0, 3.0, 4.0]), 50
    out = np.empty_like(y)
    for k in range(0, len(y), length):
        free_run(D, y[k], u[k : k + length], out[k : k + length])
    cost, _, _, squares = normal_equations(D, y, u, np.ones(200, bool), W, length)
    assert cost == pytest.approx(float((((y - out) ** 2) * W).sum()))
    assert np.allclose(squares[:4], ((y - out) ** 2).sum(axis=0))
    assert squares[4] == 200 - 4  # a segment's first row is its start


def test_a_run_that_diverges_costs_more_than_one_that_stays():
    y, u = flight(200)
    W, ok = np.ones(4), np.ones(200, bool)
    wild = np.hstack([1000.0 * np.eye(4), truth()[:, 4:]])
    cost, g, H, squares = normal_equations(wild, y, u, ok, W, 50)
    assert cost == pytest.approx(400.0 * 4 * (200 - 4), rel=0.05)  # the largest error in every state of every row
    assert squares[4] == 200 - 4 and np.isfinite(g).all() and np.isfinite(H).all()
    assert cost > 100.0 * normal_equations(truth(), y, u, ok, W, 50)[0]
    ok[60:90] = False
    assert normal_equations(wild, y, u, ok, W, 50)[3][4] == (~ok[:0]).sum() + 200 - 30 - 4


def test_the_gradient_is_the_slope_of_the_cost():
    y, u = flight(150)
    D, W, ok = biased(), np.ones(4), np.ones(150, bool)
    ok[60:70] = False
    _, g, H, _ = normal_equations(D, y, u, ok, W, 50)
    for i in range(D.size):
        step = np.zeros(D.size)
        step[i] = 1e-6
        up, down = (normal_equations(D + s * step.reshape(D.shape), y, u, ok, W, 50)[0] for s in (1, -1))
        assert -2 * g[i] == pytest.approx((up - down) / 2e-6, rel=1e-4, abs=1e-3)
    assert np.allclose(H, H.T) and np.linalg.eigvalsh(H).min() > -1e-6 * np.trace(H)


@pytest.mark.parametrize("seed", range(4))
def test_a_biased_start_gets_better_on_data_it_has_not_seen(seed):
    y, u = flight()
    start = biased(seed)
    D = refined(start, y, u)
    fresh = flight(seed=11)
    assert error(D, *fresh) < 0.4 * error(start, *fresh)
    assert error(D, *fresh) < 1.3 * error(truth(), *fresh)
    assert np.abs(D - truth()).max() < 0.5 * np.abs(start - truth()).max()


def test_subspace_then_prediction_error():
    from twin_worker.identification.linear.subspace import subspace

    y, u = closed_loop(3000, 0.3)
    A, B = subspace(y, u, np.ones(len(y), bool))
    first = np.hstack([A, B, np.zeros((4, 1))])
    assert error(refined(first, y, u), y, u) <= error(first, y, u)


def test_a_firm_prior_holds_and_a_loose_one_lets_go():
    y, u = flight()
    start = biased()
    moved = [np.abs(refined(start, y, u, precision=np.full(start.shape, w)) - start).max() for w in (1e12, 1e-3)]
    assert moved[0] < 1e-4 < 1e-2 < moved[1]


def test_a_firm_prior_pulls_a_start_that_is_elsewhere():
    y, u = flight()
    D = refined(biased(), y, u, prior=truth(), precision=np.full(truth().shape, 1e9))
    assert np.abs(D - truth()).max() < 1e-3


@pytest.mark.parametrize("seed", range(6))
def test_a_wild_start_never_gets_worse(seed):
    y, u = flight()
    start = biased(seed, share=0.5)
    assert error(refined(start, y, u), y, u) <= error(start, y, u)


def test_what_was_not_measured_has_no_say():
    y, u = flight()
    ok = np.ones(len(y), bool)
    ok[300:340] = ok[800:1000] = False
    clean = refined(biased(), y, u, ok)
    y[~ok] = np.nan
    assert np.array_equal(refined(biased(), y, u, ok), clean)
    y[~ok] = 1e9
    assert np.array_equal(refined(biased(), y, u, ok), clean)


@pytest.mark.parametrize("kind", ["explodes", "flips", "all zero", "no data", "spikes", "huge"])
def test_it_never_gives_anything_that_is_no_number(kind):
    y, u = flight(400)
    ok = np.ones(len(y), bool)
    start = biased()
    if kind == "explodes":
        start[:, :4] *= 1.6
    elif kind == "flips":
        start[:, :4] = -1.2 * np.eye(4)
    elif kind == "all zero":
        y[:], u[:] = 0.0, 0.0
    elif kind == "no data":
        ok[:] = False
    elif kind == "spikes":
        y[::37] = 1e8
    else:
        y *= 1e12
    D = refined(start, y, u, ok)
    assert D.shape == start.shape and np.isfinite(D).all()


def test_without_data_the_start_stays():
    y, u = flight(400)
    start = biased()
    assert np.allclose(refined(start, y, u, np.zeros(len(y), bool)), start)


def test_sensitivities_of_multiple_shots_are_derivatives():
    y, u = flight(60)
    D, segments = biased(), np.array([[0, 20], [25, 55]])
    starts = np.hstack([y[segments[:, 0]], 0.1 * np.ones((2, 4))])
    weight, none = np.array([1.0, 2.0, 0.5, 1.0]), np.empty((0, 4, D.size + 8))
    e, J = np.empty((50, 4)), np.zeros((50, 4, D.size + 8))
    cost = residuals_and_jacobian(D, starts, segments, y, u, weight, e, J)
    assert cost == pytest.approx(float((e**2).sum()))
    moved, h = [np.empty_like(e), np.empty_like(e)], 1e-5
    for column in range(D.size + 8):
        for side, out in zip((-h, h), moved, strict=True):
            par, z = D.ravel().copy(), starts.copy()
            if column < D.size:
                par[column] += side
            else:
                z[:, column - D.size] += side
            residuals_and_jacobian(par.reshape(D.shape), z, segments, y, u, weight, out, none)
        assert np.allclose((moved[0] - moved[1]) / (2 * h), J[..., column], rtol=1e-4, atol=1e-4)


def test_multiple_shots_find_a_biased_model_despite_sensor_errors_that_drift():
    """A constant error of every 100 rows: the biases take it up; a ridge that is strong enough keeps the first step."""
    y, u = flight()
    drift = np.repeat(np.random.default_rng(8).standard_normal((15, 4)), 100, axis=0)
    y += 0.2 * drift
    ok, errors = np.ones(len(y), bool), SensorErrors(np.full(4, 0.02), np.full(4, 0.2))

    def distance(D: np.ndarray) -> float:
        return float(np.linalg.norm(D[:, :-1] - truth()[:, :-1]))

    found = refine_with_starts(biased(), y, u, ok, runs=[(50, 1.0), (100, 1.0)], errors=errors)
    no_bias = refined(biased(), y, u, length=100, effective_fraction=1.0)
    assert distance(found) < 0.3 * distance(biased()) and distance(found) < 0.5 * distance(no_bias)
    kept = refine_with_starts(biased(), y, u, ok, runs=[(50, 1e12), (100, 1e12)], errors=errors)
    assert np.allclose(kept, biased(), atol=1e-4)
    only_short = refine_with_starts(biased(), y, u, ok, runs=[(50, 1.0)], errors=errors)
    held = refine_with_starts(biased(), y, u, ok, runs=[(50, 1.0), (100, 1e12)], errors=errors)
    assert np.allclose(held, only_short, atol=1e-4) and distance(held) < distance(kept)


def test_segments_avoid_gaps_and_none_is_an_error():
    ok = np.ones(100, bool)
    ok[40:45] = False
    assert segments_of(ok, 20).tolist() == [[0, 20], [20, 40], [45, 63], [63, 81], [81, 99]]
    y, u = flight(100)
    errors = SensorErrors(np.full(4, 0.02), np.full(4, 0.2))
    with pytest.raises(ValueError, match="wait for more"):
        refine_with_starts(biased(), y, u, np.zeros(100, bool), runs=[(50, 1.0)], errors=errors)
