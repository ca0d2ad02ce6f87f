"""What identification and verification cost a live worker: many twins, one hop a second each, against nfoursid.

    python -m tests.bench.learning flight.tlog --uavs 100 --seconds 20 --json learning.json

One twin hears the first part of the flight; copies of it, as if each were another aircraft, hear the rest through the
worker. `cores` is the processor time of all hops over the time flown. The peer identifies both axes of the same window
without verifying them (absent: not compared). Best run on a quiet machine.
"""

import argparse
import copy
import json
import platform
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fleet.contract import Message
from fleet.telemetry.recording.recordings import replay_messages
from tests.support.memory_bus import MemoryBus
from twin_worker.evaluation.replay import run_offline
from twin_worker.service.warm_up import warm_up
from twin_worker.service.worker import OwnedTwin, Worker
from twin_worker.twin import step as loop
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps.identify_step import identify_and_verify


def begun(messages: list[Message]) -> Twin:
    """Let one twin hear the first part."""
    twins: dict[int, Twin] = {}
    for _ in run_offline(messages, twins):
        pass
    (twin,) = twins.values()
    return twin


def measure(twin: Twin, rest: list[Message], uavs: int) -> dict[str, Any]:
    """Fly copies of a twin through the rest of its flight; give what their hops cost."""
    worker = Worker(MemoryBus(), range(uavs), omega=twin.config.omega)
    hops: list[float] = []

    def timed(one: Twin) -> list[Message]:
        start = time.process_time()
        found = identify_and_verify(one)
        hops.append(time.process_time() - start)
        return found

    for uav in range(uavs):
        one = copy.deepcopy(twin)
        one.config = msgspec.structs.replace(one.config, uav=uav)
        worker._owned[uav] = OwnedTwin(one, epoch=1)
    loop.identify_and_verify = timed  # type: ignore[attr-defined]
    began = time.process_time()
    for message in rest:
        for uav in range(uavs):
            worker._on_message(msgspec.structs.replace(message, uav=uav))
        worker.sweep()
    flown = rest[-1].t - rest[0].t
    ms = 1e3 * np.array(hops)
    return {
        "uavs": uavs,
        "flown_s": flown,
        "hops": len(hops),
        "cores": sum(hops) / flown,
        "cores_with_prediction": (time.process_time() - began) / flown,
        "hop_ms_median": float(np.median(ms)),
        "hop_ms_mean": float(ms.mean()),
        "hop_ms_p90": float(np.quantile(ms, 0.9)),
    }


def peer(twin: Twin) -> float | None:
    """Give the time nfoursid takes for both axes of the newest 40 s [ms]; None where it is not installed."""
    if not find_spec("nfoursid"):
        return None
    from .identification.flight import Flight
    from .identification.peers import method

    window = twin.window(40.0)
    assert window is not None
    n = len(window)
    flight = Flight("copy", 0, window.dt, window.t, window.x, window.u, np.full(n, np.nan), window.ok, 2.0)
    ways = method("nfoursid")
    return float(np.median([ways().identify(flight, 0).ms for _ in range(5)][1:]))


def main() -> None:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m tests.bench.learning", description=__doc__, formatter_class=form)
    parser.add_argument("file", type=Path, metavar="FILE", help="a flight of one fixed wing")
    parser.add_argument("--uavs", type=int, default=100, help="copies (100)")
    parser.add_argument("--after", type=float, default=150.0, help="first part of the flight [s] (150)")
    parser.add_argument("--seconds", type=float, default=20.0, help="of the rest that are flown (20)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was measured")
    args = parser.parse_args()
    warm_up()
    heard = list(replay_messages(args.file))
    split = heard[0].t + args.after
    twin = begun([m for m in heard if m.t < split])
    nfoursid = peer(twin)
    found = measure(twin, [m for m in heard if split <= m.t < split + args.seconds], args.uavs)
    found |= {"nfoursid_ms": nfoursid, "machine": platform.processor() or platform.machine()}
    found["times_faster"] = nfoursid / found["hop_ms_median"] if nfoursid else None
    for name, value in found.items():
        print(f"{name:22s} {value:.3f}" if isinstance(value, float) else f"{name:22s} {value}")
    if args.json:
        args.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
