"""True path of each start; comparison with every other method on the same starts: paired differences with intervals.

Starts of one flight are dependent, so the bootstrap resamples flights, not starts.
Source: Davison & Hinkley 1997, "Bootstrap methods and their application", section 3.8 (cluster bootstrap, percentile).
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from fleet.frames import G
from fleet.mission import P_D, P_N, unroll_route
from twin_worker.evaluation.scoring.log import OURS, EvaluationCase, EvaluationStart, ReferenceFlight
from twin_worker.evaluation.scoring.score import LIMITS, MethodScores
from twin_worker.numerics.prediction_errors import path_length
from twin_worker.telemetry.flight_phase import classify_phase

MIN_FIRST_S = 120.0  # minimum time since the first sample: the identification window must be complete [s]
MIN_EVENT_FREE_S = 60.0  # minimum flight without an event after a start [s]
MIN_SHORT_S = 10.0  # the same in a flight without any start that has `MIN_EVENT_FREE_S` [s]
_PHASE_S = 10.0  # flight after a start that determines its phase [s]
_GROUND_SPEED = 3.0  # a slower fixed wing is on the ground [m/s]


def resolve_starts(
    reference: ReferenceFlight,
    starts: Sequence[EvaluationStart],
    first_s: float = MIN_FIRST_S,
    event_free_s: float = MIN_EVENT_FREE_S,
) -> list[EvaluationCase]:
    """Attach the actual flight to all starts of a flight; a short mission is scored as far as it goes.

    Args:
        reference: the actual flight
        starts: its starts
        first_s: minimum time since the first sample [s]
        event_free_s: minimum flight without an event after a start [s]
    """
    cases = [resolve_start(reference, start, event_free_s, first_s) for start in starts]
    if any(not case.exclusion for case in cases):
        return cases
    return [resolve_start(reference, start, MIN_SHORT_S, first_s) for start in starts]


def resolve_start(
    reference: ReferenceFlight,
    start: EvaluationStart,
    event_free_s: float = MIN_EVENT_FREE_S,
    first_s: float = MIN_FIRST_S,
) -> EvaluationCase:
    """Attach the actual flight to a start; look-aheads after an event or in a telemetry gap are unknown.

    Args:
        reference: the actual flight
        start: the start
        event_free_s: minimum flight without an event after the start [s]
        first_s: minimum time since the first sample [s]
    """
    end, reason = reference.next_event(start.t)
    instants = start.t + start.ahead
    positions = reference.positions_at(start.origin, instants)
    positions[(instants > end) | ~reference.has_position(instants)] = np.nan
    grid = np.arange(0.0, start.ahead[-1] + 1.0)  # 1 s: position noise adds no length, and turns are resolved
    length = path_length(reference.positions_at(start.origin, start.t + grid), start.speed)
    legs = np.empty((0, 9))
    if len(reference.items) > 1:
        legs = unroll_route(reference.items, seq=1, origin=start.origin, params={}).legs
    return EvaluationCase(
        start=start,
        positions=positions,
        length=np.interp(start.ahead, grid, length),
        phase=_phase(reference, start),
        route=legs[:, P_N : P_D + 1],
        exclusion=_exclusion_reason(reference, start, (end, reason), (event_free_s, first_s)),
    )


def _exclusion_reason(
    reference: ReferenceFlight, start: EvaluationStart, next_event: tuple[float, str], limits: tuple[float, float]
) -> str:
    """Return the reason for exclusion of a start; empty: included. limits: event-free flight, first start [s]."""
    event_free_s, first_s = limits
    end, event = next_event
    fixed_wing = reference.status is not None and reference.status.vehicle == "fixed_wing"
    if start.no_route_reason:
        return start.no_route_reason
    if fixed_wing and start.speed < _GROUND_SPEED:
        return "on the ground"
    if start.first_s < first_s:
        return f"within {first_s:.0f} s of the first sample"
    if end < start.t + event_free_s:
        return f"{event} within {event_free_s:.0f} s"
    if not reference.has_position(start.t + np.array([0.0, event_free_s])).all():
        return f"no positions around its start or {event_free_s:.0f} s later"
    return ""


def _phase(reference: ReferenceFlight, start: EvaluationStart) -> str:
    """Return the flight phase after a start, from bank angle and climb rate computed from positions."""
    positions = reference.positions_at(start.origin, start.t + np.arange(0.0, _PHASE_S + 1.0))
    velocity = np.diff(positions, axis=0)
    course = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    bank = np.arctan(np.abs(np.diff(course)) * speed[1:] / G)
    return classify_phase(float(bank.mean()), -float(velocity[:, 2].mean()))


_DRAWS = 2000
_SEED = 5
_INTERVAL_PERCENT = (2.5, 97.5)  # the interval [%]
_ERRORS_S = (16, 60)  # look-aheads whose median error is compared [s]
BEATEN, MATCHED, WORSE, ONE_FLIGHT = "beaten", "matched", "worse", "one flight, no interval"


def compare(scores: dict[str, MethodScores]) -> dict[str, Any]:
    """Compare ours with each method: difference (ours minus other) of mean first passage up to 60 s and median errors.

    Returns:
        by method: `t10_s`, `p50_16_m`, `p50_60_m`, each with difference, low, high, verdict; `skill_16`, `skill_60`:
        1 - median error of ours / median error of the other
    """
    own_scores = scores.get(OURS)
    return {
        name: _compare_with(own_scores, other_scores)
        for name, other_scores in scores.items()
        if own_scores is not None and name != OURS
    }


def _compare_with(own_scores: MethodScores, other_scores: MethodScores) -> dict[str, Any]:
    passages = [one.passages[LIMITS[0]][:, 0] for one in (own_scores, other_scores)]
    pairs = np.minimum(np.column_stack(passages), MIN_EVENT_FREE_S)
    out: dict[str, Any] = {"t10_s": paired_difference(pairs, own_scores.flight, np.mean, better=1.0)}
    for seconds in _ERRORS_S:
        column = own_scores.column_at(seconds)
        if column is None:
            continue
        pairs = np.column_stack([one.distance[:, column] for one in (own_scores, other_scores)])
        valid = np.isfinite(pairs).all(axis=1)
        out[f"p50_{seconds}_m"] = paired_difference(pairs[valid], own_scores.flight[valid], np.median, better=-1.0)
        medians = np.median(pairs[valid], axis=0) if valid.any() else np.array([np.nan, np.nan])
        out[f"skill_{seconds}"] = round(float(1 - medians[0] / medians[1]), 3) if medians[1] > 0 else None
    return out


def paired_difference(
    pairs: np.ndarray, flight: np.ndarray, statistic: Callable[..., Any], *, better: float
) -> dict[str, float | str | None]:
    """Return the difference of a statistic (ours minus other), its 95 % interval over flights, and the verdict.

    Args:
        pairs: ours and the other at each start, (s, 2)
        flight: flight of each start, (s,)
        statistic: mean or median
        better: sign of a difference in our favour
    """

    def difference(rows: np.ndarray) -> float:
        return float(np.subtract(*statistic(rows, axis=0)))

    by_flight = [pairs[flight == name] for name in np.unique(flight)]
    n = len(by_flight)
    if n < 2:
        value = round(difference(pairs), 2) if n else None
        return {"difference": value, "low": None, "high": None, "verdict": ONE_FLIGHT}
    value = difference(pairs)
    rng = np.random.default_rng(_SEED)
    resampled = [difference(np.concatenate([by_flight[i] for i in rng.integers(n, size=n)])) for _ in range(_DRAWS)]
    low, high = np.percentile(resampled, _INTERVAL_PERCENT)
    verdict = MATCHED if low <= 0 <= high else BEATEN if value * better > 0 else WORSE
    return {
        "difference": round(value, 2),
        "low": round(float(low), 2),
        "high": round(float(high), 2),
        "verdict": verdict,
    }
