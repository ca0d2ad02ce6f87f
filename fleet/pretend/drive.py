"""Two ways to drive pretend aircraft: in real time over UDP, or as fast as possible into a recording."""

import socket
import struct
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Event
from typing import BinaryIO

import numpy as np

from fleet.pretend.link import Link
from fleet.pretend.uav import PretendUav

TICK_S = 0.01
EPOCH_US = 1_700_000_000_000_000  # when recordings begin: the same bytes for the same seed [us since 1970]
_LATE_S = 0.5  # behind real time by this much: say so [s]


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
    """Fly to `until` [s] tick by tick and give what arrived on the ground."""
    t = uav.tick * TICK_S
    while t < until - TICK_S / 2:
        t += TICK_S
        link.send(t, uav.step(t))
    return link.receive(until)


def write(file: BinaryIO, pairs: list[tuple[float, bytes]]) -> int:
    """Append frames to a .tlog, each with its time [s]; give how many."""
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

    Args:
        uavs: aircraft to fly
        to: host and port of the gateway
        seconds: how long [s]; None for ever
        loss: share of frames lost, either way
        seed: draws losses and delays
        stop: ends the flight
        say: where to say that real time is not kept
    Returns:
        the largest delay behind real time [s]
    """
    rng = np.random.default_rng((seed, 7))
    links = [Link(np.random.default_rng((seed, 6, uav.uav_id)), loss) for uav in uavs]
    sockets = [_socket(to) for _ in uavs]
    begun, lost, worst, warned = time.monotonic(), 0.0, 0.0, -60.0
    try:
        while not stop.is_set():
            t = time.monotonic() - begun - lost
            if seconds is not None and t >= seconds:
                break
            for uav, link, sock in zip(uavs, links, sockets, strict=True):
                _serve(uav, link, sock, t, bool(rng.random() < loss))
            behind = time.monotonic() - begun - lost - t
            worst = max(worst, behind)
            if behind > _LATE_S:
                lost += behind  # the world's clock stands still rather than racing after
                if t - warned > 60:
                    say(f"fly: found {behind:.2f} s behind real time, expected below {TICK_S} s; fly fewer aircraft")
                    warned = t
            stop.wait(max(0.0, TICK_S - behind))
    finally:
        for sock in sockets:
            sock.close()
    return worst


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
