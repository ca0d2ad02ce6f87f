"""MAVProxy beside the gateway: it loads mission and parameters of a pretend aircraft through us while we do.

    python -m tests.bench.second_station --mavproxy PATH/mavproxy.py --json second_station.json

Needs MAVProxy in an environment of its own (`pip install MAVProxy`); it is no dependency of ParaUAV.
"""

import argparse
import json
import os
import queue
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from fleet.bus.session import Bus, connect, open_router
from fleet.contract import GatewayCounters, Item, Mission, Params
from fleet.process.children import Children

PATIENCE_S = 600.0  # for each step [s]


class Station:
    """MAVProxy, told what to do by its standard input."""

    def __init__(self, program: str, port: int, folder: Path) -> None:
        self._process = subprocess.Popen(
            [program, f"--master=udpout:127.0.0.1:{port}", f"--state-basedir={folder}", "--source-system=253"],
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,  # it would take the terminal
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )
        self._said: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._said.put(line.rstrip())

    def ask(self, command: str) -> None:
        """Type a command."""
        assert self._process.stdin is not None
        self._process.stdin.write(command + "\n")
        self._process.stdin.flush()

    def wait(self, words: str) -> float:
        """Wait until it says so; gives how long that took [s].

        Raises:
            TimeoutError: when it does not.
        """
        began = time.monotonic()
        while (left := began + PATIENCE_S - time.monotonic()) > 0:
            try:
                line = self._said.get(timeout=left)
            except queue.Empty:
                break
            print(f"  mavproxy: {line}", flush=True)
            if words in line:
                return time.monotonic() - began
        raise TimeoutError(f"mavproxy: found no {words!r} within {PATIENCE_S:.0f} s, expected it; look at its output")

    def close(self) -> None:
        """End it."""
        self._process.kill()  # it has nothing to put in order, and may not hear a kinder word
        self._process.wait()


def ours(bus: Bus, uav: int) -> tuple[Mission, Params]:
    """Wait until the gateway has mission and parameters of an aircraft."""
    done = threading.Event()
    for _ in range(round(PATIENCE_S)):
        mission, params = bus.get(Mission, uav), bus.get(Params, uav)
        if mission and params and mission[0][0].complete and params[0][0].complete:
            return mission[0][0], params[0][0]
        done.wait(1.0)
    raise TimeoutError(
        f"uav-{uav}: found no whole mission and parameters within {PATIENCE_S:.0f} s; look at the gateway"
    )


def measure(program: str) -> dict[str, object]:
    """Fly one aircraft, let both load everything, compare."""
    air, ground, where = free(socket.SOCK_DGRAM), free(socket.SOCK_DGRAM), f"tcp/127.0.0.1:{free(socket.SOCK_STREAM)}"
    router = open_router(where)
    try:
        with tempfile.TemporaryDirectory() as name, connect(where) as bus, Children() as children:
            folder = Path(name)
            links = [f"--link=udpin:127.0.0.1:{air}", f"--forward=udpin:127.0.0.1:{ground}"]
            children.start("gateway", "gateway", "--router", where, *links)
            children.start("aircraft", "fleet.cli", "fly", "--uavs", "6", "--to", f"127.0.0.1:{air}", "--loss", "0")
            accounts: list[GatewayCounters] = []
            bus.subscribe(GatewayCounters, lambda account, _: accounts.append(account))
            mission, params = ours(bus, 7)
            station = Station(program, ground, folder)
            try:
                loaded = station.wait("parameters to ")  # it asks by itself, and writes them down
                station.ask("wp list")
                listed = station.wait("waypoints to ")
            finally:
                station.close()
            items = [line.split("\t") for line in (folder / "way_7.txt").read_text().splitlines()[1:]]
            theirs = {
                line.split()[0]: float(line.split()[1]) for line in (folder / "mav_7_1.parm").read_text().splitlines()
            }
    finally:
        router.close()
    pairs = zip(items, mission.items, strict=False)
    return {
        "parameters": {"ours": len(params.values), "theirs": len(theirs), "seconds": round(loaded, 1)},
        "same parameters": sum(alike(params.values.get(name), value) for name, value in theirs.items()),
        "mission": {"ours": len(mission.items), "theirs": len(items), "seconds": round(listed, 1)},
        "same items": sum(same_item(row, item) for row, item in pairs),
        "refused": accounts[-1].refused,
    }


def same_item(row: list[str], item: Item) -> bool:
    """Tell whether a line of a waypoint file, six digits after the point, is this item."""
    near = all(abs(float(row[k]) * 1e7 - degrees) <= 6 for k, degrees in ((8, item.lat_e7), (9, item.lon_e7)))
    return near and int(row[3]) == item.command and abs(float(row[10]) - item.alt_m) < 1e-3


def alike(one: float | None, other: float) -> bool:
    """Tell whether a value is the same but for what a text file leaves of it."""
    return one is not None and abs(one - other) <= 1e-5 * max(1.0, abs(other))


def free(kind: int) -> int:
    """Give a port nobody holds."""
    with socket.socket(socket.AF_INET, kind) as trial:
        trial.bind(("127.0.0.1", 0))
        return int(trial.getsockname()[1])


def main() -> None:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m tests.bench.second_station", description=__doc__, formatter_class=form)
    parser.add_argument("--mavproxy", default=shutil.which("mavproxy.py"), metavar="PROGRAM", help="mavproxy.py")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was measured")
    args = parser.parse_args()
    if not args.mavproxy:
        sys.exit(
            "second_station: found no mavproxy.py, expected one; pip install MAVProxy elsewhere, name it --mavproxy"
        )
    found = measure(args.mavproxy)
    print(json.dumps(found, indent=1))
    if args.json:
        args.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
