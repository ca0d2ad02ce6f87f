"""`twin_worker --uavs 0-49`: hold the twins of a range of UAVs."""

import argparse
import contextlib
import gc
import logging
import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from fleet.access.roles import WORKER
from fleet.airframes import GENERIC, load
from fleet.bus.session import connect
from fleet.cli import guarded, id_range, parser_for, stop_on_signal
from fleet.config import entry, router_arguments
from fleet.contract import FleetState
from fleet.metrics import address, served
from fleet.process.logs import log_arguments, say
from fleet.process.malloc_trim import give_back
from twin_worker.service.processes import run_many
from twin_worker.twin.state.schedule import read_pace

if TYPE_CHECKING:
    from twin_worker.diagnosis.model.baseline import Baseline

SWITCH_S = 5e-4  # how long a thread of the bus waits for the interpreter while another holds it [s]
END_S = 10.0  # after which a worker that was told to end does so in any case [s]
BEHIND = 5  # how much nicer the thread is that gets ready
GARBAGE = 50_000  # objects made before cycles are looked for
LARGE = 256 * 1024  # what a twin on its way takes; kept in between, such blocks leave holes [bytes]
EXAMPLES = """
  twin_worker --uavs 0-49
  twin_worker --uavs 0-199 --pace identify=5,predict=5,ensemble=5,renew=0.1       many aircraft, ten times a second
  twin_worker --uavs 0-9 --airframe my_aircraft.toml       copy fleet/airframes/small_fixed_wing.toml and fill it in
  twin_worker --uavs 0-49 --processes 4                    four that share the range, as on four machines
  twin_worker --uavs 50-99 --router tcp/192.168.1.10:7447
  twin_worker --uavs 0-9 --baseline skywalker.json         what `fleet calibrate` wrote; otherwise each one's own past
"""


def _two_metres(text: str) -> tuple[float, float]:
    """Read `--separation 50,20` [m]."""
    try:
        wide, high = (float(part) for part in text.split(","))
    except ValueError:
        wide = high = float("nan")
    if not (0 < wide < 1e5 and 0 < high < 1e5):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected two distances in m, e.g. 50,20; correct it")
    return wide, high


def _bases(given: list[str]) -> "dict[int, Baseline]":
    """Read what aircraft are compared with, by UAV id; the one of `ALL` is for all others.

    Raises:
        ValueError: when a file is no model; the sentence says what is wrong.
        OSError: when it cannot be read.
    """
    if not given:
        return {}
    from twin_worker.diagnosis.output.keep import load as load_baseline
    from twin_worker.mismatch.coordinator import ALL

    pairs = [text.partition("=") if text.partition("=")[0].isdecimal() else ("", "", text) for text in given]
    return {int(uav) if uav else ALL: load_baseline(Path(path))[0] for uav, _, path in pairs}


def _share() -> None:
    """Let whoever hears wait less for who works out, and look for cycles rarely: twins make none, messages neither."""
    sys.setswitchinterval(SWITCH_S)
    gc.freeze()
    gc.set_threshold(GARBAGE, *gc.get_threshold()[1:])
    give_back(LARGE)


def _end_in_any_case(stop: threading.Event) -> None:
    """End the process some time after it was told to: a machine that is overloaded must not keep what should go."""
    stop.wait()
    threading.Event().wait(END_S)
    logging.getLogger(__name__).error("found no end within %.0f s of being told to; ended by force", END_S)
    os._exit(1)


def _get_ready() -> None:
    """Import and compile behind everyone else: workers that hold aircraft want the processor while another begins."""
    if sys.platform == "linux":
        me = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, me, os.getpriority(os.PRIO_PROCESS, me) + BEHIND)
    from twin_worker.service.warm_up import warm_up  # numba is slow to import: say what happens first

    warm_up()  # before anything is claimed: who compiles cannot take over


def _run(args: argparse.Namespace) -> int:
    airframe, bases = load(args.airframe), _bases(args.baseline)
    stop = stop_on_signal()
    threading.Thread(target=_end_in_any_case, args=(stop,), daemon=True).start()
    with connect(entry(args, WORKER)) as bus:
        bus.publish(FleetState(t=0.0, sentence="compiling the twin's physics, once"))
        with ThreadPoolExecutor(1) as hand:  # a thread may give its priority away, and never has it back
            hand.submit(_get_ready).result()
        from twin_worker.alerts.conflict_probability import Separation
        from twin_worker.mismatch.coordinator import Live
        from twin_worker.mismatch.process import Background
        from twin_worker.service.metrics import counters
        from twin_worker.service.worker import Worker

        aside = Background()
        worker = Worker(
            bus,
            args.uavs,
            omega=args.omega,
            method=args.method,
            airframe=airframe,
            separation=Separation(*args.separation),
            pace=args.pace,
            diagnosis=None if args.no_diagnosis else Live(aside, bases, adapt=not args.no_adapt),
        )
        _share()
        say(f"twin_worker {bus.writer:016x}", f"may hold UAVs {args.uavs.start}-{args.uavs.stop - 1}")
        with contextlib.ExitStack() as held:
            held.callback(aside.close)
            if args.metrics:
                where = held.enter_context(served(args.metrics, counters(worker.state, bus)))
                say("twin_worker", f"counters at {where}")
            worker.run(stop)
    return 0


def _run_many(args: argparse.Namespace) -> int:
    """Run several, each with the options given here.

    Raises:
        ValueError: when it is no number of processes.
    """
    if not 1 <= args.processes <= 256:
        raise ValueError(f"--processes: found {args.processes}, expected 1 to 256; one for each core is a good choice")
    options = [[*args.options, "--processes=1"] for _ in range(args.processes)]
    if args.metrics:
        host, port = address(args.metrics)
        options = [[*each, f"--metrics={host}:{port + k}"] for k, each in enumerate(options)]
    return run_many(options, stop_on_signal())


def main(argv: list[str] | None = None) -> int:
    """Run the worker until it is told to stop."""
    parser = parser_for("twin_worker", "Identify, verify and predict each UAV of a range.", EXAMPLES)
    parser.add_argument("--uavs", type=id_range, default=range(50), metavar="LO-HI", help="ids to hold (0-49)")
    router_arguments(parser)
    methods = ("auto", "dynamics", "hybrid", "paper")
    parser.add_argument(
        "--method",
        choices=methods,
        default=methods[0],
        help="how to fly ahead: the best of coupled model and hybrid (auto), one of them, or two linear axes (paper)",
    )
    parser.add_argument(
        "--airframe", default=GENERIC, metavar="NAME|FILE", help=f"what is known before flight, a TOML file ({GENERIC})"
    )
    parser.add_argument("--omega", type=float, default=0.0, help="least mean fit to verify, %% (0, as in the paper)")
    parser.add_argument(
        "--separation",
        type=_two_metres,
        default=(50.0, 20.0),
        metavar="M,M",
        help="two aircraft nearer than both, over ground and in height, have lost separation (50,20)",
    )
    parser.add_argument(
        "--baseline",
        action="append",
        default=[],
        metavar="[ID=]MODEL",
        help="compare one aircraft, or all, with this model from `fleet calibrate` (each with its own first 105 s)",
    )
    parser.add_argument(
        "--pace",
        type=read_pace,
        metavar="WORK=S,…",
        help="between flights ahead, identifications, ensembles, renewals (predict=1,identify=1,ensemble=10; no renew) "
        "and of an ensemble how many fly, how far ahead (members=24,span=180)",
    )
    parser.add_argument("--no-adapt", action="store_true", help="diagnose, but predict as if nothing was found")
    parser.add_argument("--no-diagnosis", action="store_true", help="do not diagnose at all")
    parser.add_argument(
        "--processes", type=int, default=1, metavar="N", help="workers on this machine that share the range (1)"
    )
    log_arguments(parser)
    parser.add_argument(
        "--metrics", metavar="HOST:PORT", help="counters for Prometheus; of more processes: the ports from there on"
    )
    args = parser.parse_args(argv)
    args.options = sys.argv[1:] if argv is None else argv
    return guarded("twin_worker", _run if args.processes == 1 else _run_many, args)


if __name__ == "__main__":
    sys.exit(main())
