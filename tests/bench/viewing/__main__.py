"""What the viewer takes and gives with a fleet of synthetic feeds: server, clients, picture, clicks, restart.

    python -m tests.bench.viewing --uavs 1000 --json viewing.json
    python -m tests.bench.viewing --uavs 200 --seconds 60 --picture fleet.png
    python -m tests.bench.viewing --uavs 200 --seconds 1300 --plain 0      is memory flat once ten minutes are kept?

A router, the feeder, the viewer as an operator starts it, one browser with software rendering and three websocket
clients, all on this machine: the browser takes the most of it. `server_cpu` is of one core, all threads of the viewer.
`clients` are bytes received: of the browser, then of the three. `pose_to_screen` is from the publishing of a sample to
the first frame with its place. `plain`: a scene with a node for each aircraft, on the same feed, without a browser in
the way. `selection`: from the press on a row until the panel names that UAV; beside it the floor, a press that changes
one number on the same page. `callback_floor`: what a process takes of one core that hears the same and does nothing in
a Python callback for each message; `collect_floor`: the same where messages are put aside and taken out ten times a
second. `memory`: of its own, without libraries; whether it grows is said of a run of 15 minutes or more, for ten are
kept of everyone.
"""

import argparse
import json
import platform
import sys
import threading
import time
from pathlib import Path
from typing import Any

from tests.bench.growth import Row, grown, own_mb
from tests.support.cable import Cable

from .page import Page
from .process import cpu_s, free_port, start, tell
from .watcher import Watcher

SETTLE_S = 15.0  # until chunks of trail are full enough to count [s]
SAMPLES_S = 5.0  # between two looks at the memory [s]
FULL_MIN = 12.0  # after which ten minutes are kept of everyone, and the eighth more that waits to go [min]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--uavs", type=int, default=1000)
    parser.add_argument("--hz", type=float, default=10.0, help="samples of each per second")
    parser.add_argument("--seconds", type=float, default=30.0, help="watched with every client")
    parser.add_argument("--plain", type=float, default=15.0, help="seconds of the plain scene; 0: without it")
    parser.add_argument("--floor", type=float, default=10.0, help="seconds of merely hearing the feed; 0: without it")
    parser.add_argument("--consistency", type=float, default=0.0, help="seconds of comparing list and tiles (0)")
    parser.add_argument("--no-page", action="store_true", help="without a browser")
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    parser.add_argument("--picture", type=Path, help="keep the last frame of the page here")
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    router = f"tcp/127.0.0.1:{free_port()}"
    feeder = start("tests.bench.viewing.feeder", router, "--uavs", str(args.uavs), "--hz", str(args.hz))
    found: dict[str, Any] = {"machine": platform.processor() or platform.machine(), "uavs": args.uavs, "hz": args.hz}
    try:
        found |= with_page(args, router, feeder) if not args.no_page else without_page(args, router, feeder)
        if args.plain:
            found["plain"] = plain(router, args.plain)
        if args.floor:
            found |= {f"{way}_floor": floor(router, way, args.floor) for way in ("callback", "collect")}
    finally:
        found["published_hz"] = float(tell(feeder) or "nan")
        feeder.wait(30)
    print(json.dumps(found, indent=1))
    if args.json:
        args.json.write_text(json.dumps(found, indent=1))
    return 0


def without_page(args: argparse.Namespace, router: str, feeder: Any) -> dict[str, Any]:
    """Watch with websocket clients alone."""
    port = free_port()
    viewer = start("viewer", "--port", str(port), "--router", router)
    tell(feeder)
    watchers = [Watcher(port) for _ in range(4)]
    try:
        wait(SETTLE_S)
        return watched(viewer.pid, watchers, args.seconds, args.uavs)
    finally:
        viewer.terminate()
        viewer.wait(30)


def with_page(args: argparse.Namespace, router: str, feeder: Any) -> dict[str, Any]:
    """Watch with a browser and three clients; then click, then kill the server and start it again."""
    port = free_port()
    command = "tests.bench.viewing.echo", "--port", str(port), "--router", router
    viewer = start(*command)
    cable = Cable(port)
    with Page(args.chromium) as page:
        page.open(cable.port)
        began = float(tell(feeder))
        page.await_node("/fleet/vehicles")
        found: dict[str, Any] = {"first_scene_s": round(time.time() - began, 2)}
        alone = cpu_s(viewer.pid), time.time()
        wait(SETTLE_S)
        found["server_cpu_one_page"] = share(viewer.pid, *alone)
        watchers = [Watcher(port) for _ in range(3)]
        wait(SAMPLES_S)
        page.watch("/fleet/vehicles", began)
        found |= watched(viewer.pid, [cable, *watchers], args.seconds, args.uavs)
        found["page"] = page.seen()
        for watcher in watchers:
            watcher.close()
        if args.consistency:
            found["consistency"] = page.consistency(args.consistency)
        found["selection"] = page.clicks(12)
        if args.picture:
            page.picture(args.picture)
        viewer.kill()
        viewer.wait(30)
        spawned = time.time()
        viewer = start(*command)
        listening = time.time()
        page.seen()  # what the one before had still sent is forgotten
        page.await_pose()
        found["restart"] = {"start_s": round(listening - spawned, 2), "usable_s": round(time.time() - listening, 2)}
    viewer.terminate()
    viewer.wait(30)
    cable.close()
    return found


def watched(pid: int, watchers: list[Any], seconds: float, uavs: int = 0) -> dict[str, Any]:
    """Let time pass; give what the server and each client took, the browser first where there is one."""
    before, memory = [watcher.received for watcher in watchers], list[Row]()
    cpu, begin = cpu_s(pid), time.time()
    while (passed := time.time() - begin) < seconds:
        memory.append(Row(passed / 60.0, "viewer", passed, uavs, own_mb(pid)))
        wait(min(SAMPLES_S, seconds - passed))
    spent = time.time() - begin
    return {
        "seconds": round(spent, 1),
        "server_cpu": share(pid, cpu, begin),
        "clients_kB_s": [round((w.received - b) / spent / 1e3, 1) for w, b in zip(watchers, before, strict=True)],
        "clients_first_s": [round(one.first_s, 2) for one in watchers if isinstance(one, Watcher)],
        "memory_MB": [round(row.mb, 1) for row in memory[:: max(len(memory) // 20, 1)]],
        "memory": grown(memory, FULL_MIN),
    }


def plain(router: str, seconds: float) -> dict[str, Any]:
    """Watch the scene with a node for each aircraft, with one client."""
    port = free_port()
    server = start("tests.bench.viewing.naive", "--port", str(port), "--router", router)
    try:
        wait(SETTLE_S)
        watcher = Watcher(port)
        wait(SAMPLES_S)
        return watched(server.pid, [watcher], seconds)
    finally:
        server.kill()
        server.wait(30)


def floor(router: str, way: str, seconds: float) -> float:
    """Give how much of one core it takes to hear the feed and do nothing."""
    hearer = start("tests.bench.viewing.floor", way, "--router", router)
    try:
        wait(2.0)
        before = cpu_s(hearer.pid), time.time()
        wait(seconds)
        return share(hearer.pid, *before)
    finally:
        hearer.kill()
        hearer.wait(30)


def share(pid: int, cpu: float, since: float) -> float:
    """Give how much of one core a process took since a time."""
    return round((cpu_s(pid) - cpu) / (time.time() - since), 3)


def wait(seconds: float) -> None:
    """Let time pass."""
    threading.Event().wait(seconds)


if __name__ == "__main__":
    sys.exit(main())
