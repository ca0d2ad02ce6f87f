"""Two ways to drive pretend aircraft: in real time over UDP, or as fast as possible into a recording."""

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
EPOCH_US = 1_700_000_000_000_000  # when recordings begin: the same bytes for the same seed [us since 1970]
_LATE_S = 0.5  # behind real time by more, simulated time slows down [s]
_STEP_S = 0.1  # of simulated time between two rounds at most: what is late comes evenly, not in a burst [s]
_RATIO_S = 5.0  # real time over which the achieved speed is measured before it is told [s]


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
    """Fly as fast as possible into a .tlog: 8 bytes of microseconds since 1970, big endian, then one frame, for ever.

    The recording begins with every aircraft's mission and parameters, asked for without loss.

    Args:
        path: file to write
        uavs: aircraft to fly
        seconds: how long [s]
        loss: share of frames lost
        seed: draws losses and delays
        progress: called with the flown time [s]
        stop: ends the flight early
    Returns:
        frames written
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
    """Fly to `until` [s] tick by tick and return what arrived on the ground."""
    t = uav.tick * TICK_S
    while t < until - TICK_S / 2:
        t += TICK_S
        link.send(t, uav.step(t))
    return link.receive(until)


def write(file: BinaryIO, pairs: list[tuple[float, bytes]]) -> int:
    """Append frames to a .tlog, each with its time [s]; return how many."""
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
    """Fly in real time, one UDP socket per aircraft, and answer what comes back.

    Where the machine is too slow, simulated time runs slower than real time: every tick is simulated and sent, none is
    left out, and the achieved speed is told once.

    Args:
        uavs: aircraft to fly
        to: host and port of the gateway
        seconds: how long [s]; None for ever
        loss: share of frames lost, either way
        seed: draws losses and delays
        stop: ends the flight
        say: where to say that real time is not kept, and what speed is achieved
    Returns:
        the largest delay of a round behind its due time [s]
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
    """Simulated time against real time: the same speed as long as the machine keeps up, else slower.

    Args:
        begun: real time when simulated time is 0 [s, monotonic]
        say: where to tell the achieved speed, once
    """

    def __init__(self, begun: float, say: Callable[[str], None]) -> None:
        self.t = 0.0  # simulated time [s]
        self._begun, self._say = begun, say
        self._slow: tuple[float, float] | None = None  # simulated and real time since which it is slower [s]
        self._told = False

    def due(self, now: float) -> float:
        """Return the simulated time that is due at `now` [s, monotonic]."""
        return now - self._begun

    def next(self, now: float) -> float:
        """Return the simulated time to go on to at `now` [s, monotonic]."""
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
    """Fly one aircraft to `t` [s], listen, talk."""
    link.send(t, uav.step(t))
    try:
        while data := sock.recv(65_535):
            if not deaf:
                link.send(t, uav.hear(data))
    except OSError:  # nothing more to hear, or nobody there yet
        pass
    for _, frame in link.receive(t):
        try:
            sock.send(frame)
        except OSError:  # no room, nobody there, no way: as with a radio, gone
            continue
