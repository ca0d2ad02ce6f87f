"""Effects in the free run of the calibrated simulation, and their search where the cost has several minima."""

from dataclasses import replace

import numpy as np

from fleet.effects import Onset, catalogue
from tests.support.effect_flights import CRAFT, Hand, Plan, flown
from twin_worker.diagnosis.data.card import FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.data.flight import DT
from twin_worker.diagnosis.inference.isolation.isolate import PARAMETER_COST
from twin_worker.diagnosis.inference.isolation.refine import refine
from twin_worker.diagnosis.inference.isolation.unmodelled import channel_equations
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals
from twin_worker.diagnosis.model.baseline import CHANNEL_OF, Envelope
from twin_worker.diagnosis.model.residual import ModelledFlight
from twin_worker.diagnosis.model.simulate import STATE, Simulation


def test_the_velocity_follows_the_specific_force_in_a_gust() -> None:
    """The gust changes within an integration step, too: else the velocity lags by half a step."""
    updraft = FaultHypothesis(catalogue()["updraft"], "", (8.0,), OnsetProfile(Onset.BUMP, 4.0, 3.0))
    simulation = Simulation(CRAFT, [[], [updraft]], np.zeros(2))
    start = np.zeros((len(STATE), 2))
    start[0], start[7], start[9] = 29.0, 0.07, 300.0
    runs = simulation.simulate(start, Hand([Plan("calm", 1), Plan("gust", 1)], simulation), int(8.0 / DT))
    theta, phi = runs.states[:, 7], runs.states[:, 6]
    f_x, f_y, f_z = runs.force[:, 0], runs.force[:, 1], runs.force[:, 2]
    down = 9.80665 - np.sin(theta) * f_x + np.cos(theta) * (np.sin(phi) * f_y + np.cos(phi) * f_z)
    error = np.gradient(runs.states[:, 2], DT, axis=0) - down
    in_gust = slice(int(4.0 / DT), int(7.0 / DT))
    assert np.ptp(down[in_gust, 1]) > 2.0 * np.ptp(down[in_gust, 0])
    assert error[in_gust, 1].std() < 1.5 * error[in_gust, 0].std()


def test_the_onset_of_a_rate_limit_is_found_from_a_distance() -> None:
    """The surface position remembers the onset: the cost has a minimum wherever the command crosses it."""
    limit = catalogue()["actuator_rate_limit"]
    true = FaultHypothesis(limit, "aileron", (6.0,), OnsetProfile(Onset.STEP, 35.0))
    whitened = WhitenedResiduals(ModelledFlight(flown([Plan("slow", 11, (true,))])[0], CRAFT))
    found = refine(whitened, FaultHypothesis(limit, "aileron", (5.0,), OnsetProfile(Onset.STEP, 40.6)))
    assert abs(found.hypothesis.onset.t0 - 35.0) < 1.0 and abs(found.hypothesis.par[0] - 6.0) < 0.2


def test_coefficients_do_not_change_where_lift_was_not_calibrated() -> None:
    modelled = ModelledFlight(flown([Plan("nominal", 2)])[0], CRAFT)
    whitened = WhitenedResiduals(modelled)
    highest = float(modelled.equation_terms().intermediate["c_z"].max())
    everywhere = {one.channel: one.gain_of_all().net for one in channel_equations(whitened)}
    envelope = Envelope((0.0, 1.0), (0.0, 9.0), (), (highest + 0.1, highest + 0.2))
    whitened.base = replace(CRAFT, envelope=envelope)
    for one in channel_equations(whitened):
        if one.channel in CHANNEL_OF.values():
            assert one.gain_of_all().net == -PARAMETER_COST * len(one.names) < everywhere[one.channel]
