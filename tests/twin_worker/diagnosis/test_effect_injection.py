"""Every effect, injected into our own simulation at three magnitudes, is found again by the diagnosis."""

from dataclasses import dataclass
from functools import cache
from math import isfinite

import numpy as np
import pytest

from fleet.effects import Effect, Onset, catalogue
from tests.support.effect_flights import CARD, Plan, flown
from twin_worker.diagnosis.baseline.calibrate import calibrate
from twin_worker.diagnosis.data.card import FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.inference.report import DiagnosisFinding, Report, ReportOutcome
from twin_worker.diagnosis.model.baseline import Baseline
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
CASES = [pytest.param(name, size, id=f"{name}-{size}") for name in ALL for size in range(3)]


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


@cache
def fly() -> Flown:
    """Calibrate on four flights, and fly all others, side by side."""
    base = calibrate(flown([Plan(f"nominal {seed}", seed) for seed in NOMINAL]), CARD)
    plans = [Plan(f"control {seed}", seed) for seed in CONTROLS]
    for i, (name, effect) in enumerate(ALL.items()):
        plans += [Plan(f"{name} {size}", 10 + 3 * i + size, (injected(effect, size),)) for size in range(3)]
    told = diagnose_all(flown(plans), base, 1, print)
    return Flown(base, {report.flight: report for reports, _ in told for report in reports})


@pytest.fixture(scope="module")
def made() -> Flown:
    """All of it, once."""
    return fly()


@pytest.mark.parametrize(("name", "size"), CASES)
def test_an_effect_flown_is_the_effect_named(name: str, size: int, made: Flown) -> None:
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
