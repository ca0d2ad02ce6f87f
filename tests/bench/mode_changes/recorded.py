"""Changes of flight mode in recordings: the first prediction along the route of the new mode, and its error."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fleet.contract import Message, Prediction, Status
from fleet.telemetry.recording.recordings import replay_messages
from twin_worker.evaluation.replay import run_offline
from twin_worker.evaluation.scoring.log import ReferenceFlight
from twin_worker.twin.step import Twin

AUTONOMOUS = ("AUTO", "RTL", "LOITER", "GUIDED", "CIRCLE", "CRUISE", "HOLD", "RETURN", "MISSION")
AHEAD_S = 10.0
UNDISTURBED_S = 30.0  # from the last change of mode
WARM_UP_S = 60.0  # before the first change that counts
MAX_DELAY_S, MAX_RATIO = 2.0, 1.5


@dataclass(frozen=True)
class ModeChange:
    """One change of mode, and the first prediction after it that follows a route."""

    recording: str
    uav: int
    t: float  # since the first sample [s]
    before: str
    after: str
    delay_s: float | None  # None: no such prediction before the next change
    method: str
    error_m: float | None  # 10 s after that prediction; None: the mode changed again
    usual_m: float  # median of undisturbed flight

    @property
    def is_met(self) -> bool:
        """Return whether delay and error are within the limits."""
        late = self.delay_s is None or self.delay_s > MAX_DELAY_S
        return not late and (self.error_m is None or self.error_m <= MAX_RATIO * self.usual_m)


def measure(name: str, messages: Iterable[Message]) -> list[ModeChange]:
    """Replay one recording; return the mode changes of every aircraft."""
    flights: dict[int, ReferenceFlight] = {}
    modes: dict[int, list[tuple[float, str]]] = {}
    predictions: dict[int, list[Prediction]] = {}
    twins: dict[int, Twin] = {}
    for message in messages:
        flights.setdefault(message.uav, ReferenceFlight()).add(message)
        if isinstance(message, Status) and message.mode:
            of_uav = modes.setdefault(message.uav, [(message.t, message.mode)])
            if of_uav[-1][1] != message.mode:
                of_uav.append((message.t, message.mode))
        for result in run_offline((message,), twins):
            if isinstance(result, Prediction):
                predictions.setdefault(result.uav, []).append(result)
    return [
        change
        for uav, flight in flights.items()
        for change in _changes(name, uav, flight, modes.get(uav, []), predictions.get(uav, []))
    ]


def _changes(
    name: str, uav: int, flight: ReferenceFlight, modes: list[tuple[float, str]], predictions: list[Prediction]
) -> Iterable[ModeChange]:
    change_t = np.array([t for t, _ in modes])
    undisturbed = [
        _error(flight, p) for p in predictions if _follows_route(p) and _gap(p.t, change_t) > UNDISTURBED_S + AHEAD_S
    ]
    errors = [error for error in undisturbed if error is not None]
    usual = float(np.median(errors)) if errors else float("nan")
    for (_, before), (t, after), end in zip(modes[:-1], modes[1:], [*change_t[2:], np.inf], strict=True):
        if after not in AUTONOMOUS or t - flight.first_t < WARM_UP_S:
            continue
        first = next((p for p in predictions if t <= p.t < end and _follows_route(p)), None)
        delay, method, error = None, "", None
        if first is not None:
            delay, method = first.t - t, first.method
            error = _error(flight, first) if first.t + AHEAD_S < end else None
        yield ModeChange(name, uav, t - flight.first_t, before, after, delay, method, error, usual)


def _follows_route(p: Prediction) -> bool:
    return p.method != "imm"


def _gap(t: float, changes: np.ndarray) -> float:
    """Return the time to the nearest change [s]."""
    return float(np.abs(changes - t).min()) if len(changes) else np.inf


def _error(flight: ReferenceFlight, p: Prediction) -> float | None:
    """Return the distance between predicted and flown position at look-ahead `AHEAD_S`; None where not flown [m]."""
    ahead, path = p.ahead.numpy(), p.path.numpy().astype(float)
    instant = np.array([p.t + AHEAD_S])
    if ahead[-1] < AHEAD_S or not flight.has_position(instant)[0]:
        return None
    predicted = np.array([np.interp(AHEAD_S, ahead, column) for column in path.T])
    return float(np.linalg.norm(flight.positions_at(p.ned_origin(), instant)[0] - predicted))


def report(paths: Iterable[Path]) -> Iterable[tuple[str, ModeChange | None]]:
    """Yield the lines of a table, each with its change."""
    yield (
        "| recording | at [s] | change | follows after [s] | method | error at 10 s [m] | undisturbed [m] | met |",
        None,
    )
    yield "|---|---|---|---|---|---|---|---|", None
    for path in paths:
        for c in measure(path.name, replay_messages(path)):
            delay, error = ("—" if x is None else f"{x:.1f}" for x in (c.delay_s, c.error_m))
            line = (
                f"| {c.recording}:uav-{c.uav} | {c.t:.0f} | {c.before} to {c.after} | {delay} | {c.method} | {error} "
                f"| {c.usual_m:.1f} | {'yes' if c.is_met else 'no'} |"
            )
            yield line, c
