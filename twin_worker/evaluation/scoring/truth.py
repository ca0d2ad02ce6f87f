"""Actual flight after a start, and whether the start is included."""

import numpy as np

from fleet.frames import G
from fleet.mission import P_D, P_N, route
from twin_worker.evaluation.scoring.case import Asked, Case
from twin_worker.evaluation.scoring.log import Log
from twin_worker.numerics.prediction_errors import path_length
from twin_worker.telemetry.flight_phase import mode_named

FIRST_S = 120.0  # minimum time since the first sample: the identification window must be complete [s]
WHOLE_S = 60.0  # minimum flight without an event after a start [s]
_PHASE_S = 10.0  # flight after a start that determines its phase [s]
_STILL = 3.0  # a slower fixed wing is on the ground [m/s]


def answer(log: Log, asked: Asked) -> Case:
    """Attach the actual flight to a start; look-aheads after an event or in a telemetry gap are unknown."""
    end, why = log.until(asked.t)
    at = asked.t + asked.ahead
    flown = log.flown(asked.origin, at)
    flown[(at > end) | ~log.seen(at)] = np.nan
    grid = np.arange(0.0, asked.ahead[-1] + 1.0)  # 1 s: position noise adds no length, and turns are resolved
    length = path_length(log.flown(asked.origin, asked.t + grid), asked.speed)
    return Case(
        asked=asked,
        flown=flown,
        length=np.interp(asked.ahead, grid, length),
        phase=_phase(log, asked),
        route=_route(log, asked),
        apart=_apart(log, asked, end, why),
    )


def _apart(log: Log, asked: Asked, end: float, why: str) -> str:
    """Return the reason for exclusion of a start; empty: included."""
    wings = log.status is not None and log.status.vehicle == "fixed_wing"
    if asked.follows:
        return asked.follows
    if wings and asked.speed < _STILL:
        return "on the ground"
    if asked.first_s < FIRST_S:
        return f"within {FIRST_S:.0f} s of the first sample"
    if end < asked.t + WHOLE_S:
        return f"{why} within {WHOLE_S:.0f} s"
    if not log.seen(asked.t + np.array([0.0, WHOLE_S])).all():
        return "no positions around its start or 60 s later"
    return ""


def _phase(log: Log, asked: Asked) -> str:
    """Return the flight phase after a start, from bank angle and climb rate computed from positions."""
    p = log.flown(asked.origin, asked.t + np.arange(0.0, _PHASE_S + 1.0))
    v = np.diff(p, axis=0)
    course = np.unwrap(np.arctan2(v[:, 1], v[:, 0]))
    speed = np.hypot(v[:, 0], v[:, 1])
    bank = np.arctan(np.abs(np.diff(course)) * speed[1:] / G)
    return mode_named(float(bank.mean()), -float(v[:, 2].mean()))


def _route(log: Log, asked: Asked) -> np.ndarray:
    """Return the corners of the whole mission, for figures only, (n, 3) [m]."""
    legs = route(log.items, seq=1, origin=asked.origin, params={}).legs if len(log.items) > 1 else np.empty((0, 9))
    return legs[:, P_N : P_D + 1]
