"""Commanded mode changes in simulated flight: when the prediction follows, and its error 10 s ahead.

It is compared with undisturbed predictions of the same flight: made `SETTLED_S` after a change or later, and flown
before the next one. A change begins with a turn, and errors grow with turns: beside all of them stand the undisturbed
predictions whose flight turns by the most similar angle. Beside both stands the same prediction with the state and
route of the aircraft's own controller: its error is that of model, wind and present state, and no part of the change.
"""

from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fleet.contract import Prediction
from tests.bench.mode_changes.flown import (
    Command,
    Flight,
    Predicted,
    epoch,
    error_at,
    fly,
    make,
    predict,
    with_own_controller,
)
from twin_worker.numerics.prediction_errors import along_cross_down, track_frame
from twin_worker.twin.step import Twin

AHEAD_S, FOLLOW_S = 10.0, 2.0
WARM_UP_S = 120.0  # before predictions of undisturbed flight count [s]
SETTLED_S = 12.0  # after a change: a half turn and the capture of a circle [s]
N_SIMILAR = 15  # predictions in the median of similar turns
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
        usual_m: median of the undisturbed predictions of the same flight [m]
        similar_m: median of those whose flight turns by the most similar angle [m]
        own_m: error of the same prediction with the aircraft's own controller [m]
        turn_deg: angle that the flight turns in those `AHEAD_S`, left and right added
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
    similar_m: float
    own_m: float
    turn_deg: float
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


@dataclass(frozen=True)
class Undisturbed:
    """Undisturbed predictions of one flight: errors `AHEAD_S` ahead [m] and turned angles [deg], (n,)."""

    errors: np.ndarray
    turns: np.ndarray

    def similar(self, turn_deg: float) -> float:
        """Return the median error of the predictions whose flight turns by the most similar angle [m]."""
        nearest = np.argsort(np.abs(self.turns - turn_deg), kind="stable")[:N_SIMILAR]
        return float(np.median(self.errors[nearest])) if len(nearest) else float("nan")


def undisturbed(flight: Flight, made: Iterable[Predicted], commands: Iterable[Command]) -> Undisturbed:
    """Return the predictions along a route that no change of mode disturbs."""
    changes = np.array([epoch(command.t) for command in commands])
    on_route = [m.prediction for m in made if follows_route(m) and m.prediction.t >= epoch(WARM_UP_S)]
    settled = [p for p in on_route if not ((p.t - changes > -AHEAD_S) & (p.t - changes < SETTLED_S)).any()]
    rows = [(error_at(flight, p, AHEAD_S), turned_angle(flight, p)) for p in settled]
    errors, turns = np.array(rows).reshape(-1, 2).T
    known = np.isfinite(errors) & np.isfinite(turns)
    return Undisturbed(errors[known], turns[known])


def turned_angle(flight: Flight, p: Prediction) -> float:
    """Return the angle that the flight turns over ground in the next `AHEAD_S`, left and right added [deg]."""
    steps = np.diff(flight.positions(p.ned_origin(), p.t + np.arange(0.0, AHEAD_S + 0.5, 0.5))[:, :2], axis=0)
    return float(np.degrees(np.abs(np.diff(np.unwrap(np.arctan2(steps[:, 1], steps[:, 0])))).sum()))


def measure(seed: int, autopilot: str, folder: Path) -> list[Change]:
    """Fly a seed with changes of mode; return the changes."""
    commands = schedule(seed, autopilot)
    flight = fly(make(seed, autopilot), seed, END_S, folder, commands)
    made: list[Predicted] = []
    own: dict[float, float] = {}  # error with the aircraft's own controller, by the time of the prediction
    twins: dict[int, Twin] = {}
    changes = np.array([epoch(command.t) for command in commands])
    for newest in predict(flight.messages, twins):
        made.append(newest)
        p = newest.prediction
        if ((p.t >= changes) & (p.t <= changes + FOLLOW_S)).any():
            replaced = with_own_controller(flight, deepcopy(twins[p.uav]), p)
            own[p.t] = float("nan") if replaced is None else error_at(flight, replaced, AHEAD_S)
    usual = undisturbed(flight, made, commands)
    return [_change((seed, autopilot), command, flight, (made, own), usual) for command in commands]


def _change(
    flown: tuple[int, str],
    command: Command,
    flight: Flight,
    predicted: tuple[Iterable[Predicted], Mapping[float, float]],
    usual: Undisturbed,
) -> Change:
    made, own = predicted
    changed, mode = epoch(command.t), SHOWN.get(command.mode, command.mode)
    new = [m for m in made if m.prediction.t >= changed]
    first = next((m.prediction for m in new if m.mode == mode and follows_route(m)), None)
    newest = [m.prediction for m in new if m.prediction.t <= changed + FOLLOW_S][-1]
    turn_deg = turned_angle(flight, newest)
    return Change(
        *flown,
        command.t,
        command.mode,
        None if first is None or first.t > changed + LATEST_S else round(first.t - changed, 2),
        float("nan") if first is None else error_at(flight, first, AHEAD_S),
        error_at(flight, newest, AHEAD_S),
        float(np.median(usual.errors)) if len(usual.errors) else float("nan"),
        usual.similar(turn_deg),
        own[newest.t],
        turn_deg,
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
    yield (
        "| autopilot, into | changes | known after [s] | error at 10 s [m] | undisturbed [m] | ratio "
        "| similar turns [m] | ratio | own controller [m] | in region |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|"
    modes = sorted({(c.autopilot, c.mode) for c in changes})
    for autopilot, mode in [*modes, *((name, "") for name in sorted({c.autopilot for c in changes})), ("all", "")]:
        rows = [c for c in changes if autopilot in ("all", c.autopilot) and mode in ("", c.mode)]
        known = [LATEST_S if c.known_s is None else c.known_s for c in rows]
        error, usual, similar, own = (
            float(np.nanmedian([getattr(c, name) for c in rows]))
            for name in ("error_m", "usual_m", "similar_m", "own_m")
        )
        columns = (
            autopilot + (f", {mode}" if mode else ""),
            f"{len(rows)}",
            f"{np.median(known):.1f} (worst {max(known):.1f})",
            *(f"{x:.1f}" for x in (error, usual)),
            f"{error / usual:.2f}",
            f"{similar:.1f}",
            f"{error / similar:.2f}",
            f"{own:.1f}",
            f"{np.mean([c.inside for c in rows]):.0%}",
        )
        yield f"| {' | '.join(columns)} |"
