"""Compute the increments that diagnosed effects add to force, moment, servo deflection, wind and airspeed."""

from dataclasses import dataclass

import numpy as np

from fleet.effects import ALL_SURFACES, MEMORY, SURFACES, Body, Flow, Stage
from twin_worker.diagnosis.data.card import ALWAYS, FaultHypothesis
from twin_worker.diagnosis.data.flight import DT, FlightData
from twin_worker.diagnosis.inference.report import Report, ReportOutcome
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.diagnosis.model.residual import ModelledFlight
from twin_worker.diagnosis.model.simulate import STATE, Simulation
from twin_worker.diagnosis.model.weather import fit_wind, weather_hypotheses

_ROW_PERIOD_S = 0.5  # between rows [s]
_MAX_SPAN_S = 60.0  # newest flight used [s]
_SETTLING_STEPS = 200  # steps until a servo reaches its final deflection


@dataclass(frozen=True)
class EffectOutputs:
    """Outputs of diagnosed effects at rows of the newest flight.

    Attributes:
        t: (n,) [s since 1970]
        wrench: X Y Z [m/s2], L M N [rad/s2] added by effects on forces and mass, (n, 6)
        command, actual: delta_a delta_e delta_r delta_t as commanded, and with servo faults, (n, 4)
        wind: added, NED (3,) [m/s]
        airspeed_scale: reported over true airspeed with the sensor fault [-]
        onset: start of the first effect [s since 1970]
    """

    t: np.ndarray
    wrench: np.ndarray
    command: np.ndarray
    actual: np.ndarray
    wind: np.ndarray
    airspeed_scale: float
    onset: float


def effect_outputs(flight: FlightData, baseline: Baseline, report: Report) -> EffectOutputs | None:
    """Compute the outputs of the effects in a report; None if none is named or all have ended."""
    hypotheses = [finding.hypothesis for finding in report.findings if not finding.hypothesis.effect.variance]
    if report.outcome is not ReportOutcome.NAMED or not hypotheses:
        return None
    last = float(flight.t[-1])
    rows = np.flatnonzero(flight.ok & (flight.t > last - _MAX_SPAN_S))[:: round(_ROW_PERIOD_S / DT)]
    # with their parameters at the end, held constant
    active = [
        hypothesis.with_parameters(hypothesis.parameters_at(np.array([last]))[:, 0], ALWAYS)
        for hypothesis in hypotheses
    ]
    active = [hypothesis for hypothesis in active if any(hypothesis.par)]
    if not active or len(rows) < 2:
        return None
    x = np.stack([flight.readings[name][rows] for name in STATE])
    weather = list(weather_hypotheses(fit_wind(ModelledFlight(flight, baseline), np.zeros(4))))
    command = flight.commands[rows]
    force_effects = [hypothesis for hypothesis in active if hypothesis.effect.stage in (Stage.WRENCH, Stage.MASS)]
    wrenches = [
        _accelerations(baseline, flight.ground, weather + effects, (x, command.T)) for effects in (force_effects, [])
    ]
    return EffectOutputs(
        t=flight.t_start + flight.t[rows],
        wrench=(wrenches[0] - wrenches[1]).T,
        command=command,
        actual=actual_deflections(active, command),
        wind=_wind(active, flight),
        airspeed_scale=_airspeed_scale(active, float(np.median(flight.readings.get("Va", np.full(2, baseline.speed))))),
        onset=float(flight.t_start + min(one.segments[0][0] for one in report.findings)),
    )


def _accelerations(
    baseline: Baseline, ground: float, hypotheses: list[FaultHypothesis], inputs: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Return specific force and angular acceleration with these effects active, (6, n)."""
    x, command = inputs
    n = x.shape[1]
    simulation = Simulation(baseline, [hypotheses] * n, np.zeros(n), ground)
    rates, force, *_ = simulation.derivatives(x, baseline.card.deflections(command), np.zeros(n), np.zeros(n))
    return np.concatenate([force, rates[3:6]])


def actual_deflections(hypotheses: list[FaultHypothesis], command: np.ndarray) -> np.ndarray:
    """Return the deflections of faulty servos for constant commands, (n, 4)."""
    out = command.copy()
    for hypothesis in hypotheses:
        if hypothesis.effect.stage is not Stage.DELTA or hypothesis.effect.takes_lag:
            continue
        par = np.repeat(np.asarray(hypothesis.par, float)[:, None], _SETTLING_STEPS, axis=1)
        for column, name in enumerate(SURFACES):
            if hypothesis.target in (name, ALL_SURFACES):
                for row in range(len(out)):
                    u = np.full(_SETTLING_STEPS, out[row, column])
                    hypothesis.effect.act(u, np.full(MEMORY, u[0]), DT, par)
                    out[row, column] = u[-1]
    return out


def _wind(hypotheses: list[FaultHypothesis], flight: FlightData) -> np.ndarray:
    """Return the added wind at the aircraft's position, NED (3,) [m/s]."""
    h = float(flight.readings["h"][-1])
    flow = Flow(float(flight.t[-1]), h, h - flight.ground, Body())
    out = np.zeros(3)
    for hypothesis in hypotheses:
        if hypothesis.effect.stage is Stage.AIR:
            increments = hypothesis.effect.act(flow, *hypothesis.par)
            out += [float(increments.get(name, 0.0)) for name in ("w_n", "w_e", "w_d")]
    return out


def _airspeed_scale(hypotheses: list[FaultHypothesis], Va: float) -> float:
    """Return reported over true airspeed at the reported airspeed Va [m/s]."""
    reading = {"Va": np.array([Va]), "t": np.zeros(1)}
    for hypothesis in hypotheses:
        if hypothesis.effect.stage is Stage.SENSOR and hypothesis.effect.channel == "airspeed":
            reading |= hypothesis.effect.act(reading, *(-x for x in hypothesis.par))
    return Va / max(float(reading["Va"][0]), 1.0)
