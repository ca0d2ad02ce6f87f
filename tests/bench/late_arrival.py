"""Telemetry from simulators slower or faster than real time, paused or late: links lost, and predictions afterwards.

    python -m tests.bench.late_arrival --seconds 150
    python -m tests.bench.late_arrival --live --busy 8

A simulated flight goes through the gateway's decoding and a worker on a clock of its own; nothing waits. With --live,
one aircraft for each row sends its datagrams over UDP to a gateway and a worker as processes, all at once, while --busy
further processes keep the machine busy. A link is lost by mistake where telemetry arrived within the second before.
"""

import argparse
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable
from pathlib import Path

from fleet.access.entry import ROUTER
from fleet.bus.session import connect
from fleet.contract import Alert, Message, Prediction, Sample, Status
from tests.bench.referee.site import Site, until
from tests.support.late_arrival import ARRIVALS, Arrival, Datagram, Judge, Outcome, flight, lived, relayed

_PORT = 14990
_PACE = "predict=1,identify=1,ensemble=10"  # the worker's own
_TICK_S = 0.1  # between two looks at what was published [s]
_PATIENCE_S = 60.0
_LAST_S = 3.0  # in which the last predictions are awaited [s]


def main() -> None:
    """Print the table."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m tests.bench.late_arrival", description=__doc__, formatter_class=form)
    parser.add_argument("--seconds", type=float, default=150.0, help="simulated time [s] (150)")
    parser.add_argument("--seed", type=int, default=1, help="of the flight (1)")
    parser.add_argument("--only", action="append", choices=ARRIVALS, help="one of the rows; repeatable (all)")
    parser.add_argument("--live", action="store_true", help="over UDP, gateway and worker as processes")
    parser.add_argument("--busy", type=int, default=0, help="with --live: further processes that never wait (0)")
    parser.add_argument("--router", default=ROUTER, help=f"with --live: address of the router ({ROUTER})")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE")
    args = parser.parse_args()
    rows = {name: ARRIVALS[name] for name in args.only or ARRIVALS}
    print("| speed | link lost by mistake | link lost | longest gap [s] | back after [s] | predictions | steps [s] |")
    print("|---|---|---|---|---|---|---|")
    found = _live(rows, args) if args.live else _simulated(rows, args)
    if args.json:
        load = os.getloadavg()[0] if args.live else None
        figures = {name: outcome.figures() for name, outcome in found.items()}
        args.json.write_text(json.dumps({"load": load, "busy": args.busy, "rows": figures}, indent=1))


def _simulated(rows: dict[str, Arrival], args: argparse.Namespace) -> dict[str, Outcome]:
    """Run the rows one after the other, on a simulated clock."""
    sent, clock = flight(args.seconds, args.seed), [0.0]
    time.monotonic = lambda: clock[0]  # type: ignore[assignment]
    found = {}
    for name, arrival in rows.items():
        found[name] = lived(relayed(sent, arrival), lambda now: clock.__setitem__(0, now)).found
        print(f"| {name} | {found[name].row()} |", flush=True)
    return found


def _live(rows: dict[str, Arrival], args: argparse.Namespace) -> dict[str, Outcome]:
    """Run all rows at once, in real time, beside busy processes."""
    flights = [flight(args.seconds, args.seed, uav) for uav in range(len(rows))]
    judges = [Judge() for _ in rows]
    received: deque[tuple[float, Message]] = deque()
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(args.busy)]
    try:
        with Site(len(rows), args.router, pace=_PACE) as site:
            site.open_router()
            with connect(args.router) as bus:
                site.add()
                for kind in (Sample, Status, Alert, Prediction):
                    bus.subscribe(kind, lambda message, _: received.append((time.monotonic(), message)))
                link = f"--link=udpin:127.0.0.1:{_PORT}"
                site.start("gateway", link, "--offset=-1", "--router", args.router, name="gateway")
                until(_is_open, _PATIENCE_S, "the gateway's port")
                _send(_schedule(flights, list(rows.values())), lambda: _judge(received, judges))
    finally:
        for child in busy:
            child.kill()
            child.wait()
    for name, judge in zip(rows, judges, strict=True):
        print(f"| {name} | {judge.found.row()} |", flush=True)
    print(f"load {os.getloadavg()[0]:.1f}")
    return {name: judge.found for name, judge in zip(rows, judges, strict=True)}


def _is_open() -> bool:
    """Whether a process of this machine listens on the port."""
    return f":{_PORT:04X} " in Path("/proc/net/udp").read_text()


def _schedule(flights: list[list[Datagram]], arrivals: list[Arrival]) -> list[tuple[float, int, bytes]]:
    """Give all datagrams in order of arrival: when [s], of which aircraft, what."""
    found = [
        (arrival.at(t), uav, frame)
        for uav, (sent, arrival) in enumerate(zip(flights, arrivals, strict=True))
        for t, frame in sent
    ]
    return sorted(found, key=lambda one: one[0])


def _send(schedule: list[tuple[float, int, bytes]], judge: Callable[[], None]) -> None:
    """Send each datagram when it is due, from a socket for each aircraft, and take down what is published meanwhile."""
    sockets: dict[int, socket.socket] = defaultdict(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    begun, never, received = time.monotonic(), threading.Event(), 0.0
    for at, uav, frame in schedule:
        while (now := time.monotonic()) < begun + at or now > received + _TICK_S:
            judge()
            received = now
            never.wait(min(max(begun + at - time.monotonic(), 0.0), _TICK_S))
        sockets[uav].sendto(frame, ("127.0.0.1", _PORT))
    never.wait(_LAST_S)
    judge()
    for each in sockets.values():
        each.close()


def _judge(received: deque[tuple[float, Message]], judges: list[Judge]) -> None:
    """Hand what was published to the judge of its aircraft."""
    while received:
        at, message = received.popleft()
        judges[message.uav].hear(at, message)
    for judge in judges:
        judge.tick(time.monotonic())


if __name__ == "__main__":
    main()
