"""Free-run error: simulate from measured states with the recorded commands and compare the attitude."""

import numpy as np

from fleet.effects import Stage
from twin_worker.diagnosis.data.fault_hypothesis import FaultHypothesis
from twin_worker.diagnosis.data.flight import DECIMATION, DT
from twin_worker.diagnosis.inference.validation.force_prediction import blocks
from twin_worker.diagnosis.model.residual import ModelledFlight
from twin_worker.diagnosis.model.simulate import STATE, Simulation

FREE_RUN_S = 5.0  # length of a free run
_MAX_ERROR = np.pi  # limit of the attitude error [rad]


def free_run_error(modelled: ModelledFlight, hypotheses: tuple[FaultHypothesis, ...]) -> float:
    """Return the rms attitude error of free runs from measured states, on held-out blocks [rad].

    Args:
        modelled: the flight with its baseline
        hypotheses: effects active in the simulation, and sensor faults corrected in the recording
    """
    s, t = modelled.corrected_readings(hypotheses), modelled.flight.t
    n = int(FREE_RUN_S / DT)
    starts = np.arange(0, len(t) - n, n)
    starts = starts[
        blocks(t[starts], odd=True) & modelled.ok[starts // DECIMATION] & modelled.ok[(starts + n) // DECIMATION]
    ]
    if not len(starts):
        return float("nan")
    measured = np.stack([s[name] for name in STATE])
    acting = [g for g in hypotheses if g.effect.stage is not Stage.SENSOR]
    sim = Simulation(modelled.base, [acting] * len(starts), t[starts], modelled.flight.ground)
    commands = modelled.flight.commands
    runs = sim.simulate(measured[:, starts // DECIMATION], lambda k, _: commands[starts + k].T, n)
    steps = np.arange(0, n, DECIMATION)
    measured_attitude = measured[6:9, (starts[None, :] + steps[:, None]) // DECIMATION].transpose(1, 0, 2)
    error = np.clip(runs.states[steps, 6:9] - measured_attitude, -_MAX_ERROR, _MAX_ERROR)
    return float(np.sqrt((error**2).mean()))
