"""Commanded mode changes in simulated flight: when the prediction follows, and its error 10 s ahead."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.bench.mode_changes.flown import Command, Flight, Predicted, epoch, error_at, fly, make, predict
from twin_worker.twin.step import Twin

AHEAD_S, FOLLOW_S = 10.0, 2.0
WARM_UP_S = 120.0  # before predictions of undisturbed flight count [s]
MAX_RATIO = 1.5
SCHEDULES = {
    "ardupilot": (
        *(Command(150, "RTL"), Command(195, "AUTO"), Command(235, "LOITER"), Command(275, "AUTO")),
        *(Command(315, "GUIDED"), Command(360, "AUTO")),
    ),
    "px4": (
        *(Command(150, "RTL"), Command(195, "MISSION"), Command(235, "LOITER"), Command(275, "MISSION")),
        *(Command(315, "REPOSITION"), Command(360, "MISSION")),
    ),
}
END_S = 395.0
SHOWN = {"REPOSITION": "LOITER", "MISSION": "MISSION"}


@dataclass(frozen=True)
class Change:
    """One commanded change.

    Attributes:
        known_s: from the change to the first prediction along the route of the new mode; None: before the next: none
        first_m: its error `AHEAD_S` ahead [m]
        error_m: the same of the newest prediction `FOLLOW_S` after the change [m]
        usual_m: median over the undisturbed flight of the same seed [m]
        inside: share of look-aheads 5 and 10 s of that prediction inside its region
        horizon_s: confidence horizon of that prediction
    """

    seed: int
    autopilot: str
    t: float
    mode: str
    known_s: float | None
    first_m: float
    error_m: float
    usual_m: float
    inside: float
    horizon_s: float
    method: str


def undisturbed(seed: int, autopilot: str, folder: Path) -> np.ndarray:
    """Return the errors `AHEAD_S` ahead of the undisturbed flight of a seed, nan where not along a route, (n,) [m]."""
    flight = fly(make(seed, autopilot), seed, END_S, folder)
    made = [m for m in predict(flight.messages, {}) if m.prediction.t >= epoch(WARM_UP_S)]
    return np.array([error_at(flight, m.prediction, AHEAD_S) for m in made if follows_route(m)])


def follows_route(made: Predicted) -> bool:
    """Return whether a prediction follows a route."""
    return made.prediction.method != "imm"


def measure(seed: int, autopilot: str, folder: Path) -> tuple[list[Change], np.ndarray]:
    """Fly a seed with and without changes; return the changes and the errors of undisturbed flight [m]."""
    errors = undisturbed(seed, autopilot, folder)
    schedule = SCHEDULES[autopilot]
    flight = fly(make(seed, autopilot), seed, END_S, folder, schedule, autopilot)
    twins: dict[int, Twin] = {}
    made = predict(flight.messages, twins)
    usual = float(np.nanmedian(errors))
    return [_change(seed, autopilot, command, flight, made, usual) for command in schedule], errors


def _change(
    seed: int, autopilot: str, command: Command, flight: Flight, made: Iterable[Predicted], usual: float
) -> Change:
    changed, mode = epoch(command.t), SHOWN.get(command.mode, command.mode)
    new = [m for m in made if m.prediction.t >= changed]
    first = next((m.prediction for m in new if m.mode == mode and follows_route(m)), None)
    newest = [m.prediction for m in new if m.prediction.t <= changed + FOLLOW_S][-1]
    return Change(
        seed,
        autopilot,
        command.t,
        command.mode,
        None if first is None or first.t > changed + 30.0 else round(first.t - changed, 2),
        float("nan") if first is None else error_at(flight, first, AHEAD_S),
        error_at(flight, newest, AHEAD_S),
        usual,
        _inside(flight, newest, (5.0, AHEAD_S)),
        newest.horizon_s,
        newest.method,
    )


def _inside(flight: Flight, p, look_aheads: tuple[float, ...]) -> float:
    from twin_worker.numerics.prediction_errors import along_cross_down, track_frame

    ahead, path = p.ahead.numpy().astype(float), p.path.numpy().astype(float)
    actual = flight.positions(p.ned_origin(), p.t + ahead)
    inside = (np.abs(along_cross_down(track_frame(path, ahead), actual - path)) <= p.prediction_region_half_axes.numpy()).all(axis=1)
    return float(np.mean([inside[np.searchsorted(ahead, s)] for s in look_aheads]))
