"""Actual flight after a start, and whether the start is included."""

import numpy as np

from fleet.frames import G
from fleet.mission import P_D, P_N, unroll_route
from twin_worker.evaluation.scoring.case import EvaluationCase, EvaluationStart
from twin_worker.evaluation.scoring.log import ReferenceFlight
from twin_worker.numerics.prediction_errors import path_length
from twin_worker.telemetry.flight_phase import classify_phase

MIN_FIRST_S = 120.0  # minimum time since the first sample: the identification window must be complete [s]
MIN_EVENT_FREE_S = 60.0  # minimum flight without an event after a start [s]
_PHASE_S = 10.0  # flight after a start that determines its phase [s]
_GROUND_SPEED = 3.0  # a slower fixed wing is on the ground [m/s]


def resolve_start(reference: ReferenceFlight, start: EvaluationStart) -> EvaluationCase:
    """Attach the actual flight to a start; look-aheads after an event or in a telemetry gap are unknown."""
    end, reason = reference.next_event(start.t)
    instants = start.t + start.ahead
    positions = reference.positions_at(start.origin, instants)
    positions[(instants > end) | ~reference.has_position(instants)] = np.nan
    grid = np.arange(0.0, start.ahead[-1] + 1.0)  # 1 s: position noise adds no length, and turns are resolved
    length = path_length(reference.positions_at(start.origin, start.t + grid), start.speed)
    return EvaluationCase(
        start=start,
        positions=positions,
        length=np.interp(start.ahead, grid, length),
        phase=_phase(reference, start),
        route=_mission_corners(reference, start),
        exclusion=_exclusion_reason(reference, start, end, reason),
    )


def _exclusion_reason(reference: ReferenceFlight, start: EvaluationStart, end: float, event: str) -> str:
    """Return the reason for exclusion of a start; empty: included."""
    fixed_wing = reference.status is not None and reference.status.vehicle == "fixed_wing"
    if start.no_route_reason:
        return start.no_route_reason
    if fixed_wing and start.speed < _GROUND_SPEED:
        return "on the ground"
    if start.first_s < MIN_FIRST_S:
        return f"within {MIN_FIRST_S:.0f} s of the first sample"
    if end < start.t + MIN_EVENT_FREE_S:
        return f"{event} within {MIN_EVENT_FREE_S:.0f} s"
    if not reference.has_position(start.t + np.array([0.0, MIN_EVENT_FREE_S])).all():
        return "no positions around its start or 60 s later"
    return ""


def _phase(reference: ReferenceFlight, start: EvaluationStart) -> str:
    """Return the flight phase after a start, from bank angle and climb rate computed from positions."""
    positions = reference.positions_at(start.origin, start.t + np.arange(0.0, _PHASE_S + 1.0))
    velocity = np.diff(positions, axis=0)
    course = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    bank = np.arctan(np.abs(np.diff(course)) * speed[1:] / G)
    return classify_phase(float(bank.mean()), -float(velocity[:, 2].mean()))


def _mission_corners(reference: ReferenceFlight, start: EvaluationStart) -> np.ndarray:
    """Return the corners of the whole mission, for figures only, (n, 3) [m]."""
    legs = (
        unroll_route(reference.items, seq=1, origin=start.origin, params={}).legs
        if len(reference.items) > 1
        else np.empty((0, 9))
    )
    return legs[:, P_N : P_D + 1]
