"""Compute the increments that diagnosed effects add to force, moment, servo deflection, wind and airspeed."""

from dataclasses import dataclass

import numpy as np

from fleet.effects import ALL_SURFACES, MEMORY, SURFACES, Body, Flow, Stage
from twin_worker.diagnosis.data.fault_hypothesis import ALWAYS, Guess
from twin_worker.diagnosis.data.flight import Flight
from twin_worker.diagnosis.data.smooth import DT
from twin_worker.diagnosis.inference.report import Outcome, Report
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.diagnosis.model.residual import Case
from twin_worker.diagnosis.model.simulate import STATE, Simulation
from twin_worker.diagnosis.model.weather import fit_wind, wind

_EVERY_S = 0.5  # between rows [s]
_LONGEST_S = 60.0  # newest flight used [s]
_SETTLED = 200  # steps until a servo reaches its final deflection


@dataclass(frozen=True)
class Push:
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
    moved: np.ndarray
    wind: np.ndarray
    scale: float
    onset: float


def pushes(flight: Flight, base: Baseline, report: Report) -> Push | None:
    """Compute the outputs of the effects in a report; None if none is named or all have ended."""
    guesses = [one.guess for one in report.findings if not one.guess.effect.variance]
    if report.outcome is not Outcome.NAMED or not guesses:
        return None
    last = float(flight.t[-1])
    rows = np.flatnonzero(flight.ok & (flight.t > last - _LONGEST_S))[:: round(_EVERY_S / DT)]
    acting = [_lasting(guess, last) for guess in guesses]
    acting = [guess for guess in acting if any(guess.par)]
    if not acting or len(rows) < 2:
        return None
    x = np.stack([flight.readings[name][rows] for name in STATE])
    weather = list(wind(fit_wind(Case(flight, base), np.zeros(4))))
    command = flight.commands[rows]
    forces = [guess for guess in acting if guess.effect.stage in (Stage.WRENCH, Stage.MASS)]
    reckoned = [_forces(base, flight.ground, weather + each, (x, command.T)) for each in (forces, [])]
    return Push(
        t=flight.zero + flight.t[rows],
        wrench=(reckoned[0] - reckoned[1]).T,
        command=command,
        moved=moved(acting, command),
        wind=_wind(acting, flight),
        scale=_scale(acting, float(np.median(flight.readings.get("Va", np.full(2, base.speed))))),
        onset=float(flight.zero + min(one.segments[0][0] for one in report.findings)),
    )


def _lasting(guess: Guess, t: float) -> Guess:
    """Return the effect with its parameters at time t, held constant."""
    gate = float(guess.when.gate(np.array([t]))[0])
    return guess.at(gate * np.array(guess.par), ALWAYS)


def _forces(base: Baseline, ground: float, guesses: list[Guess], flown: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return specific force and angular acceleration with these effects active, (6, n)."""
    x, command = flown
    n = x.shape[1]
    simulation = Simulation(base, [guesses] * n, np.zeros(n), ground)
    angles = np.stack([*(base.card.angles(i)(command[i]) for i in range(3)), command[3]])
    rates, force, *_ = simulation.rates(x, angles, np.zeros(n), np.zeros(n))
    return np.concatenate([force, rates[3:6]])


def moved(guesses: list[Guess], command: np.ndarray) -> np.ndarray:
    """Return the deflections of faulty servos for constant commands, (n, 4)."""
    out = command.copy()
    for guess in guesses:
        if guess.effect.stage is not Stage.DELTA or guess.effect.takes_lag:
            continue
        for column, name in enumerate(SURFACES):
            if guess.of in (name, ALL_SURFACES):
                out[:, column] = [_settled(guess, u) for u in out[:, column]]
    return out


def _settled(guess: Guess, u: float) -> float:
    series = np.full(_SETTLED, u)
    par = np.repeat(np.asarray(guess.par, float)[:, None], _SETTLED, axis=1)
    guess.effect.act(series, np.full(MEMORY, u), DT, par)
    return float(series[-1])


def _wind(guesses: list[Guess], flight: Flight) -> np.ndarray:
    """Return the added wind at the aircraft's position, NED (3,) [m/s]."""
    h = float(flight.readings["h"][-1])
    flow = Flow(float(flight.t[-1]), h, h - flight.ground, Body())
    out = np.zeros(3)
    for guess in guesses:
        if guess.effect.stage is Stage.AIR:
            told = guess.effect.act(flow, *guess.par)
            out += [float(told.get(name, 0.0)) for name in ("w_n", "w_e", "w_d")]
    return out


def _scale(guesses: list[Guess], Va: float) -> float:
    """Return reported over true airspeed at the reported airspeed Va [m/s]."""
    reading = {"Va": np.array([Va]), "t": np.zeros(1)}
    for guess in guesses:
        if guess.effect.stage is Stage.SENSOR and guess.effect.channel == "airspeed":
            reading |= guess.effect.act(reading, *(-x for x in guess.par))
    return Va / max(float(reading["Va"][0]), 1.0)
