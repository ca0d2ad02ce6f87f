"""Two thousand windows nobody should fly are identified, judged and published: sentences come back, and numbers."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from fleet.contract import Outcome, Verdict
from fleet.window import Window
from tests.support.coupled_flights import SMALL, aircraft, fly, known
from tests.support.flights import DT, HERE, T0, published
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel, identify
from twin_worker.identification.fixed_wing.plant import is_finite
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps import identify_step
from twin_worker.twin.steps.identify_step import model_message, select_model
from twin_worker.validation.verify import verify

ROWS, SPLIT = 236, 130  # a short flight: 5.2 s to learn from, 4.2 s held out
GOOD = [fly(aircraft(seed), ROWS * DT, seed=seed).part(0, ROWS) for seed in range(6)]
EACH = 100  # windows of every kind
Rng = np.random.Generator


def constant(w: Window, rng: Rng) -> None:
    k = rng.integers(ROWS)
    w.x[:], w.v[:], w.u[:] = w.x[k], w.v[k], w.u[k]


def all_zero(w: Window, rng: Rng) -> None:
    for part in (w.x, w.v, w.u, w.p):
        part[:] = 0.0


def not_numbers(w: Window, rng: Rng) -> None:
    """Rows that are marked unmeasured and hold whatever was in memory."""
    gone = rng.random(ROWS) < rng.uniform(0, 0.05)
    w.ok[gone] = False
    w.x[gone], w.v[gone] = rng.choice([np.nan, 1e5, -1e5], 2)


def gaps(w: Window, rng: Rng) -> None:
    for _ in range(rng.integers(1, 12)):
        k = rng.integers(ROWS)
        w.ok[k : k + rng.integers(1, 80)] = False


def saturated(w: Window, rng: Rng) -> None:
    w.u[:] = rng.choice([-1.0, 1.0], w.u.shape)


def stuck_input(w: Window, rng: Rng) -> None:
    w.u[:, rng.integers(4)] = rng.uniform(-1, 1)


def clipped(w: Window, rng: Rng) -> None:
    k = rng.integers(9)
    low, high = np.sort(rng.choice(w.x[:, k], 2))
    w.x[:, k] = np.clip(w.x[:, k], low, high)
    w.v[:] = np.clip(w.v, *np.sort(rng.choice(w.v.ravel(), 2)))


def stuttering(w: Window, rng: Rng) -> None:
    rows = np.minimum(np.arange(ROWS) // rng.integers(2, 40) * rng.integers(1, 40), ROWS - 1)
    w.x[:], w.v[:] = w.x[rows], w.v[rows]


def same_stamps(w: Window, rng: Rng) -> None:
    k = rng.integers(2, ROWS)
    w.t[k:] = w.t[k - 1]


def one_sample(w: Window, rng: Rng) -> None:
    w.ok[:] = False
    w.ok[rng.integers(ROWS)] = True


def wrong_units(w: Window, rng: Rng) -> None:
    part = (w.x, w.v, w.u)[rng.integers(3)]
    part[:, rng.integers(part.shape[1])] *= rng.choice([1000.0, 57.3, 1e-3, -1.0])


def everything_in_millimetres(w: Window, rng: Rng) -> None:
    w.x[:, :3] *= 1000.0
    w.v[:] *= 1000.0


def huge_offset(w: Window, rng: Rng) -> None:
    w.x[:, rng.integers(9)] += rng.choice([-1, 1]) * 10 ** rng.uniform(1, 5)


def huge_inputs(w: Window, rng: Rng) -> None:
    w.u[:, rng.integers(4)] += rng.choice([-1, 1]) * 10 ** rng.uniform(1, 5)


def noise(w: Window, rng: Rng) -> None:
    for part in (w.x, w.v, w.u):
        part[:] = 10 ** rng.uniform(-3, 4) * rng.standard_normal(part.shape)


def noisy(w: Window, rng: Rng) -> None:
    w.x[:] += 10 ** rng.uniform(-1, 2) * rng.standard_normal(w.x.shape)
    w.v[:] += 10 ** rng.uniform(-1, 2) * rng.standard_normal(w.v.shape)


def spikes(w: Window, rng: Rng) -> None:
    for _ in range(rng.integers(1, 30)):
        w.x[rng.integers(ROWS), rng.integers(9)] = rng.choice([-1, 1]) * 10 ** rng.uniform(0, 5)


def backwards(w: Window, rng: Rng) -> None:
    w.x[:], w.v[:] = w.x[::-1].copy(), w.v[::-1].copy()


def upside_down(w: Window, rng: Rng) -> None:
    w.x[:, 6] += np.pi * rng.choice([-1, 1])
    w.x[:, 7] += rng.choice([-1.5, 0.0, 1.5])


def spinning(w: Window, rng: Rng) -> None:
    w.x[:, 6:] += rng.uniform(-40, 40, 3) * (w.t - w.t[0])[:, None]


KINDS = (
    *(constant, all_zero, not_numbers, gaps, saturated, stuck_input, clipped, stuttering, same_stamps, one_sample),
    *(wrong_units, everything_in_millimetres, huge_offset, huge_inputs, noise, noisy, spikes, backwards),
    *(upside_down, spinning),
)


def spoilt(spoil, rng: Rng) -> Window:
    good = GOOD[rng.integers(len(GOOD))]
    w = replace(good, **{name: getattr(good, name).copy() for name in ("t", "x", "u", "p", "v", "ok", "filled")})
    spoil(w, rng)
    return w


def before(rng: Rng) -> tuple[DerivativesModel | None, DerivativesModel | None]:
    """What an earlier flight said: nothing, the newest search, or a verified model."""
    model = known(aircraft(int(rng.integers(6))), T0 - 60.0, T0 - 30.0)
    return ((None, None), (model, None), (None, model), (model, model))[rng.integers(4)]


def twin_with(plant: DerivativesModel | None, verdict: Verdict) -> Twin:
    twin = Twin.of(1)
    twin.telemetry.origin, twin.identification.verdict = HERE, verdict
    twin.models.active_model, twin.models.active_verdict = plant, verdict if plant else None
    return twin


def met(window: Window, rng: Rng) -> str:
    """Learn from the first rows, judge by the rest, publish; give what became of it."""
    last, near = before(rng)
    wind = rng.choice([1.0, 100.0]) * rng.standard_normal(3)
    try:
        plant = identify(window.part(0, SPLIT), wind, SMALL, last, near)
        assert is_finite(plant) and np.isfinite(plant.covariance).all()
        verdict = verify(plant, window, SPLIT, active=known(aircraft(0)) if rng.random() < 0.5 else None)
    except ValueError as error:
        assert str(error).startswith(("identify: found", "verify: found")) and "; wait" in str(error), error
        return "sentence"
    twin = twin_with(plant, verdict)
    select_model(twin, window, SPLIT, plant, verdict)
    published([model_message(twin, window)])
    return verdict.outcome.value


@pytest.mark.parametrize("spoil", KINDS, ids=lambda kind: kind.__name__)
def test_nothing_raises_but_the_sentence_and_nothing_published_is_no_number(spoil):
    rng = np.random.default_rng(KINDS.index(spoil))
    became = Counter(met(spoilt(spoil, rng), rng) for _ in range(EACH))
    assert sum(became.values()) == EACH
    assert became[Outcome.PLAUSIBLE.value] < EACH or spoil in (gaps, not_numbers, stuck_input, huge_offset)


def test_there_are_two_thousand():
    assert len(KINDS) * EACH == 2000
    assert met(GOOD[0], np.random.default_rng(0)) == "plausible"  # and it is not the harness that refuses


@pytest.mark.parametrize("spoil", [kind for kind in KINDS if kind is not same_stamps], ids=lambda kind: kind.__name__)
def test_a_whole_hop_of_learning_meets_them(spoil, monkeypatch):
    """The same through `learn`, with a verified model in force: it is never replaced by a number that is none."""
    monkeypatch.setattr(identify_step, "MIN_WINDOW_S", 6.0)
    monkeypatch.setattr(identify_step, "_HOLD_OUT_S", (4.2, 4.2, 4.2))
    monkeypatch.setattr(identify_step, "fit_kinematic_models", lambda twin: None)
    rng = np.random.default_rng(100 + KINDS.index(spoil))
    model = known(aircraft(0))
    for _ in range(3):
        window = spoilt(spoil, rng)
        twin = twin_with(model, Verdict(outcome=Outcome.VERIFIED, sentence="verified before"))
        monkeypatch.setattr(Twin, "window", lambda self, seconds, window=window: window)
        for _ in range(3):
            published(identify_step.identify_and_verify(twin))
            assert isinstance(twin.models.active_model, DerivativesModel) and is_finite(twin.models.active_model)
            assert twin.identification.verdict.sentence
            assert twin.identification.warm_start is None or is_finite(twin.identification.warm_start)
