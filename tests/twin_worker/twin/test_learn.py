"""Which of several verified models is in force: the one that strays least when it flies the route."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.contract import Outcome, Verdict
from fleet.window import STATES
from tests.support.coupled_flights import aircraft, fly, known
from tests.support.flights import T0, linear_flight, truth
from twin_worker.twin.state.models import VerifiedModel
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps import identify_step as choosing
from twin_worker.twin.steps import identify_step as learning
from twin_worker.validation.held_out import HeldOut

VERDICT = Verdict(outcome=Outcome.VERIFIED, sentence="mean fit 30 %")
WINDOW = linear_flight(20.0)


@pytest.fixture
def choose(monkeypatch):
    """Let a twin with models `name: miss so far` choose, when each model's next flight misses by `misses[name]`."""

    def call(misses, *, pool=(), new=None, verdict=VERDICT):
        monkeypatch.setattr(choosing, "hindcast_error", lambda begin, window, start, plant: misses[plant])
        twin = Twin.of(1)
        twin.models.verified_models = [VerifiedModel(name, VERDICT, float(t), e) for t, (name, e) in enumerate(pool)]
        return twin, choosing.select_model(twin, WINDOW, 400, new, verdict)

    return call


def test_the_first_model_is_in_force(choose):
    twin, verdict = choose({"new": 9.0}, new="new")
    assert (
        twin.models.active_model == "new"
        and twin.models.active_verdict is VERDICT
        and verdict.outcome is Outcome.VERIFIED
    )


def test_the_one_that_strays_least_is_in_force(choose):
    twin, verdict = choose({"old": 10.0, "new": 2.0}, pool=[("old", 10.0)], new="new")
    assert twin.models.active_model == "new" and verdict.outcome is Outcome.VERIFIED
    twin, verdict = choose({"old": 2.0, "new": 10.0}, pool=[("old", 2.0)], new="new")
    assert (
        twin.models.active_model == "old"
        and verdict.outcome is Outcome.WORSE_THAN_LAST
        and "earlier model" in verdict.sentence
    )


def test_one_lucky_flight_does_not_beat_a_good_record(choose):
    twin, _ = choose({"old": 5.0, "new": 4.9}, pool=[("old", 5.0)], new="new")
    assert twin.models.active_model == "old"


def test_an_older_model_may_come_back(choose):
    twin, verdict = choose(
        {"good": 1.0, "bad": 50.0},
        pool=[("bad", 3.0), ("good", 4.0)],
        new=None,
        verdict=Verdict(outcome=Outcome.BELOW_THRESHOLD, sentence="no"),
    )
    assert twin.models.active_model == "good" and verdict.outcome is Outcome.BELOW_THRESHOLD


def test_a_model_that_leaves_its_envelope_is_never_believed_again(choose):
    twin, verdict = choose({"new": np.inf}, new="new")
    assert twin.models.active_model is None and verdict.outcome is Outcome.DIVERGED and not twin.models.verified_models
    twin, _ = choose({"old": np.inf, "new": 30.0}, pool=[("old", 1.0)], new="new")
    assert twin.models.active_model == "new" and [known.plant for known in twin.models.verified_models] == ["new"]


def test_off_the_route_the_newest_is_in_force(choose):
    twin, verdict = choose({"old": np.nan, "new": np.nan}, pool=[("old", np.nan)], new="new")
    assert twin.models.active_model == "new" and verdict.outcome is Outcome.VERIFIED


def test_a_model_that_has_flown_a_route_goes_before_one_that_has_not(choose):
    twin, _ = choose({"old": np.nan, "new": np.nan}, pool=[("old", 12.0)], new="new")
    assert twin.models.active_model == "old"


def test_the_pool_stays_small(choose):
    twin, _ = choose({str(k): float(k) for k in range(20)}, pool=[(str(k), float(k)) for k in range(20)], new="3")
    assert len(twin.models.verified_models) == choosing._MAX_MODELS and twin.models.active_model == "0"


# --- coupled models --------------------------------------------------------------------------------------------------


def verified(twin: Twin, t: float, misses: float, monkeypatch) -> Verdict:
    """Let a coupled model that ends at t join the pool."""
    monkeypatch.setattr(choosing, "hindcast_error", lambda *_: misses)
    window = linear_flight(20.0)
    window.t[:] += t
    return choosing.select_model(twin, window, 400, known(aircraft(0), T0 + t, T0 + t + 20.0), VERDICT)


def test_models_are_flown_now_and_then_not_every_hop(monkeypatch):
    twin = Twin.of(1)
    for t in (0.0, 1.0, 3.9):
        verified(twin, t, 5.0, monkeypatch)
    assert len(twin.models.verified_models) == 1
    verified(twin, choosing.SELECTION_PERIOD_S + 0.1, 5.0, monkeypatch)
    assert len(twin.models.verified_models) == 2


def test_a_stretch_that_was_searched_from_afresh_is_gone_on_with_for_a_while(monkeypatch):
    afresh, twin = [], Twin.of(1)

    def identify(window, wind, airframe, last, near, *, of_type):
        assert of_type is None
        afresh.extend([round(window.t[-1] - WINDOW.t[-1])] if near is None else [])
        return known(aircraft(0), window.t[0], window.t[-1])

    monkeypatch.setattr(learning.derivatives_model, "identify", identify)
    for second in range(20):
        learning._identify(twin, replace(WINDOW, t=WINDOW.t + second))
    every = round(learning._COLD_START_PERIOD_S)
    assert afresh == [0, every, 2 * every, 3 * every, 4 * every + 1]  # the fourth try goes on, the fifth does not


def test_without_a_route_there_is_nothing_to_fly():
    assert np.isnan(choosing.hindcast_error(None, WINDOW, 100, known(aircraft(0))))


def test_what_runs_have_earned_is_learnt_on_flight_and_published():
    """A model that is the aircraft earns belief; what two linear axes earn is not said."""
    flight = fly(aircraft(0), 80.0, seed=4)
    lesson = HeldOut(known(aircraft(0), T0, T0 + 40.0), flight, 1000).shrinkage_sample(20.0, 5.0)
    assert lesson is not None and lesson[0].shape == lesson[1].shape
    twin = Twin.of(1)
    twin.identification.shrinkage.update(*lesson, flight.dt)
    assert (
        set(twin.identification.shrinkage.kappa_at(10.0)) == set(STATES)
        and min(twin.identification.shrinkage.kappa_at(10.0).values()) > 0.6
    )
    assert HeldOut(truth(), WINDOW, 100).shrinkage_sample(20.0, 5.0) is None


@pytest.mark.parametrize(("outcome", "state"), [(Outcome.PLAUSIBLE, "plausible"), (Outcome.VERIFIED, "verified")])
def test_a_plausible_model_predicts_as_a_verified_one_and_the_twin_says_which(choose, outcome, state):
    verdict = Verdict(outcome=outcome, sentence="mean fit 30 %")
    twin, after = choose({"new": 9.0}, new="new", verdict=verdict)
    assert twin.models.active_model == "new" and after is verdict and twin.models.state == state
    twin.identification.conclude(verdict)
    assert twin.identification.tries == 0 and twin.verdict_text == "mean fit 30 %"
    assert Twin.of(1).models.state == "waiting"
