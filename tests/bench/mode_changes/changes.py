"""Commanded mode changes in simulated flight: when the prediction follows, and its error 10 s ahead."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fleet.contract import Prediction
from tests.bench.mode_changes.flown import Command, Flight, Predicted, epoch, error_at, fly, make, predict
from twin_worker.numerics.prediction_errors import along_cross_down, track_frame

AHEAD_S, FOLLOW_S = 10.0, 2.0
WARM_UP_S = 120.0  # before predictions of undisturbed flight count [s]
LATEST_S = 30.0  # a later first prediction counts as none [s]
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
        seed, autopilot, t, mode: as commanded
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


def schedule(seed: int, autopilot: str) -> tuple[Command, ...]:
    """Return the commands of a seed, at any time between two heartbeats."""
    rng = np.random.default_rng((seed, 13))
    return tuple(Command(c.t + round(float(rng.uniform(0.0, 1.0)), 2), c.mode) for c in SCHEDULES[autopilot])


def follows_route(made: Predicted) -> bool:
    """Return whether a prediction follows a route."""
    return made.prediction.method != "imm"


def undisturbed(seed: int, autopilot: str, folder: Path) -> np.ndarray:
    """Return the errors `AHEAD_S` ahead in the undisturbed flight of a seed, along a route, (n,) [m]."""
    flight = fly(make(seed, autopilot), seed, END_S, folder)
    made = [m for m in predict(flight.messages, {}) if m.prediction.t >= epoch(WARM_UP_S)]
    return np.array([error_at(flight, m.prediction, AHEAD_S) for m in made if follows_route(m)])


def measure(seed: int, autopilot: str, folder: Path) -> list[Change]:
    """Fly a seed without and with changes of mode; return the changes."""
    usual = float(np.nanmedian(undisturbed(seed, autopilot, folder)))
    commands = schedule(seed, autopilot)
    flight = fly(make(seed, autopilot), seed, END_S, folder, commands)
    made = predict(flight.messages, {})
    return [_change((seed, autopilot), command, flight, made, usual) for command in commands]


def _change(
    flown: tuple[int, str], command: Command, flight: Flight, made: Iterable[Predicted], usual: float
) -> Change:
    changed, mode = epoch(command.t), SHOWN.get(command.mode, command.mode)
    new = [m for m in made if m.prediction.t >= changed]
    first = next((m.prediction for m in new if m.mode == mode and follows_route(m)), None)
    newest = [m.prediction for m in new if m.prediction.t <= changed + FOLLOW_S][-1]
    return Change(
        *flown,
        command.t,
        command.mode,
        None if first is None or first.t > changed + LATEST_S else round(first.t - changed, 2),
        float("nan") if first is None else error_at(flight, first, AHEAD_S),
        error_at(flight, newest, AHEAD_S),
        usual,
        _inside(flight, newest, (5.0, AHEAD_S)),
        newest.horizon_s,
        newest.method,
    )


def _inside(flight: Flight, p: Prediction, look_aheads: tuple[float, ...]) -> float:
    ahead, path = p.ahead.numpy().astype(float), p.path.numpy().astype(float)
    error = along_cross_down(track_frame(path, ahead), flight.positions(p.ned_origin(), p.t + ahead) - path)
    inside = (np.abs(error) <= p.prediction_region_half_axes.numpy()).all(axis=1)
    return float(np.mean([inside[np.searchsorted(ahead, s)] for s in look_aheads]))


def report(changes: Sequence[Change]) -> Iterable[str]:
    """Yield a table by autopilot and mode: medians over the flights."""
    yield "| autopilot, into | changes | known after [s] | error at 10 s [m] | undisturbed [m] | ratio | in region |"
    yield "|---|---|---|---|---|---|---|"
    for autopilot, mode in sorted({(c.autopilot, c.mode) for c in changes}):
        rows = [c for c in changes if (c.autopilot, c.mode) == (autopilot, mode)]
        known = [LATEST_S if c.known_s is None else c.known_s for c in rows]
        error, usual = (float(np.nanmedian([getattr(c, name) for c in rows])) for name in ("error_m", "usual_m"))
        yield (
            f"| {autopilot}, {mode} | {len(rows)} | {np.median(known):.1f} (worst {max(known):.1f}) | {error:.1f} "
            f"| {usual:.1f} | {error / usual:.2f} | {np.mean([c.inside for c in rows]):.0%} |"
        )
