"""Simulated flights with commanded mode changes or a lost link, and the twins that predict them."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import msgspec
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.autopilots import control_law as controller
from fleet.autopilots.laws import remember
from fleet.contract import Array, Message, Prediction
from fleet.frames import Origin, to_geodetic, to_ned
from fleet.mission import P_D, P_N
from fleet.simulator.flight.drive import EPOCH_US, TICK_S, RadioLink, write
from fleet.simulator.flight.mavlink import COMPONENT
from fleet.simulator.flight.mavlink_messages import ARDUPLANE_MODES, PX4_AUTO, PX4_MODES
from fleet.simulator.flight.uav import SimulatedUav
from fleet.telemetry.recording.recordings import replay_messages
from twin_worker.evaluation.replay import run_offline
from twin_worker.prediction.closed_loop import synchronise_controller
from twin_worker.prediction.replay_window import Rollout
from twin_worker.twin.step import Twin
from twin_worker.twin.steps.predict_step import LOOK_BACK_S
from twin_worker.twin.steps.rollouts import method_paths

LOSS = 0.02  # share of frames lost
WIND, TURBULENCE = 4.0, 2
FLOWN_S = 0.2  # between flown positions [s]
GUIDED_M = 700.0  # largest distance of a commanded point from home, north and east [m]
NO_PARAMS: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True)
class Command:
    """A commanded mode and its time since the start of the flight [s]."""

    t: float
    mode: str


@dataclass(frozen=True)
class Flight:
    """What the gateway publishes of a flight, and where it flew by the navigation of the autopilot.

    Attributes:
        messages: as published, in order
        flown_t, flown: positions without the losses of the link, (n,) [s since 1970], NED from `origin`, (n, 3) [m]
        controllers: state of the aircraft's own controller and its route at these times
    """

    messages: tuple[Message, ...]
    flown_t: np.ndarray
    flown: np.ndarray
    origin: Origin
    controllers: tuple[tuple[np.ndarray, np.ndarray], ...] = ()

    def positions(self, origin: Origin, t: np.ndarray) -> np.ndarray:
        """Return the flown positions at times `t`, NED from another origin, nan after the end, (k, 3) [m]."""
        there = _elsewhere(self, origin, self.flown)
        return np.column_stack([np.interp(t, self.flown_t, column, right=np.nan) for column in there.T])


def epoch(t: float) -> float:
    """Return the time of a recording for a time since the start of the flight [s since 1970]."""
    return EPOCH_US * 1e-6 + t


def command_bytes(uav: SimulatedUav, mode: str, rng: np.random.Generator) -> bytes:
    """Return a ground station's command; GUIDED, and PX4's repositioning, fly to a random point."""
    ground, target = mav.MAVLink(None, srcSystem=255, srcComponent=mav.MAV_COMP_ID_MISSIONPLANNER), uav.uav_id + 1
    point = np.array([*rng.uniform(-GUIDED_M, GUIDED_M, 2), 0.0])
    height = float(np.clip(-uav.estimate.p[2] + rng.uniform(-20.0, 20.0), 80.0, 200.0))
    if mode in ("GUIDED", "REPOSITION"):
        lat, lon, _ = (int(x) for x in to_geodetic(uav.origin, point))
        frame, no_param = mav.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, (-1.0, 1.0, 0.0, float("nan"))
        head = (target, COMPONENT, frame, mav.MAV_CMD_DO_REPOSITION, 0, 0)
        message = mav.MAVLink_command_int_message(*head, *no_param, lat, lon, height)
    else:
        is_px4 = "NPFG_PERIOD" in uav.params
        numbers = (PX4_AUTO, PX4_MODES[mode]) if is_px4 else (ARDUPLANE_MODES[mode], 0)
        custom = mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        head = (target, COMPONENT, mav.MAV_CMD_DO_SET_MODE, 0)
        message = mav.MAVLink_command_long_message(*head, custom, *numbers, 0, 0, 0, 0)
    return bytes(message.pack(ground))


def make(seed: int, autopilot: str, params: Mapping[str, float] = NO_PARAMS) -> SimulatedUav:
    """Put the aircraft of a seed in the air."""
    return SimulatedUav(0, seed, wind=WIND, turbulence=TURBULENCE, autopilot=autopilot, extra_params=params)


def fly(uav: SimulatedUav, seed: int, seconds: float, folder: Path, commands: Iterable[Command] = ()) -> Flight:
    """Fly with commands; return what the gateway publishes."""
    rng, link = np.random.default_rng((seed, 12)), RadioLink(np.random.default_rng((seed, 6, uav.uav_id)), LOSS)
    due, flown, path = {round(c.t / TICK_S): c.mode for c in commands}, [], folder / f"flight_{seed}.tlog"
    controllers = []
    with path.open("wb") as file:
        write(file, [(0.0, frame) for frame in uav.initial_frames()])
        for k in range(1, int(seconds / TICK_S) + 1):
            t = k * TICK_S
            link.send(t, uav.step(t))
            if k % round(FLOWN_S / TICK_S) == 0:
                flown.append(uav.estimate.p.copy())
                controllers.append(uav.controller)
            if mode := due.get(k):
                link.send(t, uav.receive(command_bytes(uav, mode, rng)))
            if k % 100 == 0:
                write(file, link.receive(t))
        write(file, link.receive(seconds))
    messages = tuple(replay_messages(path))
    path.unlink()
    flown_t = epoch(FLOWN_S * np.arange(1, len(flown) + 1))
    return Flight(messages, flown_t, np.array(flown), uav.origin, tuple(controllers))


def fly_lost(uav: SimulatedUav, lost_t: float, until: float) -> Flight:
    """Fly without telemetry, and without link from `lost_t` on; return where it flew since then, until it lands."""
    uav.silent = True
    uav.step(lost_t)
    uav.link_lost = True
    t, flown = [lost_t], [uav.estimate.p.copy()]
    while t[-1] < until and not uav.crashed:
        t.append(t[-1] + FLOWN_S)
        uav.step(t[-1])
        flown.append(uav.estimate.p.copy())
    return Flight((), epoch(np.array(t)), np.array(flown), uav.origin)


@dataclass(frozen=True)
class Predicted:
    """A prediction, and the mode that its twin knew."""

    prediction: Prediction
    mode: str


def predict(messages: Iterable[Message], twins: dict[int, Twin]) -> Iterator[Predicted]:
    """Drive a twin with a flight; yield its predictions."""
    for message in messages:
        for result in run_offline((message,), twins):
            if isinstance(result, Prediction):
                yield Predicted(result, twins[result.uav].mode)


def with_own_controller(flight: Flight, twin: Twin, p: Prediction) -> Prediction | None:
    """Return the newest prediction with the state and route of the aircraft's own controller instead of the twin's.

    Its error keeps that of the model, the wind and the present state. None where the method needs no controller.
    """
    window = twin.window(LOOK_BACK_S)
    context = None if window is None else twin.situation(window)
    initial = None if context is None else synchronise_controller(context)
    if context is None or initial is None or isinstance(initial, Rollout) or twin.telemetry.origin is None:
        return None
    ctl, legs = (x.copy() for x in flight.controllers[int(np.abs(flight.flown_t - p.t).argmin())])
    par = initial.synchronised[1]
    legs[:, P_N : P_D + 1] = _elsewhere(flight, twin.telemetry.origin, legs[:, P_N : P_D + 1])
    start, here = ctl[controller.FROM].copy(), np.zeros((1, 3))
    ctl = remember(ctl, par, float(_elsewhere(flight, twin.telemetry.origin, here)[0, 2]))
    ctl[controller.FROM] = _elsewhere(flight, twin.telemetry.origin, start[None])[0]
    ahead = p.ahead.numpy().astype(float)
    paths, _ = method_paths(twin, (context, replace(initial, synchronised=(ctl, par, legs))), ahead, True)
    path = paths.get(p.method)
    return None if path is None else msgspec.structs.replace(p, path=Array.of(path.astype(np.float32)))


def _elsewhere(flight: Flight, origin: Origin, points: np.ndarray) -> np.ndarray:
    """Convert points NED from the origin of a flight to NED from another origin, (n, 3) [m]."""
    return to_ned(origin, *(x.astype(float) for x in to_geodetic(flight.origin, points).T))


def error_at(flight: Flight, p: Prediction, ahead_s: float) -> float:
    """Return the distance between predicted and flown position at a look-ahead; nan where not flown [m]."""
    ahead, path = p.ahead.numpy().astype(float), p.path.numpy().astype(float)
    if ahead[-1] < ahead_s:
        return float("nan")
    predicted = np.array([np.interp(ahead_s, ahead, column) for column in path.T])
    return float(np.linalg.norm(flight.positions(p.ned_origin(), np.array([p.t + ahead_s]))[0] - predicted))
