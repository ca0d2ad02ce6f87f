"""Models of any order: known systems come back, in open and closed loop; poor data are refused in a sentence."""

import numpy as np
import pytest
from test_subspace import closed_loop, miss

from tests.bench.black_box import (
    estimate_x0,
    normal_equations,
    one_step,
    refine_black_box,
    squared_errors,
)
from tests.bench.order_selection import select_order
from twin_worker.identification.linear.state_space import StateSpace
from twin_worker.identification.linear.subspace import fit_inputs, pbsid, projection

POLES = {2: (0.92 + 0.15j,), 3: (0.92 + 0.15j, 0.8), 4: (0.92 + 0.15j, 0.75 + 0.4j), 5: (0.92 + 0.15j, 0.5j, 0.85)}
POLES[6] = (*POLES[4], 0.3 + 0.7j)


def known(order: int, seed: int = 0) -> StateSpace:
    """Two inputs, two outputs, the poles above in a basis without zeros."""
    rng = np.random.default_rng((seed, order))
    A, at = np.zeros((order, order)), 0
    for pole in POLES[order]:
        size = 2 if np.iscomplex(pole) else 1
        block = [[np.real(pole), np.imag(pole)], [-np.imag(pole), np.real(pole)]]
        A[at : at + size, at : at + size] = np.array(block)[:size, :size]
        at += size
    model = StateSpace.of(A, rng.standard_normal((order, 2)), rng.standard_normal((2, order)))
    return model.transformed(np.eye(order) + 0.3 * rng.standard_normal((order, order)))


def recorded(model: StateSpace, n: int, noise: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Its outputs under white inputs, with white measurement noise of that share."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n, model.B.shape[1]))
    y = model.run(u)
    return y + noise * y.std(axis=0) * rng.standard_normal(y.shape), u


def missed(model: StateSpace, truth: StateSpace) -> float:
    """Relative error of the free run under fresh inputs."""
    u = np.random.default_rng(99).standard_normal((500, truth.B.shape[1]))
    wanted, zero = truth.run(u), np.zeros(model.order)
    return float(np.linalg.norm(model.run(u, zero) - wanted) / np.linalg.norm(wanted))


@pytest.mark.parametrize("order", sorted(POLES))
@pytest.mark.parametrize("first", [pbsid, projection], ids=["pbsid", "projection"])
def test_an_open_loop_of_any_order_comes_back(first, order):
    truth = known(order)
    found = first(*recorded(truth, 3000, 0.05), order)
    assert found.order == order
    assert np.sort(np.abs(np.linalg.eigvals(found.A))) == pytest.approx(
        np.sort(np.abs(np.linalg.eigvals(truth.A))), abs=0.03
    )
    assert missed(found, truth) < 0.06


def test_in_a_closed_loop_the_projection_is_biased_and_pbsid_is_not():
    """u = r - F y with as much noise as excitation: the inputs carry the noise of past outputs."""
    y, u = closed_loop(12_000, 1.0)
    off = [miss(first(y, u, 4).A) for first in (pbsid, projection)]
    assert off[0] < 0.02 < 0.1 < off[1]


@pytest.mark.parametrize("order", [2, 3, 4])
def test_the_data_choose_the_order(order):
    truth = known(order)
    y, u = recorded(truth, 700, 0.1)
    found = select_order(y, u, orders=range(1, 7))
    model, recipe = found.model, found.structure
    assert order <= recipe.order <= order + 1 and not recipe.feedthrough
    assert missed(model, truth) < 0.05
    assert not model.D.any()
    fresh = np.random.default_rng(7).standard_normal((300, 2))
    runs = [member.run(fresh, np.zeros(member.order)) for member in found.ensemble]
    wanted = truth.run(fresh)
    assert np.linalg.norm(np.median(runs, axis=0) - wanted) < 0.05 * np.linalg.norm(wanted)


def test_feedthrough_is_found_where_there_is_one_and_it_may_be_tried():
    plant = known(2)  # whose input acts a sample sooner
    truth = StateSpace.of(plant.A, plant.A @ plant.B, plant.C, D=plant.C @ plant.B)
    y, u = recorded(truth, 700, 0.05)
    found = select_order(y, u, orders=(1, 2, 3), feedthrough=True)
    model, recipe = found.model, found.structure
    assert recipe.feedthrough and np.abs(model.D - truth.D).max() < 0.05 * np.abs(truth.D).max()
    assert missed(model, truth) < 0.05
    fitted = np.linalg.norm(y - model.run(u)) / np.linalg.norm(y)
    assert fitted < 0.06  # x0 too
    assert not select_order(y, u, orders=(1, 2, 3)).model.D.any()


def test_similarity_keeps_what_the_model_does():
    truth = known(2)
    u = np.random.default_rng(0).standard_normal((100, 2))
    turned = truth.outputs_as_states()
    assert np.allclose(turned.C, np.eye(2), atol=1e-6)
    assert np.allclose(turned.run(u), truth.run(u))
    with pytest.raises(ValueError, match="found 3 states and 2 outputs"):
        known(3).outputs_as_states()


def test_unstable_poles_are_mirrored():
    model = StateSpace.of(np.diag([1.25, 0.5]), np.ones((2, 1)), np.ones((1, 2)))
    assert np.sort(np.linalg.eigvals(model.stabilised().A)) == pytest.approx([0.5, 0.8])
    assert known(4).stabilised().radius == known(4).radius


def test_the_state_at_the_start_is_found_from_a_few_samples():
    truth, u = known(4), np.random.default_rng(0).standard_normal((300, 2))
    x0 = np.array([3.0, -2.0, 1.0, 4.0])
    y = truth.run(u, x0)
    assert estimate_x0(truth, y[:30], u[:30], len(y)) == pytest.approx(x0, rel=0.05)


def test_one_step_watches_the_output():
    rng = np.random.default_rng(3)
    model = StateSpace.of(np.array([[0.9]]), np.array([[0.5]]), np.array([[2.0]]), K=np.array([[0.3]]))
    u, e = rng.standard_normal((50, 1)), rng.standard_normal((50, 1))
    x, y = 0.0, np.empty((50, 1))
    for k in range(50):
        y[k] = 2.0 * x + e[k]
        x = 0.9 * x + 0.5 * u[k, 0] + 0.3 * e[k, 0]
    assert np.allclose(y - one_step(model, y, u), e)


@pytest.mark.parametrize("innovations", [False, True])
def test_the_gradient_is_the_slope_of_the_cost(innovations):
    y, w = recorded(known(3), 150, 0.1)
    rng = np.random.default_rng(4)
    y[40:50] = np.nan
    if innovations:
        w = np.hstack([w, np.nan_to_num(y)])
    parts = [0.7 * known(3).A, rng.standard_normal((3, w.shape[1])), known(3).C, rng.standard_normal(3)]
    squares, g, H = normal_equations(*parts, y, w)
    assert squares == pytest.approx(squared_errors(*parts, y, w))
    par, sizes = np.concatenate([np.hstack(parts[:2]).ravel(), parts[2].ravel(), parts[3]]), [3, w.shape[1]]

    def cost(par: np.ndarray) -> float:
        FG = par[: 3 * sum(sizes)].reshape(3, -1)
        C, x0 = par[3 * sum(sizes) : -3].reshape(-1, 3), par[-3:]
        return float(squared_errors(FG[:, :3].copy(), FG[:, 3:].copy(), C, x0, y, w).sum())

    for i in range(len(par)):
        step = 1e-6 * (np.arange(len(par)) == i)
        assert -2 * g[i] == pytest.approx((cost(par + step) - cost(par - step)) / 2e-6, rel=1e-4, abs=1e-3)
    assert np.allclose(H, H.T) and np.linalg.eigvalsh(H).min() > -1e-9 * np.trace(H)


def run_error(model: StateSpace, y: np.ndarray, u: np.ndarray) -> float:
    return float(((y - model.run(u)) ** 2).sum())


@pytest.mark.parametrize("seed", range(6))
def test_output_error_is_never_worse_than_its_start(seed):
    truth, rng = known(4, seed), np.random.default_rng(seed)
    y, u = recorded(truth, 600, 0.2)
    share = (0.02, 0.1, 0.5)[seed % 3]
    start = StateSpace.of(*(M + share * rng.standard_normal(M.shape) for M in (truth.A, truth.B, truth.C))).stabilised()
    found = refine_black_box(start, y, u)
    assert run_error(found, y, u) < run_error(start, y, u)
    assert found.radius <= 1.0
    if share < 0.1:
        assert missed(found, truth) < 0.05


def test_refinement_beats_the_first_step_on_data_it_has_not_seen():
    better = 0
    for seed in range(10):
        truth = known(4, seed)
        y, u = recorded(truth, 400, 0.5, seed)
        first = projection(y, u, 4)
        better += missed(refine_black_box(first, y, u), truth) < missed(first, truth)
    assert better >= 9


def test_the_one_step_form_is_never_worse_than_its_start_and_leaves_white_errors():
    y, u = closed_loop(3000, 0.3)
    start = pbsid(y, u, 4)
    found = refine_black_box(start, y, u, innovations=True)
    before, after = (y - one_step(model, y, u) for model in (start, found))
    assert (after**2).sum() <= (before**2).sum()
    assert after[20:].std(axis=0) == pytest.approx([0.3] * 4, rel=0.05)
    assert np.abs(np.linalg.eigvals(found.A) - np.linalg.eigvals(start.A)).max() < 0.1


def test_what_was_not_measured_has_no_say():
    y, u = recorded(known(3), 500, 0.1)
    ok = np.ones(len(y), bool)
    ok[100:150] = False
    start = pbsid(y, u, 3, ok=ok)
    clean = refine_black_box(start, y, u, ok=ok)
    y[~ok] = np.nan
    assert np.array_equal(refine_black_box(start, y, u, ok=ok).A, clean.A)
    assert np.array_equal(fit_inputs(start, y, u, ok=ok).B, fit_inputs(start, np.nan_to_num(y), u, ok=ok).B)


def test_inputs_offset_and_start_are_solved_exactly():
    truth, u = known(3), np.random.default_rng(0).standard_normal((200, 2))
    truth = StateSpace.of(truth.A, truth.B, truth.C, c=np.array([0.1, -0.2, 0.3]), x0=np.array([1.0, 2.0, -3.0]))
    found = fit_inputs(
        StateSpace.of(truth.A, 0 * truth.B, truth.C), truth.run(u), u, ok=np.ones(len(u), bool), with_bias=True
    )
    assert np.allclose(found.B, truth.B, atol=1e-6)
    assert np.allclose(found.run(u), truth.run(u), atol=1e-4)  # of three pushes two outputs show two


POOR = {
    "constant input": (lambda y, u: u.__setitem__((slice(None), 1), 3.0), "input 1 is constant"),
    "constant output": (lambda y, u: y.__setitem__((slice(None), 0), 0.0), "output 0 is constant"),
    "nan": (lambda y, u: y.__setitem__((7, 1), np.nan), "output 1 is not finite"),
    "copied input": (lambda y, u: u.__setitem__((slice(None), 1), 2.0 * u[:, 0] + 1.0), "input 1 repeats"),
    "copied output": (lambda y, u: y.__setitem__((slice(None), 1), -y[:, 0]), "output 1 repeats"),
}
FIRST = {"pbsid": lambda y, u: pbsid(y, u, 2), "projection": lambda y, u: projection(y, u, 2), "choose": select_order}


@pytest.mark.parametrize("kind", POOR)
@pytest.mark.parametrize("first", FIRST)
def test_poor_data_are_refused_in_a_sentence(first, kind):
    y, u = recorded(known(2), 400, 0.1)
    spoil, sentence = POOR[kind]
    spoil(y, u)
    with pytest.raises(ValueError, match=sentence):
        FIRST[first](y, u)


@pytest.mark.parametrize("n", [0, 1, 5, 40])
@pytest.mark.parametrize("first", FIRST)
def test_too_few_data_are_refused_in_a_sentence(first, n):
    y, u = recorded(known(2), 400, 0.1)
    with pytest.raises(ValueError, match=r"constant|repeats|unbroken rows|too few"):
        FIRST[first](y[:n], u[:n])


@pytest.mark.parametrize("order", [0, 99])
@pytest.mark.parametrize("first", [pbsid, projection])
def test_an_order_that_cannot_be_is_refused(first, order):
    with pytest.raises(ValueError, match=f"found order {order}, expected 1"):
        first(*recorded(known(2), 400, 0.1), order)


def test_lengths_that_differ_are_refused():
    y, u = recorded(known(2), 400, 0.1)
    with pytest.raises(ValueError, match="found 400 outputs, 399 inputs"):
        pbsid(y, u[:-1], 2, ok=np.ones(400, bool))


@pytest.mark.parametrize("kind", ["explodes", "all zero", "spikes", "huge"])
def test_refinement_never_gives_anything_that_is_no_number(kind):
    y, u = recorded(known(3), 300, 0.1)
    start = known(3)
    if kind == "explodes":
        start = StateSpace.of(3.0 * start.A, start.B, start.C)
    elif kind == "all zero":
        y[:], u[:] = 0.0, 0.0
    elif kind == "spikes":
        y[::37] = 1e8
    else:
        y *= 1e12
    for innovations in (False, True):
        found = refine_black_box(start, y, u, innovations=innovations)
        assert all(np.isfinite(M).all() for M in (found.A, found.B, found.C, found.K, found.x0))
