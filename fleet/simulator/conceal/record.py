"""Simulate a planned flight, optionally into a recording, and check that it stays in the flight envelope."""

import struct
from collections.abc import Callable, Iterable
from math import nan
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fleet.simulator.conceal.paths import SETTLE_S, PlannedFlight
from fleet.simulator.faults.physics import Fault
from fleet.simulator.flight.drive import TICK_S, RadioLink, write
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.jsbsim import Truth
from fleet.simulator.vehicle.sensors import Estimate, pressure_height

LOG_S = 0.1
LOSS, FADES_S = 0.02, 45.0  # fraction of frames lost; mean time between two fades [s]
_ATTITUDE = bytes((30, 0, 0))  # MAVLink message id
_MAX_ALPHA = {"c172p": 0.20, "small": 0.21}  # maximum angle of attack with attached flow [rad]
_MIN_HEIGHT_M, _MAX_BANK, _MAX_SIDESLIP = 30.0, np.radians(75), np.radians(16)
_SPEED_RANGE = (0.72, 1.4)  # relative to cruise

_LogRow = tuple[float, Truth, Estimate, tuple[int, ...]]


class ExamFlightLog(NamedTuple):
    """A flight at 10 Hz."""

    t: np.ndarray  # since simulation start, (n,) [s]
    channels: np.ndarray  # recorded channels, columns as in `acts._FLIGHT_NOISE`, (n, 21)
    Va: np.ndarray  # true airspeed, (n,) [m/s]
    alpha: np.ndarray
    beta: np.ndarray
    bank: np.ndarray
    height: np.ndarray  # above home [m]
    rho: np.ndarray  # air density [kg/m3]


def fly(
    planned: PlannedFlight,
    faults: tuple[Fault, ...],
    path: Path | None = None,
    observe: Callable[[SimulatedUav], None] = lambda _: None,
) -> tuple[ExamFlightLog, float]:
    """Simulate with `faults`, into a recording if a path is given; call `observe` with the aircraft at 10 Hz.

    Returns:
        the log, and the time of the first recorded ATTITUDE since simulation start [s]; nan without a recording
    """
    uav = planned.build_uav(faults)
    uav.silent = path is None
    uav.step(SETTLE_S)
    link = RadioLink(np.random.default_rng((planned.flight_seed, 6)), LOSS, FADES_S)
    rows: list[_LogRow] = []
    arrived = [(SETTLE_S, frame) for frame in uav.initial_frames()]
    for k in range(1, round(planned.seconds / LOG_S) + 1):
        until = SETTLE_S + k * LOG_S
        for tick in range(round((until - LOG_S) / TICK_S) + 1, round(until / TICK_S) + 1):
            link.send(tick * TICK_S, uav.step(tick * TICK_S))
        arrived += link.receive(until)
        observe(uav)
        rows.append((until, uav.aircraft.truth(), uav.estimate, uav.pulses))
    if path is not None:
        with path.open("wb") as file:
            write(file, arrived)
    first_s = nan if path is None else first_attitude(frame for _, frame in arrived) - uav.boot_s
    return _to_log(rows), first_s


def _to_log(rows: list[_LogRow]) -> ExamFlightLog:
    t, truth, estimates, pulses = zip(*rows, strict=True)
    heights = [(pressure_height(e.pressure), e.gps_height) for e in estimates]
    body = [np.concatenate([e.rates, e.force, e.euler, e.v, e.p, [e.Va]]) for e in estimates]
    channels = np.column_stack([np.array(body), np.array(heights), (np.array(pulses) - 1500) / 400])
    columns = np.array([(x.Va, x.alpha, x.beta, x.euler[0], -x.p[2], x.rho) for x in truth]).T
    return ExamFlightLog(np.array(t), channels, *columns)


def first_attitude(frames: Iterable[bytes]) -> float:
    """Return the time stamp of the first ATTITUDE among MAVLink 2 frames, since boot [s]."""
    stamps = (struct.unpack_from("<I", frame, 10)[0] for frame in frames if frame[7:10] == _ATTITUDE)
    return next(stamps) * 1e-3


def rejection_reason(planned: PlannedFlight, log: ExamFlightLog) -> str:
    """Return the reason to reject a flight; empty if it is acceptable."""
    airframe = planned.job.airframe
    speed = log.Va / {"c172p": 48.0, "small": 23.0}[airframe]
    limits = {
        "too short": log.t[-1] < SETTLE_S + planned.seconds - 1,
        "too low": log.height.min() < _MIN_HEIGHT_M,
        "stalled": log.alpha.max() > _MAX_ALPHA[airframe],
        "banked": np.abs(log.bank).max() > _MAX_BANK,
        "slipped": np.abs(log.beta).max() > _MAX_SIDESLIP,
        "too slow or too fast": speed.min() < _SPEED_RANGE[0] or speed.max() > _SPEED_RANGE[1],
    }
    return next((reason for reason, violated in limits.items() if violated), "")
