"""Which errors of derivatives the verification detects, and that it detects those it names."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from fleet.contract import Outcome
from fleet.physics.wrench import NAMES
from tests.support.coupled_flights import SMALL, aircraft, fly
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel, identify
from twin_worker.validation.consistency import GROUPS, MAX_DETECTABLE, TOLERANCE, error_text, estimate_errors, limits
from twin_worker.validation.verify import verify, verify_since_identification, with_consistency

SEEN = 1000  # rows identified on; the rest is held out


def case(seed: int) -> tuple[DerivativesModel, object]:
    window = fly(aircraft(seed), 80.0, seed=seed)
    return identify(window.part(0, SEEN), aircraft(seed)[-2:], SMALL), window


def scaled(model: DerivativesModel, group: str, factor: float) -> DerivativesModel:
    par = model.par.copy()
    par[[NAMES.index(name) for name in GROUPS[group]]] *= factor
    return replace(model, par=par)


@pytest.fixture(scope="module")
def flown():
    return [case(seed) for seed in range(4)]


def test_the_identified_model_is_verified_with_a_stated_power(flown):
    verdicts = [with_consistency(verify(model, window, SEEN), model, window, SEEN) for model, window in flown]
    assert sum(verdict.outcome is Outcome.VERIFIED for verdict in verdicts) >= 3
    for verdict in verdicts:
        assert all(0.0 < value <= 100.0 * MAX_DETECTABLE for value in verdict.detectable_error.values())
        if verdict.outcome is Outcome.VERIFIED:
            assert not verdict.derivative_error and "consistent, would have detected an error of" in verdict.sentence


def test_an_error_of_the_stated_size_is_rejected_in_either_direction(flown):
    found = []
    for model, window in flown:
        for group, percent in estimate_errors(model, window, SEEN).power().items():
            for factor in (1.0 + percent / 100.0, 1.0 - percent / 100.0):
                errors = estimate_errors(scaled(model, group, factor), window, SEEN)
                found.append(errors is None or bool(errors.failed()))
    assert len(found) > 30 and np.mean(found) >= 0.9


def test_a_wrong_model_that_fits_is_plausible_only(flown):
    model, window = flown[0]
    wrong = scaled(model, "aileron_effectiveness", 0.7)
    verdict = with_consistency(verify(wrong, window, SEEN), wrong, window, SEEN)
    assert verdict.outcome is Outcome.PLAUSIBLE
    assert verdict.derivative_error["aileron_effectiveness"] == pytest.approx(43.0, abs=12.0)  # 1 / 0.7 - 1
    assert "plausible only: on held-out data the aircraft has" in verdict.sentence


def test_too_little_data_state_no_power(flown):
    model, window = flown[1]
    short = window.part(0, SEEN + 300)  # 12 s: three free runs
    verdict = with_consistency(verify(model, short, SEEN), model, short, SEEN)
    assert estimate_errors(model, short, SEEN) is None
    assert verdict.outcome is Outcome.PLAUSIBLE and not verdict.detectable_error
    assert "these data would not show an error of 50 % in one of the axes" in verdict.sentence


def test_data_after_the_identification_verify_a_model_that_was_plausible_only(flown):
    model, window = flown[1]
    before = with_consistency(verify(model, window.part(0, SEEN + 300), SEEN), model, window.part(0, SEEN + 300), SEEN)
    verdict = verify_since_identification(before, model, window, "UAV-001")
    assert before.outcome is Outcome.PLAUSIBLE and verdict.outcome is Outcome.VERIFIED and verdict.fit == before.fit
    assert verdict.sentence.startswith("UAV-001: 40 s of flight since the identification; consistent, would have")
    assert verdict.detectable_error == estimate_errors(model, window, SEEN).power()


def test_data_after_the_identification_refute_a_model_that_was_verified(flown):
    model, window = flown[0]
    verified = msgspec.structs.replace(verify(model, window, SEEN), outcome=Outcome.VERIFIED)
    verdict = verify_since_identification(verified, scaled(model, "aileron_effectiveness", 0.7), window, "UAV-001")
    assert verdict.outcome is Outcome.PLAUSIBLE and "aileron_effectiveness" in verdict.derivative_error
    assert "plausible only: on held-out data the aircraft has" in verdict.sentence


def test_data_without_power_change_no_verdict(flown):
    model, window = flown[1]
    verdict = verify(model, window, SEEN)
    for end in (SEEN, SEEN + 300):  # none, and 12 s
        assert verify_since_identification(verdict, model, window.part(0, end), "UAV-001") is verdict


def test_steady_flight_states_less_power_than_manoeuvres():
    model, window = case(5)
    calm = fly(aircraft(5), 80.0, seed=5, lively=0.1)
    lively, quiet = (estimate_errors(model, one, SEEN).detectable for one in (window, calm))
    assert (quiet > 2.0 * lively).sum() >= 6


def test_other_outcomes_are_not_tested(flown):
    model, window = flown[0]
    verdict = msgspec.structs.replace(verify(model, window, SEEN), outcome=Outcome.WORSE_THAN_LAST)
    assert with_consistency(verdict, model, window, SEEN) is verdict


def test_limits_grow_with_the_spread_and_shrink_with_more_runs():
    threshold, detectable = limits(np.array([0.0, 0.02, 0.05, 1.0]), 9)
    assert threshold[0] == pytest.approx(TOLERANCE) and (np.diff(threshold) > 0).all()
    assert (detectable > threshold).all() and np.isinf(detectable[-1])
    assert (limits(np.array([0.05]), 30)[1] < detectable[2]).all()


def test_what_fails_is_described():
    text = error_text({"roll_damping": -22.4, "elevator_effectiveness": 31.0})
    assert (
        text == "on held-out data the aircraft has roll damping 22 % below, elevator effectiveness 31 % above the model"
    )
