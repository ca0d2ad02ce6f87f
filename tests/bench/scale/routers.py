"""Cost of bus and routers for many aircraft in several regions, each region in a network namespace of its own.

    python -m tests.bench.scale.routers --feeds 1000 --regions 4 --seconds 60 --json routers.json    # as root

Every region has a router, a gateway that publishes samples of its share of the aircraft at 10 Hz, and a worker that
reads them and publishes a prediction of each aircraft every second; the messages are those of a simulated flight. A
viewer in the first region reads all predictions. Three layouts are compared:

separate   regions share nothing; the viewer sees its own
joined     routers connected to each other
limited    the same, but routers pass no samples to other routers (`fleet router --between INTERFACE`;
           processes of a region connect to its router by the loopback interface)
"""

import argparse
import json
import os
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fleet.access.entry import BusConfig
from fleet.bus.codec import EncodedMessage, encode
from fleet.bus.session import connect
from fleet.cli import make_parser, run_command, stop_on_signal
from fleet.contract import Prediction, Sample
from fleet.simulator.flight.drive import to_tlog
from fleet.simulator.flight.uav import SimulatedUav
from fleet.telemetry.recording.recordings import replay_messages
from tests.bench.referee.site import cpu_s, rss_mb
from twin_worker.twin.step import Twin, advance

LAYOUTS = ("separate", "joined", "limited")
_SAMPLE_HZ, _PREDICTION_HZ = 10.0, 1.0
_SETTLE_S = 5.0  # after the start, before anything is counted
_PATIENCE_S = 120.0  # with the start
_BURST = 25  # messages sent together
_TIME = struct.Struct("d")


def address(region: int) -> str:
    """Return the endpoint of a region's router."""
    return f"tcp/10.77.0.{region + 1}:7447"


LOCAL = "tcp/127.0.0.1:7447"
"""Endpoint of the router for the processes of its region."""


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)


@contextmanager
def namespaces(regions: int) -> Iterator[None]:
    """Create one network namespace a region, joined by a bridge; remove them afterwards."""
    with ExitStack() as stack:
        _run("ip", "link", "add", "puhub", "type", "bridge")
        stack.callback(_run, "ip", "link", "del", "puhub")
        _run("ip", "link", "set", "puhub", "up")
        for k in range(regions):
            name, inside, outside = f"parauav{k}", f"puin{k}", f"puout{k}"
            _run("ip", "netns", "add", name)
            stack.callback(_run, "ip", "netns", "del", name)
            _run("ip", "link", "add", outside, "type", "veth", "peer", "name", inside, "netns", name)
            stack.callback(_run, "ip", "link", "del", outside)
            _run("ip", "link", "set", outside, "master", "puhub", "up")
            within = "ip", "netns", "exec", name, "ip"
            _run(*within, "addr", "add", f"10.77.0.{k + 1}/24", "dev", inside)
            _run(*within, "link", "set", inside, "up")
            _run(*within, "link", "set", "lo", "up")
        yield


def bytes_between(regions: int) -> int:
    """Return the bytes that all regions have sent to others so far."""
    return sum(int(Path(f"/sys/class/net/puout{k}/statistics/rx_bytes").read_text()) for k in range(regions))


def payloads(folder: Path) -> dict[type, bytes]:
    """Fly one simulated aircraft and return an encoded sample and prediction of it."""
    to_tlog(folder / "flight.tlog", [SimulatedUav(0, 3, wind=3.0, turbulence=2)], seconds=90.0, loss=0.01, seed=3)
    twin, found = Twin.of(0), dict[type, bytes]()
    for message in replay_messages(folder / "flight.tlog"):
        for one in (message, *advance(twin, (message,))):
            if isinstance(one, Sample | Prediction):
                found[type(one)] = encode(one)
    return found


def _report_ready(args: argparse.Namespace) -> None:
    (args.folder / f"{args.layout}-{args.role}{args.region}.ready").touch()


def _until_ready(folder: Path, layout: str, running: dict[tuple[int, str], subprocess.Popen]) -> None:
    """Wait until all children are connected.

    Raises:
        TimeoutError: when one is not within two minutes.
    """
    missing = {folder / f"{layout}-{role}{region}.ready" for region, role in running}
    begun, never = time.monotonic(), threading.Event()
    while missing := {path for path in missing if not path.exists()}:
        if time.monotonic() - begun > _PATIENCE_S:
            raise TimeoutError(f"routers: {', '.join(path.stem for path in missing)} did not connect")
        never.wait(0.2)


def _end(child: subprocess.Popen) -> None:
    try:
        child.wait(_SETTLE_S)
    except subprocess.TimeoutExpired:
        child.kill()


def route(args: argparse.Namespace) -> None:
    """Run the router of one region."""
    import zenoh

    peers = [address(k) for k in range(args.region)] if args.layout != "separate" else []
    config = zenoh.Config()
    between = [f"puin{args.region}"] if args.layout == "limited" else None
    settings = BusConfig(LOCAL).router_settings([address(args.region), LOCAL], peers, between)
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    with zenoh.open(config):
        _report_ready(args)
        stop_on_signal().wait()


def publish(args: argparse.Namespace) -> None:
    """Publish the messages of one region's aircraft; the worker reads its samples as well."""
    kind, hertz = (Sample, _SAMPLE_HZ) if args.role == "gateway" else (Prediction, _PREDICTION_HZ)
    payload = (args.folder / kind.__name__).read_bytes()
    own = range(args.region * args.feeds // args.regions, (args.region + 1) * args.feeds // args.regions)
    stop, sent = stop_on_signal(), 0
    with connect(LOCAL, retry=True) as bus:
        if args.role == "worker":
            bus.subscribe(Sample, lambda message, _: None, own.__contains__)
        publishers = [bus._session.declare_publisher(f"parauav/{uav}/{kind.topic}") for uav in own]
        _report_ready(args)
        begun = time.monotonic()
        while not stop.wait(max(begun + sent / (hertz * len(own)) - time.monotonic(), 0.0)):
            burst = [k % len(own) for k in range(sent, sent + _BURST)]
            if kind is Sample:
                bus.put_all([EncodedMessage(Sample, own[k], payload, time.time()) for k in burst])
            else:
                for k in burst:
                    publishers[k].put(payload, attachment=_TIME.pack(time.time()))
            sent += _BURST
    (args.folder / f"{args.layout}-{args.role}{args.region}").write_text(str(sent / (time.monotonic() - begun)))


def view(args: argparse.Namespace) -> None:
    """Read all predictions, and store how many came from how many aircraft, and how late."""
    delays: list[float] = []
    uavs: set[str] = set()
    lock = threading.Lock()

    def take(sample: Any) -> None:
        with lock:
            delays.append(time.time() - _TIME.unpack(sample.attachment.to_bytes())[0])
            uavs.add(str(sample.key_expr))

    stop = stop_on_signal()
    with connect(LOCAL, retry=True) as bus:
        subscriber = bus._session.declare_subscriber(f"parauav/*/{Prediction.topic}", take)
        _report_ready(args)
        stop.wait(_SETTLE_S)
        with lock:
            delays.clear()
        begun = time.monotonic()
        stop.wait()
        with lock:
            rate = len(delays) / (time.monotonic() - begun)
            delay_ms = np.quantile(1e3 * np.array(delays), (0.5, 0.99)).round(1).tolist()
            found = {"a_second": round(rate), "uavs": len(uavs), "delay_ms": delay_ms}
        subscriber.undeclare()
    (args.folder / f"{args.layout}-viewer").write_text(json.dumps(found))


def measure(args: argparse.Namespace, layout: str, folder: Path) -> dict[str, Any]:
    """Run one layout and return rates and costs."""
    roles = [(k, role) for role in ("router", "gateway", "worker") for k in range(args.regions)] + [(0, "viewer")]
    running: dict[tuple[int, str], subprocess.Popen] = {}
    never = threading.Event()
    with namespaces(args.regions):
        try:
            for region, role in roles:
                options = "--feeds", str(args.feeds), "--regions", str(args.regions), "--layout", layout
                child = "--role", role, "--region", str(region), "--folder", str(folder), *options
                command = "ip", "netns", "exec", f"parauav{region}", sys.executable, "-m", __spec__.name, *child
                running[region, role] = subprocess.Popen(command)
                if (region, role) == (args.regions - 1, "router"):
                    _until_ready(folder, layout, running)
            _until_ready(folder, layout, running)
            never.wait(_SETTLE_S)
            before = {key: cpu_s(child.pid) for key, child in running.items()}
            sent, begun = bytes_between(args.regions), time.monotonic()
            never.wait(args.seconds)
            took = time.monotonic() - begun
            cores = {key: (cpu_s(child.pid) - before[key]) / took for key, child in running.items()}
            between = (bytes_between(args.regions) - sent) / took
            memory = [rss_mb(running[k, "router"].pid) for k in range(args.regions)]
        finally:
            clients = [child for (_, role), child in reversed(running.items()) if role != "router"]  # the viewer first
            for child in clients:
                child.send_signal(signal.SIGTERM)
            for child in clients:
                _end(child)
            for child in running.values():
                child.kill()  # a router may wait for its neighbours when it closes
                child.wait()
    rates = {
        role: sum(float((folder / f"{layout}-{role}{k}").read_text()) for k in range(args.regions))
        for role in ("gateway", "worker")
    }
    by_role = {role: sum(x for key, x in cores.items() if key[1] == role) for role in {key[1] for key in cores}}
    return {
        "layout": layout,
        "samples_a_second": round(rates["gateway"]),
        "predictions_a_second": round(rates["worker"]),
        "viewer": json.loads((folder / f"{layout}-viewer").read_text()),
        "cores": {role: round(x, 3) for role, x in sorted(by_role.items())},
        "router_mb": [round(x) for x in memory],
        "megabytes_a_second_between_regions": round(between / 1e6, 2),
    }


def _main_run(args: argparse.Namespace) -> int:
    if args.role:
        {"router": route, "viewer": view}.get(args.role, publish)(args)
        return 0
    if os.geteuid():
        raise ValueError("routers: found no root user, expected root, who may create network namespaces; use sudo")
    with tempfile.TemporaryDirectory() as folder:
        found = payloads(Path(folder))
        for kind, payload in found.items():
            (Path(folder) / kind.__name__).write_bytes(payload)
        sizes = {kind.__name__.lower(): len(payload) for kind, payload in found.items()}
        rows = [measure(args, layout, Path(folder)) for layout in args.layouts]
    summary = {"feeds": args.feeds, "regions": args.regions, "bytes": sizes, "layouts": rows}
    print(json.dumps(summary, indent=1))
    if args.json:
        args.json.write_text(json.dumps(summary, indent=1) + "\n")
    return 0


def main(argv: list[str] | None = None) -> int:
    """Measure."""
    parser = make_parser("python -m tests.bench.scale.routers", "Measure bus and routers.", __doc__ or "")
    parser.add_argument("--feeds", type=int, default=1000, metavar="N", help="aircraft (1000)")
    parser.add_argument("--regions", type=int, default=4, metavar="N", help="network namespaces, 1 to 200 (4)")
    parser.add_argument("--seconds", type=float, default=30.0, help="counted, each layout (30)")
    parser.add_argument("--layouts", nargs="+", choices=LAYOUTS, default=list(LAYOUTS))
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--role", choices=("router", "gateway", "worker", "viewer"), help=argparse.SUPPRESS)
    parser.add_argument("--region", type=int, default=0, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--layout", choices=LAYOUTS, help=argparse.SUPPRESS)
    return run_command("bench.scale.routers", _main_run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
