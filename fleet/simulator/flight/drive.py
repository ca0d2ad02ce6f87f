"""Drivers of simulated aircraft: in real time over UDP, or as fast as possible into a recording."""

import socket
import struct
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Event
from typing import BinaryIO

import numpy as np

from fleet.simulator.flight.link import Link
from fleet.simulator.flight.uav import PretendUav

TICK_S = 0.01
EPOCH_US = 1_700_000_000_000_000  # fixed start of recordings, for reproducible files [us since 1970]
_LATE_S = 0.5  # maximum lag behind real time before simulated time slows down [s]
_STEP_S = 0.1  # maximum simulated time per round, which spreads a backlog evenly [s]
_RATIO_S = 5.0  # real time to measure the achieved speed before logging it [s]


def to_tlog(
    path: Path,
    uavs: Sequence[PretendUav],
    *,
    seconds: float,
    loss: float,
    seed: int,
    progress: Callable[[float], None] = lambda _: None,
    stop: Event | None = None,
) -> int:
    """Simulate as fast as possible into a .tlog: records of 8 bytes microseconds since 1970, big endian, and one frame.

    The recording starts with mission and parameters of every aircraft, without loss.

    Args:
        path: file to write
        uavs: simulated aircraft
        seconds: duration [s]
        loss: fraction of frames lost
        seed: seed of losses and delays
        progress: called with the simulated time [s]
        stop: stops the simulation early
    Returns:
        number of frames written
    """
    links = [Link(np.random.default_rng((seed, 6, uav.uav_id)), loss) for uav in uavs]
    written = 0
    with path.open("wb") as file:
        written += write(file, [(0.0, frame) for uav in uavs for frame in uav.introduce()])
        for k in range(1, int(seconds) + 1):
            arrived: list[tuple[float, bytes]] = []
            for uav, link in zip(uavs, links, strict=True):
                arrived += _second(uav, link, float(k))
            written += write(file, arrived)
            progress(float(k))
            if stop is not None and stop.is_set():
                break
    return written


def _second(uav: PretendUav, link: Link, until: float) -> list[tuple[float, bytes]]:
    """Simulate to `until` [s] tick by tick and return the frames received on the ground."""
    t = uav.tick * TICK_S
    while t < until - TICK_S / 2:
        t += TICK_S
        link.send(t, uav.step(t))
    return link.receive(until)


def write(file: BinaryIO, pairs: list[tuple[float, bytes]]) -> int:
    """Append frames with their times [s] to a .tlog; return their number."""
    for t, frame in sorted(pairs, key=lambda pair: pair[0]):
        file.write(struct.pack(">Q", EPOCH_US + round(t * 1e6)) + frame)
    return len(pairs)


def to_udp(
    uavs: Sequence[PretendUav],
    to: tuple[str, int],
    *,
    seconds: float | None,
    loss: float,
    seed: int,
    stop: Event,
    say: Callable[[str], None] = print,
) -> float:
    """Simulate in real time with one UDP socket per aircraft, and reply to requests.

    On a machine that is too slow, simulated time runs slower than real time; no tick is skipped. The achieved speed is
    logged once.

    Args:
        uavs: simulated aircraft
        address: host and port of the gateway
        seconds: duration [s]; None: unlimited
        loss: fraction of frames lost in each direction
        seed: seed of losses and delays
        stop: stops the simulation
        log: receives the message about speed below real time
    Returns:
        maximum lag of a round behind real time [s]
    """
    rng = np.random.default_rng((seed, 7))
    links = [Link(np.random.default_rng((seed, 6, uav.uav_id)), loss) for uav in uavs]
    sockets = [_socket(to) for _ in uavs]
    pace, worst = _Pace(time.monotonic(), say), 0.0
    try:
        while not stop.is_set():
            t = pace.next(time.monotonic())
            if seconds is not None and t >= seconds:
                break
            for uav, link, sock in zip(uavs, links, sockets, strict=True):
                _serve(uav, link, sock, t, bool(rng.random() < loss))
            behind = pace.due(time.monotonic()) - t
            worst = max(worst, behind)
            stop.wait(max(0.0, TICK_S - behind))
    finally:
        for sock in sockets:
            sock.close()
    return worst


class _Pace:
    """Simulated time: equal to real time, or slower on a machine that is too slow.

    Args:
        start: real time at simulated time 0 [s, monotonic]
        log: receives the achieved speed once
    """

    def __init__(self, begun: float, say: Callable[[str], None]) -> None:
        self.t = 0.0  # simulated time [s]
        self._begun, self._say = begun, say
        self._slow: tuple[float, float] | None = None  # simulated and real time at the start of slow operation [s]
        self._told = False

    def due(self, now: float) -> float:
        """Return the target simulated time at `now` [s, monotonic]."""
        return now - self._begun

    def next(self, now: float) -> float:
        """Advance and return the simulated time at `now` [s, monotonic]."""
        late = self.due(now) - self.t - _LATE_S
        if late > 0:
            self._begun += late
            self._measure(now)
        else:
            self._slow = None
        self.t = max(self.t, min(self.due(now), self.t + _STEP_S))
        return self.t

    def _measure(self, now: float) -> None:
        t, since = self._slow = self._slow or (self.t, now)
        if not self._told and now - since >= _RATIO_S:
            self._told = True
            ratio = (self.t - t) / (now - since)
            self._say(
                f"fly: found {ratio:.2f} times real time, expected 1; simulated time slows down: fly fewer aircraft"
            )


def _socket(to: tuple[str, int]) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setblocking(False)
    sock.connect(to)
    return sock


def _serve(uav: PretendUav, link: Link, sock: socket.socket, t: float, deaf: bool) -> None:
    """Simulate one aircraft to `t` [s], receive requests, send frames."""
    link.send(t, uav.step(t))
    try:
        while data := sock.recv(65_535):
            if not deaf:
                link.send(t, uav.hear(data))
    except OSError:  # no more data, or no receiver yet
        pass
    for _, frame in link.receive(t):
        try:
            sock.send(frame)
        except OSError:  # the frame is lost, as on a radio
            continue
