"""Drivers of simulated aircraft and their links: in real time over UDP, or as fast as possible into a recording."""

import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Event
from typing import BinaryIO, Protocol

import numpy as np
from rich.progress import Progress

DELAY_S = 0.015  # minimum delay [s]
JITTER_S = 0.004  # mean additional delay [s]
FADE_S = (0.2, 1.4)  # range of the duration of a fade [s]


class SimulatedAircraft(Protocol):
    """Interface of a simulated aircraft of any vehicle class."""

    uav_id: int
    tick: int

    def step(self, t: float) -> list[bytes]:
        """Advance to `t` [s] since simulation start and return the frames sent meanwhile."""
        ...

    def receive(self, data: bytes) -> list[bytes]:
        """Process bytes from the ground and return the replies."""
        ...

    def initial_frames(self) -> list[bytes]:
        """Return the frames for the start of a recording."""
        ...


class RadioLink:
    """One direction of one radio link."""

    def __init__(self, rng: np.random.Generator, loss: float, fades_s: float = 0.0):
        """Draw losses from `rng`; with `fades_s` above 0, fades occur at this mean interval [s].

        Raises:
            ValueError: when `loss` is outside 0..1.
        """
        if not 0 <= loss < 1:
            raise ValueError(f"loss: found {loss}, expected a fraction from 0 to below 1; use e.g. 0.02")
        self._rng, self._loss = rng, loss
        self._queue: deque[tuple[float, bytes]] = deque()
        self._last_arrival = 0.0
        self._fades_s = fades_s
        self._fade = (0.0, 0.0)  # start and end of the next fade [s]

    def send(self, t: float, frames: list[bytes]) -> None:
        """Send frames at time `t` [s]."""
        if self._fades_s > 0 and self._is_faded(t):
            return
        for frame in frames:
            if self._rng.random() >= self._loss:
                self._last_arrival = max(self._last_arrival, t + DELAY_S + float(self._rng.exponential(JITTER_S)))
                self._queue.append((self._last_arrival, frame))

    def _is_faded(self, t: float) -> bool:
        if t >= self._fade[1]:
            begins = t + float(self._rng.exponential(self._fades_s))
            self._fade = begins, begins + float(self._rng.uniform(*FADE_S))
        return t >= self._fade[0]

    def receive(self, t: float) -> list[tuple[float, bytes]]:
        """Return the frames received until `t`: arrival time [s] and frame, in order."""
        arrived = []
        while self._queue and self._queue[0][0] <= t:
            arrived.append(self._queue.popleft())
        return arrived


TICK_S = 0.01
EPOCH_US = 1_700_000_000_000_000  # fixed start of recordings, for reproducible files [us since 1970]
_MAX_LAG_S = 0.5  # maximum lag behind real time before simulated time slows down [s]
_MAX_STEP_S = 0.1  # maximum simulated time per round, which spreads a backlog evenly [s]
_SPEED_WINDOW_S = 5.0  # real time to measure the achieved speed before logging it [s]


def to_tlog(
    path: Path,
    uavs: Sequence[SimulatedAircraft],
    *,
    seconds: float,
    loss: float,
    seed: int,
    title: str = "",
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
        title: of the progress bar; empty: none
        stop: stops the simulation early
    Returns:
        number of frames written
    """
    links = [RadioLink(np.random.default_rng((seed, 6, uav.uav_id)), loss) for uav in uavs]
    written = 0
    with path.open("wb") as file, Progress(transient=True, disable=not title) as bar:
        task = bar.add_task(title, total=seconds)
        written += write(file, [(0.0, frame) for uav in uavs for frame in uav.initial_frames()])
        for k in range(1, int(seconds) + 1):
            received: list[tuple[float, bytes]] = []
            for uav, link in zip(uavs, links, strict=True):
                received += _fly_until(uav, link, float(k))
            written += write(file, received)
            bar.update(task, completed=k)
            if stop is not None and stop.is_set():
                break
    return written


def _fly_until(uav: SimulatedAircraft, link: RadioLink, until: float) -> list[tuple[float, bytes]]:
    """Simulate to `until` [s] tick by tick and return the frames received on the ground."""
    t = uav.tick * TICK_S
    while t < until - TICK_S / 2:
        t += TICK_S
        link.send(t, uav.step(t))
    return link.receive(until)


def write(file: BinaryIO, stamped_frames: list[tuple[float, bytes]]) -> int:
    """Append frames with their times [s] to a .tlog; return their number."""
    for t, frame in sorted(stamped_frames, key=lambda pair: pair[0]):
        file.write(struct.pack(">Q", EPOCH_US + round(t * 1e6)) + frame)
    return len(stamped_frames)


def to_udp(
    uavs: Sequence[SimulatedAircraft],
    address: tuple[str, int],
    *,
    seconds: float | None,
    loss: float,
    seed: int,
    stop: Event,
    log: Callable[[str], None] = print,
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
    links = [RadioLink(np.random.default_rng((seed, 6, uav.uav_id)), loss) for uav in uavs]
    sockets = [_socket(address) for _ in uavs]
    clock, max_delay = _SimulationClock(time.monotonic(), log), 0.0
    try:
        while not stop.is_set():
            t = clock.advance(time.monotonic())
            if seconds is not None and t >= seconds:
                break
            for uav, link, sock in zip(uavs, links, sockets, strict=True):
                _serve(uav, link, sock, t, bool(rng.random() < loss))
            lag = clock.due(time.monotonic()) - t
            max_delay = max(max_delay, lag)
            stop.wait(max(0.0, TICK_S - lag))
    finally:
        for sock in sockets:
            sock.close()
    return max_delay


class _SimulationClock:
    """Simulated time: equal to real time, or slower on a machine that is too slow.

    Args:
        start: real time at simulated time 0 [s, monotonic]
        log: receives the achieved speed once
    """

    def __init__(self, start: float, log: Callable[[str], None]) -> None:
        self.t = 0.0  # simulated time [s]
        self._start, self._log = start, log
        self._slow_since: tuple[float, float] | None = None  # simulated and real time at its start [s]
        self._reported = False

    def due(self, now: float) -> float:
        """Return the target simulated time at `now` [s, monotonic]."""
        return now - self._start

    def advance(self, now: float) -> float:
        """Advance and return the simulated time at `now` [s, monotonic]."""
        excess_lag = self.due(now) - self.t - _MAX_LAG_S
        if excess_lag > 0:
            self._start += excess_lag
            self._measure(now)
        else:
            self._slow_since = None
        self.t = max(self.t, min(self.due(now), self.t + _MAX_STEP_S))
        return self.t

    def _measure(self, now: float) -> None:
        t, since = self._slow_since = self._slow_since or (self.t, now)
        if not self._reported and now - since >= _SPEED_WINDOW_S:
            self._reported = True
            ratio = (self.t - t) / (now - since)
            self._log(
                f"fly: found {ratio:.2f} times real time, expected 1; simulated time slows down: fly fewer aircraft"
            )


def _socket(address: tuple[str, int]) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setblocking(False)
    sock.connect(address)
    return sock


def _serve(uav: SimulatedAircraft, link: RadioLink, sock: socket.socket, t: float, drop_uplink: bool) -> None:
    """Simulate one aircraft to `t` [s], receive requests, send frames."""
    link.send(t, uav.step(t))
    try:
        while data := sock.recv(65_535):
            if not drop_uplink:
                link.send(t, uav.receive(data))
    except OSError:  # no more data, or no receiver yet
        pass
    for _, frame in link.receive(t):
        try:
            sock.send(frame)
        except OSError:  # the frame is lost, as on a radio
            continue
