"""Every effect, injected into our own simulation, is found again by the diagnosis; one of each stage at any size."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import isfinite

import numpy as np
import pytest

from fleet.effects import Effect, Onset, catalogue
from tests.support.effect_flights import CARD, CRAFT, Hand, Plan, flown
from twin_worker.diagnosis.baseline.calibrate import calibrate
from twin_worker.diagnosis.data.card import FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.data.flight import DT
from twin_worker.diagnosis.inference.isolation.refine import refine
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals
from twin_worker.diagnosis.inference.report import DiagnosisFinding, Report, ReportOutcome
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.diagnosis.model.residual import ModelledFlight
from twin_worker.diagnosis.model.simulate import STATE, Simulation
from twin_worker.diagnosis.share import diagnose_all

ALL = catalogue("")
SINCE_S = 35.0
BUMP_S = 47.0, 6.0  # a gust or thermal of 150 m
ON = {  # what an effect befalls here
    **dict.fromkeys(("actuator_deadband", "actuator_rate_limit", "actuator_saturation"), "aileron"),
    **dict.fromkeys(("actuator_lag", "actuator_offset", "control_effectiveness_loss"), "elevator"),
    "actuator_delay": "all surfaces",
    "actuator_stuck": "rudder",  # a flight that goes on
    "accel_bias": "x",
    "gyro_bias": "r",
    "stall": "8 deg",
}
NOMINAL, CONTROLS = range(4), range(200, 204)
WITHIN = 0.15  # of the change the effect makes to its first number, at the largest magnitude; or 3 sigma
SIZED = ("actuator_offset", "airspeed_scale", "drag_increase")  # a surface, a sensor, the airframe
PAIRS = [(name, size) for name in ALL for size in (range(3) if name in SIZED else (2,))]
"""Effects and their magnitudes; all others at all magnitudes: `python -m tests.bench.effect_magnitudes`."""
CASES = [pytest.param(name, size, id=f"{name}-{size}") for name, size in PAIRS]


@dataclass(frozen=True)
class Flown:
    """A calibration, and the flights to diagnose by it."""

    base: Baseline
    reports: dict[str, Report]


def injected(effect: Effect, size: int) -> FaultHypothesis:
    """Give an effect at work, coming in flight where it can."""
    when = OnsetProfile()
    if Onset.STEP in effect.onsets:
        when = OnsetProfile(Onset.STEP, SINCE_S)
    elif Onset.ALWAYS not in effect.onsets:
        when = OnsetProfile(Onset.BUMP, *BUMP_S)
    return FaultHypothesis(effect, ON.get(effect.name, ""), effect.examples[size], when)


def fly(pairs: Iterable[tuple[str, int]]) -> Flown:
    """Calibrate on four flights, and fly all others, side by side."""
    base = calibrate(flown([Plan(f"nominal {seed}", seed) for seed in NOMINAL]), CARD)
    plans = [Plan(f"control {seed}", seed) for seed in CONTROLS]
    order = list(ALL)
    plans += [
        Plan(f"{name} {size}", 10 + 3 * order.index(name) + size, (injected(ALL[name], size),)) for name, size in pairs
    ]
    told = diagnose_all(flown(plans), base, 1, print)
    return Flown(base, {report.flight: report for reports, _ in told for report in reports})


@pytest.fixture(scope="module")
def made() -> Flown:
    """All of it, once."""
    return fly(PAIRS)


@pytest.mark.parametrize(("name", "size"), CASES)
def test_an_effect_flown_is_the_effect_named(name: str, size: int, made: Flown) -> None:
    assert_named(name, size, made)


def assert_named(name: str, size: int, made: Flown) -> None:
    """Hold a report against what was flown: the larger the effect, the more is asked."""
    report = made.reports[f"{name} {size}"]
    assert report.findings, report.sentence
    first = report.findings[0]
    assert name in (first.hypothesis.effect.name, *first.rivals), report.sentence
    if size > 0:
        assert report.outcome is ReportOutcome.NAMED, report.sentence
    if size == 2:
        assert first.hypothesis.effect.name == name, report.sentence
        assert first.hypothesis.target == ON.get(name, ""), report.sentence
        assert_close(first, made.base)


def assert_close(found: DiagnosisFinding, base: Baseline) -> None:
    """Hold the first number of what was found against what was flown."""
    effect, body = found.hypothesis.effect, base.card.body
    name, truth = next(iter(effect.reported(effect, np.array(effect.examples[2]), body).items()))
    nothing = effect.reported(effect, np.zeros(effect.n_parameters), body)[name]
    change = abs(truth - nothing) if isfinite(nothing) else abs(truth)
    assert abs(found.reported[name] - truth) <= max(WITHIN * change, 3.0 * found.sigma[name]), found.reported


@pytest.mark.parametrize("seed", CONTROLS)
def test_nothing_flown_is_nothing_named(seed: int, made: Flown) -> None:
    report = made.reports[f"control {seed}"]
    assert report.outcome in (ReportOutcome.NONE, ReportOutcome.SUSPECTED), report.sentence


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
