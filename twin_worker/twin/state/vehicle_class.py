"""Dispatch by vehicle class, and predictions that need no identified model."""

from dataclasses import dataclass, replace
from math import isfinite

import numpy as np

from fleet.autopilots import copter, greybox
from fleet.contract import Mission
from twin_worker.prediction import kinematic as wing
from twin_worker.prediction.autopilot_parameters import Control, on_rotors
from twin_worker.prediction.multirotor import fit, rollout
from twin_worker.prediction.route_override import Instead
from twin_worker.telemetry.hover_detection import SETTLE_S, lifted
from twin_worker.telemetry.track import Track, track
from twin_worker.twin.state.state import ROUTE_MODES, Twin

NO_WINGS = ("multirotor", "helicopter")
QUADPLANE = "quadplane"
WINGS = ("fixed_wing", QUADPLANE)
_BACK_S = 130.0  # flight time used to fit the kinematic models [s]
_VTOL = (84, 85)  # MAV_CMD: NAV_VTOL_TAKEOFF, NAV_VTOL_LAND
_RECENT = 11  # rows used for a multirotor's velocity and acceleration
_STEERED_S = 6.0  # a multirotor in a hold mode that still moves after this time is under manual control [s]


@dataclass(frozen=True)
class Flight:
    """A predicted path on the route, or the reason why there is none.

    Attributes:
        path: NED, (k, 3) [m]; None if this method cannot predict
        method, law: as in `Prediction`
        seq: mission item at the start, -1 none
        sentence: basis of the prediction, or the reason why there is none
        control: controller model used
    """

    path: np.ndarray | None
    method: str
    law: str
    seq: int
    sentence: str
    control: Control | None = None


def nothing(sentence: str, seq: int = -1) -> Flight:
    """Return a forecast without a path, with the reason."""
    return Flight(None, "", "", seq, sentence)


def seen(twin: Twin, seconds: float = _BACK_S, *, turned: bool = True) -> Track | None:
    """Return the recent track from positions and velocities; `with_attitude` adds the attitude."""
    assert twin.origin is not None
    return track(twin.history, twin.origin, until=twin.history.newest, seconds=seconds, turned=turned)


def hangs(twin: Twin) -> bool:
    """Return whether the aircraft hovers on rotors now, or is about to by its mission."""
    if twin.vehicle in NO_WINGS:
        return True
    if twin.vehicle != QUADPLANE:
        return False
    now = twin.history.newest
    at = np.linspace(now - SETTLE_S, now, 7)
    if lifted(at, twin.history, twin.received, twin.modes).any():
        return True
    item = command_in_force(twin)
    return twin.status is not None and twin.status.mode in ROUTE_MODES and item in _VTOL


def command_in_force(twin: Twin) -> int:
    """Return the command of the active mission item; 0 unknown."""
    seq = rollout.item_in_force(twin.history.newest, twin.history.look("leg"), twin.mission)
    items = twin.mission.items if twin.mission else ()
    return next((item.command for item in items if item.seq == seq), 0) if isfinite(seq) else 0


def _board(twin: Twin, flown: Track, instead: Instead | None = None) -> rollout.Onboard:
    params, mission, autopilot = twin.received, twin.mission, twin.status.autopilot if twin.status else ""
    if instead is not None:
        params = params | dict(instead.asked)
        mission = Mission(uav=twin.uav, t=twin.history.newest, items=instead.items, seq=instead.seq)
    board = rollout.onboard(
        mission, params, autopilot, twin.since, origin=twin.origin, flown=flown, prefix=_prefix(twin)
    )
    return rollout.with_wings(board) if _prefix(twin) else board


def _prefix(twin: Twin) -> str:
    return "Q_" if twin.vehicle == QUADPLANE else ""


def _wing_board(twin: Twin) -> wing.Board:
    assert twin.origin is not None
    items = twin.mission.items if twin.mission else ()
    wind = twin.wind.wind if np.isfinite(twin.wind.t) else None
    return wing.Board(items, twin.received, twin.since, twin.origin, wind, twin.instead, twin.first_item)


def compare_with_flight(twin: Twin) -> None:
    """Fit the parameters of the kinematic models to the last minutes of flight."""
    if twin.why_no_route() or (twin.vehicle not in NO_WINGS and (twin.vehicle not in WINGS or twin.plant is not None)):
        return
    flown = seen(twin)
    if flown is None or len(flown) < 100:
        return
    seq = rollout.items_in_force(flown.t, twin.history.look("leg"), twin.mission)
    if twin.vehicle in NO_WINGS:
        twin.rotor = fit.compare(flown, seq, _board(twin, flown), twin.rotor)
    elif not hangs(twin):
        twin.grey = wing.compare(flown, seq, _wing_board(twin), twin.grey)


def fly_kind(twin: Twin, flown: Track, ahead: np.ndarray) -> Flight:
    """Predict the path on the route with the kinematic model of this vehicle class."""
    whole = flown.whole()
    if len(whole) < 20:
        return nothing("less than 2 s of unbroken positions")
    if hangs(twin):
        return _fly_rotor(twin, whole, ahead)
    if twin.vehicle not in WINGS:
        return nothing(f"vehicle {twin.vehicle}: no controller model available")
    if why := twin.why_no_route():
        return nothing(why)
    if twin.vehicle == QUADPLANE:
        hung = np.flatnonzero(lifted(whole.t, twin.history, twin.received, twin.modes))
        whole = whole.part(int(hung[-1]) + 1 if len(hung) else 0, len(whole))
    seq = rollout.items_in_force(whole.t, twin.history.look("leg"), twin.mission)
    made = wing.fly(whole, seq, _wing_board(twin), twin.grey, ahead)
    if made.path is None:
        return nothing(made.sentence, made.seq)
    said = f"{wing.said(twin.grey)}. {made.sentence}".strip(". ")
    return Flight(made.path, "greybox", greybox.LAW, made.seq, said, made.law)


def _at_speed(flown: Track, instead: Instead) -> Track:
    """Return the track with the overridden speed in its newest rows."""
    if instead.speed is None:
        return flown
    v = flown.v.copy()
    v[-_RECENT:] = instead.at_speed(v[-1], float(np.nan_to_num(flown.euler[-1, 2])))
    return replace(flown, v=v)


def _fly_rotor(twin: Twin, flown: Track, ahead: np.ndarray) -> Flight:
    mode = twin.status.mode if twin.status else ""
    board = _board(twin, flown, twin.instead)
    asked = twin.instead.asked if twin.instead else {}
    control = on_rotors(twin.received, _prefix(twin), board.limit, asked)
    if twin.status is None or not twin.status.armed:
        return nothing("not armed")
    if mode in rollout.HOLD_MODES:
        if twin.history.newest - twin.since > _STEERED_S and np.linalg.norm(flown.v[-20:].mean(axis=0)) > 1.0:
            return nothing(f"mode {mode}, but under manual control")
        still = rollout.hold_still(flown, board, twin.rotor, ahead)
        return Flight(still, "copter", copter.LAW, -1, f"mode {mode} holds position", control)
    if mode in rollout.RETURN_MODES and twin.vehicle in NO_WINGS:
        path = rollout.fly_home(flown, board, twin.rotor, ahead)
        said = f"returns to launch; {rollout.said(board, twin.rotor)}"
        if path is None:
            return nothing("home position unknown")
        return Flight(path, "copter", copter.LAW, -1, said, control)
    if why := twin.why_no_route():
        return nothing(why)
    seq = rollout.items_in_force(flown.t, twin.history.look("leg"), twin.mission)
    if twin.instead is not None:
        seq[-1], flown = twin.instead.seq, _at_speed(flown, twin.instead)
    path, wrong = rollout.fly_route(flown, seq, board, twin.rotor, ahead)
    at = int(seq[-1]) if np.isfinite(seq[-1]) else -1
    if path is None:
        return nothing(wrong, at)
    hung = "hovering on rotors; " if twin.vehicle == QUADPLANE else ""
    said = " ".join(filter(None, (hung + rollout.said(board, twin.rotor), wrong)))
    return Flight(path, "copter", copter.LAW, at, said, control)
