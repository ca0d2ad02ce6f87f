"""Free-run error: simulate from measured states with the recorded commands and compare the attitude."""

import numpy as np

from fleet.effects import Stage
from twin_worker.diagnosis.data.fault_hypothesis import Guess
from twin_worker.diagnosis.data.smooth import DT, EVERY
from twin_worker.diagnosis.inference.validation.force_prediction import blocks
from twin_worker.diagnosis.model.residual import Case
from twin_worker.diagnosis.model.simulate import STATE, Simulation

FREE_S = 5.0  # length of a free run
_MOST = np.pi  # limit of the attitude error [rad]


def stray(case: Case, guesses: tuple[Guess, ...]) -> float:
    """Return the rms attitude error of free runs from measured states, on held-out blocks [rad].

    Args:
        modelled: the flight with its baseline
        hypotheses: effects active in the simulation, and sensor faults corrected in the recording
    """
    s, t = case.sensed(guesses), case.flight.t
    n = int(FREE_S / DT)
    starts = np.arange(0, len(t) - n, n)
    starts = starts[blocks(t[starts], odd=True) & case.ok[starts // EVERY] & case.ok[(starts + n) // EVERY]]
    if not len(starts):
        return float("nan")
    measured = np.stack([s[name] for name in STATE])
    acting = [g for g in guesses if g.effect.stage is not Stage.SENSOR]
    sim = Simulation(case.base, [acting] * len(starts), t[starts], case.flight.ground)
    commands = case.flight.commands
    runs = sim.fly(measured[:, starts // EVERY], lambda k, _: commands[starts + k].T, n)
    rows = np.arange(0, n, EVERY)
    there = measured[6:9, (starts[None, :] + rows[:, None]) // EVERY].transpose(1, 0, 2)
    away = np.clip(runs.states[rows, 6:9] - there, -_MOST, _MOST)
    return float(np.sqrt((away**2).mean()))
