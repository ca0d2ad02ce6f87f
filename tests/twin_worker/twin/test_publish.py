"""The model as others see it: parameters with covariance, what the data told, matrices, and whose they are."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.bus.codec import decode, encode
from fleet.contract import Model, Outcome, Verdict
from fleet.physics.simulate import TAU
from fleet.physics.wrench import NAMES
from tests.support.coupled_flights import SMALL, aircraft, fly, known
from tests.support.flights import published, truth
from twin_worker.identification.fixed_wing.derivatives_model import identify
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps.identify_step import derivatives_message, model_message

WINDOW = fly(aircraft(0), 40.0)
GOOD, BAD = (
    Verdict(outcome=outcome, sentence=outcome.value) for outcome in (Outcome.VERIFIED, Outcome.BELOW_THRESHOLD)
)


def with_verdict(verdict: Verdict, plant=None, **config) -> Twin:
    twin = Twin.of(7, **config)
    twin.identification.verdict = verdict
    if plant is not None:
        twin.models.active_model, twin.models.active_verdict = plant, GOOD
    return twin


def test_before_any_model_only_the_verdict_is_told():
    said = model_message(with_verdict(BAD), WINDOW)
    assert (said.uav, said.verdict, said.active_verdict) == (7, BAD, None)
    assert said.longitudinal is said.lateral is said.derivatives is None
    assert (said.window_t0, said.window_s) == (WINDOW.t[0], WINDOW.seconds)


def test_a_failed_try_shows_the_numbers_of_the_model_in_force():
    plant = identify(WINDOW, np.zeros(2), SMALL)
    (said,) = published([model_message(with_verdict(BAD, plant), WINDOW)])
    assert isinstance(said, Model) and (said.verdict, said.active_verdict) == (BAD, GOOD)
    told = said.derivatives
    assert told is not None and told.names == NAMES
    assert np.array_equal(told.value.numpy(), plant.par)
    assert np.allclose(told.covariance.numpy(), plant.covariance, rtol=1e-5, atol=1e-9)
    assert tuple(plant.trim_velocity) == (told.U0, told.W0) and np.allclose(told.tau_s.numpy(), TAU)
    assert (told.window_t0, told.window_s) == (plant.t0, plant.t1 - plant.t0)
    assert told.prior == SMALL.name and SMALL.name in told.sentence
    assert said.longitudinal.states == ("u", "w", "q", "theta") and said.lateral.inputs == ("delta_a", "delta_r")
    assert decode(Model, encode(said)) == said


def test_the_paper_s_axes_have_matrices_and_no_derivatives():
    said = model_message(with_verdict(GOOD, truth(), method="paper"), WINDOW)
    assert said.derivatives is None and said.longitudinal is not None and said.method == "paper"


def test_told_by_hand():
    """Information three times the prior's removes three quarters of the variance."""
    nothing = known(aircraft(0))
    firm = np.zeros(37)
    firm[NAMES.index("Z_w")] = 3.0 * nothing.prior_precision[8, 8]
    told = derivatives_message(replace(nothing, fisher_information=np.diag(firm)), "mine").variance_reduction.numpy()
    assert told[NAMES.index("Z_w")] == pytest.approx(0.75, abs=1e-6)
    assert np.delete(told, NAMES.index("Z_w")) == pytest.approx(np.zeros(36), abs=1e-6)


def test_the_sentence_counts_what_the_data_said_and_names_what_the_prior_held():
    nothing = known(aircraft(0))
    alone = derivatives_message(nothing, "mine").sentence
    assert alone.startswith("0 of 37 parameters determined by the data, prior mine; from the prior: X_0 X_u")
    everything = replace(nothing, fisher_information=99.0 * nothing.prior_precision)
    assert derivatives_message(everything, "mine").sentence == "37 of 37 parameters determined by the data, prior mine"
    still = identify(replace(WINDOW, u=WINDOW.u * [1, 1, 0, 1]), np.zeros(2), SMALL)
    held = derivatives_message(still, "mine").sentence.partition("from the prior: ")[2].split()
    assert {"Y_dr", "L_dr", "N_dr"} <= set(held) and "L_da" not in held


def test_a_quiet_flight_tells_less_than_a_lively_one():
    shares = [
        derivatives_message(identify(fly(aircraft(0), 40.0, lively=by), np.zeros(2), SMALL), "")
        .variance_reduction.numpy()
        .mean()
        for by in (0.0, 0.1, 1.0)
    ]
    assert shares[0] < shares[1] < shares[2] and all(0 <= share <= 1 for share in shares)
