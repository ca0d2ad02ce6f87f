"""A hostile session of a whole gateway: its memory before, at most and after, and whether the live link is served.

    python -m tests.bench.security.hostile --json hostile.json

A gateway process with two UDP links and a TCP port. On one UDP link a rightful aircraft speaks ten times a second all
the time. Against the other links, in this order: 64 silent callers of the TCP port, beside whom a rightful one calls;
100 MB of random, damaged and magic-filled bytes; 255 system ids from 4 senders each, which announce parameters and
missions without a heartbeat, then with one, then fly; 3,000 datagrams of 65 kB. Then everything is silent but the
rightful ones.
"""

import argparse
import contextlib
import json
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from fleet.bus.session import connect, open_router
from fleet.cli import make_parser, run_command
from fleet.contract import GatewayCounters, Sample
from gateway.links.tcp_listener import MOST
from tests.bench.gateway.fuzz import blocks
from tests.support.talker import ITEMS, Talker

from .site import PATIENCE_S, free_port
from .trying import until

SEED, JUNK = 1, 100_000_000  # bytes
SYSTEMS, SENDERS = 255, 4
PARAMS, NAMES = 1_200, 300  # parameters a ghost announces before its heartbeat, and after it, of so many
HUGE, HUGE_SIZE = 3_000, 65_000  # datagrams, and the bytes of one
LIVE, CALLER = 251, 252  # the rightful aircraft, on links of their own
FASTEST = 2e7  # what is sent [bytes/s]
MOST_MB = 100  # growth allowed while it lasts
AFTER_MB = 20  # and after GIVEN_BACK_S
GIVEN_BACK_S = 60.0
GAP_S = 1.5  # longest silence of the rightful aircraft on the bus
SETTLE_S = 5.0


class Session(NamedTuple):
    """What was measured."""

    before_mb: float
    peak_mb: float
    after_mb: float
    gap_s: float  # longest between two samples of the rightful aircraft
    heard: int  # samples of it
    uavs: int  # aircraft the gateway knew at most
    late_uavs: int  # and at the end
    called: bool  # whether a rightful caller of the TCP port was heard beside the silent ones
    rows: list[tuple[str, float]]  # highest memory in each part [MB]


def megabytes(pid: int) -> float:
    """Give the memory of a process."""
    found = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    assert found is not None
    return int(found[1]) / 1024


def life(talker: Talker) -> list[bytes]:
    """Return the frames of an aircraft with parameters, a mission and 4 s of flight."""
    mission = [talker.count(len(ITEMS)), *(talker.item(k) for k in range(len(ITEMS)))]
    params = [talker.param(f"Q{i:04d}", i, i, NAMES) for i in range(NAMES)]
    return [talker.heartbeat(), *mission, *params, *(talker.attitude(0.02 * k) for k in range(200))]


class Watch:
    """Memory of a process and samples of the rightful aircraft, looked at all the time."""

    def __init__(self, pid: int, at: str) -> None:
        self.heard, self.gap_s, self.peak_mb, self.known, self.uavs = 0, 0.0, 0.0, 0, 0
        self._pid, self._at, self._last = pid, at, 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _hear(self, sample: Sample, _: object) -> None:
        if sample.uav == LIVE:
            now = time.monotonic()
            self.gap_s = max(self.gap_s, now - self._last) if self.heard else 0.0
            self.heard, self._last = self.heard + 1, now

    def _count(self, account: GatewayCounters, _: object) -> None:
        self.known = len(account.uavs)
        self.uavs = max(self.uavs, self.known)

    def _run(self) -> None:
        with connect(self._at) as bus:
            bus.subscribe(Sample, self._hear)
            bus.subscribe(GatewayCounters, self._count)
            while not self._stop.wait(0.02):
                self.peak_mb = max(self.peak_mb, megabytes(self._pid))

    def take_peak(self) -> float:
        """Give the highest memory since this was last asked [MB]."""
        peak, self.peak_mb = self.peak_mb, megabytes(self._pid)
        return peak

    def __enter__(self) -> "Watch":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


class Rightful:
    """Aircraft that fly all the time: one by UDP, and one by TCP from when it is called."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._fly)

    def _fly(self) -> None:
        talker, boot = Talker(LIVE), 4.0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as air:
            for frame in life(talker):  # what the first use of parameters and missions loads is no growth
                air.sendto(frame, ("127.0.0.1", self._port))
            while not self._stop.wait(0.1):
                boot += 0.1
                beat = talker.heartbeat() if round(boot * 10) % 10 == 0 else b""
                air.sendto(beat + talker.attitude(boot), ("127.0.0.1", self._port))

    def __enter__(self) -> "Rightful":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


class Sender:
    """Send no faster than a flooded network would."""

    def __init__(self, port: int) -> None:
        self._to, self._due = ("127.0.0.1", port), time.monotonic()
        self._sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(SENDERS)]

    def send(self, data: bytes, sender: int = 0) -> None:
        with contextlib.suppress(OSError):  # its buffer is full
            self._sockets[sender].sendto(data, self._to)
        self._due = max(self._due, time.monotonic() - 0.05) + len(data) / FASTEST
        if (left := self._due - time.monotonic()) > 0.005:
            threading.Event().wait(left)

    def close(self) -> None:
        for one in self._sockets:
            one.close()


def junk(to: Sender) -> None:
    """Send bytes that are no messages, and some that are."""
    for k, block in enumerate(blocks(SEED, JUNK)):
        for at in range(0, len(block), 50_000 if k % 7 == 0 else 1_400):
            to.send(block[at : at + (50_000 if k % 7 == 0 else 1_400)], k % SENDERS)


def announced(to: Sender) -> None:
    """Announce parameters and missions of systems that never said what they are."""
    _every(to, lambda talker: [talker.param(f"P{i:04d}", i, i, PARAMS) for i in range(PARAMS)])


def ghosts(to: Sender) -> None:
    """Introduce aircraft that are none: each with parameters, a mission, texts and some flight."""
    _every(to, life)


def _every(to: Sender, said) -> None:  # type: ignore[no-untyped-def]
    for system in range(1, SYSTEMS + 1):
        for sender in range(SENDERS):
            frames, waiting = said(Talker(system)), b""
            for frame in frames:
                if len(waiting) + len(frame) > 1_400:
                    to.send(waiting, sender)
                    waiting = b""
                waiting += frame
            to.send(waiting, sender)


def huge(to: Sender) -> None:
    """Send the largest datagrams there are, full of small messages."""
    talker = Talker(200)
    frame = talker.heartbeat() + talker.attitude(1.0)
    data = (frame * (HUGE_SIZE // len(frame) + 1))[:HUGE_SIZE]
    for k in range(HUGE):
        to.send(data, k % SENDERS)


@contextlib.contextmanager
def gateway(at: str, *options: str) -> Iterator[subprocess.Popen[str]]:
    """Run a gateway for as long as the block lasts."""
    command = [sys.executable, "-m", "gateway", "--router", at, "--listen-only", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as child:
        assert child.stdout is not None
        reader = threading.Thread(target=child.stdout.read)
        while (line := child.stdout.readline()) and "udpin" not in line:
            pass  # it may have to compile first
        reader.start()
        try:
            yield child
        finally:
            child.terminate()
            reader.join()


def session() -> Session:
    """Hold the whole session."""
    at, live, foe, tcp = f"tcp/127.0.0.1:{free_port()}", free_port(), free_port(), free_port()
    links = (f"--link=udpin:127.0.0.1:{live}", f"--link=udpin:127.0.0.1:{foe}#offset=1000")
    links = (*links, f"--link=tcpin:127.0.0.1:{tcp}")
    router = open_router(at)
    to = Sender(foe)
    rows = []
    try:
        with (
            gateway(at, *links) as child,
            Watch(child.pid, at) as watch,
            Rightful(live),
            contextlib.ExitStack() as held,
        ):
            if not until(lambda: watch.heard > 10):
                raise TimeoutError("the rightful aircraft was not heard")
            threading.Event().wait(SETTLE_S)
            before = watch.take_peak()
            for _ in range(MOST):
                held.enter_context(socket.create_connection(("127.0.0.1", tcp), PATIENCE_S))
            called = _fly_by_tcp(held, tcp, watch)
            for attack in (junk, announced, ghosts, huge):
                attack(to)
                threading.Event().wait(1.0)
                rows.append((attack.__name__, round(watch.take_peak(), 1)))
            gap_s = watch.gap_s
            threading.Event().wait(GIVEN_BACK_S)
            after, peak = megabytes(child.pid), max(mb for _, mb in rows)
            return Session(before, peak, after, gap_s, watch.heard, watch.uavs, watch.known, called, rows)
    finally:
        to.close()
        router.close()


def _fly_by_tcp(held: contextlib.ExitStack, port: int, watch: Watch) -> bool:
    """Call beside the silent ones; tells whether that was heard."""
    air = held.enter_context(socket.create_connection(("127.0.0.1", port), PATIENCE_S))
    talker, known = Talker(CALLER), watch.known

    def told() -> bool:
        with contextlib.suppress(OSError):
            air.sendall(talker.heartbeat())
        threading.Event().wait(0.1)
        return watch.known > known

    return until(told)


def _run(args: argparse.Namespace) -> int:
    found = session()
    print(found)
    if args.json:
        args.json.write_text(json.dumps(found._asdict(), indent=1) + "\n")
    return 0


def main(argv: list[str] | None = None) -> int:
    """Attack one gateway."""
    parser = make_parser("python -m tests.bench.security.hostile", "Attack one gateway.", __doc__ or "")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was measured")
    return run_command("bench.hostile", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
