"""Run the twins of a range of UAVs: `twin_worker --uavs 0-49`."""

import argparse
import contextlib
import gc
import importlib
import logging
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from fleet.access.roles import WORKER
from fleet.cli import id_range, make_parser, run_command, stop_on_signal
from fleet.config import bus_config_from, router_arguments
from fleet.process.children import Children
from fleet.process.file_options import airframe_file, input_file, model_of
from fleet.process.logs import log_arguments, report_progress, report_status
from fleet.process.malloc_trim import enable_malloc_trim
from twin_worker import CACHE_COMPLETE
from twin_worker.twin.state.budget import LIVE_SCHEDULE, parse_schedule

_POLL_S = 0.5
_RESTART_DELAY_S = 5.0  # before a restart, so that an immediate failure does not loop at full load [s]


if TYPE_CHECKING:
    from twin_worker.diagnosis.model.baseline import Baseline

SWITCH_INTERVAL_S = 5e-4  # maximum wait of a bus thread for the interpreter [s]
EXIT_TIMEOUT_S = 10.0  # time from a stop signal to a forced exit [s]
COMPILING_PERIOD_S = 1.0  # between two reports that the worker compiles [s]
LOW_PRIORITY_S = 15.0  # after which the rest of the start has a higher priority, so that it ends on a busy machine [s]
COMPILING_STEP_S = 10  # step of the time in these reports [s]
NICE_INCREMENTS = 10, 5  # of the nice value of the threads that import and warm up, at first and later
GC_THRESHOLD = 50_000  # allocations between garbage collections
MMAP_THRESHOLD_B = 16 << 20  # malloc blocks above this are mapped separately [bytes]
MALLOC_TRIM_THRESHOLD_B = 64 << 20  # free memory that the heap keeps between trims [bytes]
EXAMPLES = """
  twin_worker --uavs 0-49
  twin_worker --uavs 0-199 --pace identify=5,predict=5,ensemble=5,renew=0.1       many aircraft, 10 Hz extrapolation
  twin_worker --uavs 0-9 --airframe my_aircraft.toml       copy fleet/airframes/small_fixed_wing.toml and fill it in
  twin_worker --uavs 0-49 --processes 4                    four processes share the range
  twin_worker --uavs 50-99 --router tcp/192.168.1.10:7447
  twin_worker --uavs 0-9 --terrain N47E008.hgt             ground alerts above this terrain instead of above home
  twin_worker --uavs 0-9 --areas no-fly.geojson            geofence alerts for these areas, too
  twin_worker --uavs 0-9 --baseline skywalker.json         model from `fleet calibrate`; default: each UAV's own past
"""


def _parse_separation(text: str) -> tuple[float, float]:
    """Parse `--separation 50,20` [m]."""
    try:
        horizontal, vertical = (float(part) for part in text.split(","))
    except ValueError:
        horizontal = vertical = float("nan")
    if not (0 < horizontal < 1e5 and 0 < vertical < 1e5):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected two distances in m, e.g. 50,20; correct it")
    return horizontal, vertical


def _load_baselines(options: list[str]) -> "dict[int, Baseline]":
    """Load the comparison models by UAV id; that of `ALL_UAVS` applies to all others.

    Raises:
        ValueError: when a file is no model; the message states the error.
        OSError: when it cannot be read; check the path.
    """
    if not options:
        return {}
    from twin_worker.diagnosis.multirotor.baseline import RotorBaseline
    from twin_worker.diagnosis.output.keep import load as load_baseline
    from twin_worker.mismatch.coordinator import ALL_UAVS

    pairs = [text.partition("=") if text.partition("=")[0].isdecimal() else ("", "", text) for text in options]
    baselines = {}
    for uav, _, path in pairs:
        baseline, _ = load_baseline(Path(path))
        if isinstance(baseline, RotorBaseline):
            raise ValueError(f"{path}: found a rotor model, expected one of a fixed wing; use it with `fleet diagnose`")
        baselines[int(uav) if uav else ALL_UAVS] = baseline
    return baselines


def _tune_runtime() -> None:
    """Shorten thread switching and collect garbage rarely: twins and messages create no reference cycles."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.freeze()
    gc.set_threshold(GC_THRESHOLD, *gc.get_threshold()[1:])


def _force_exit(stop: threading.Event) -> None:
    """Exit some time after the stop signal, even on an overloaded machine."""
    stop.wait()
    threading.Event().wait(EXIT_TIMEOUT_S)
    logging.getLogger(__name__).error("found no end within %.0f s of the stop signal; exit forced", EXIT_TIMEOUT_S)
    os._exit(1)


def _import_steps(*names: str) -> Iterator[Callable[[], object]]:
    """Yield one step for each module."""
    return (partial(importlib.import_module, name) for name in names)


def _preparation() -> Iterator[Callable[[], object]]:
    """Yield the steps before any claim: imports and the warm-up. A compiling worker cannot take over aircraft."""
    yield from _import_steps("numba", "scipy.interpolate", "scipy.optimize", "scipy.signal")
    from twin_worker.service.warm_up import warm_up_steps

    yield from warm_up_steps()
    yield from _import_steps("twin_worker.mismatch.process", "twin_worker.service.worker")


def _run_steps(steps: Iterator[Callable[[], object]], increment: int, until: float) -> bool:
    """Run steps at lower priority, none that starts after `until`, monotonic [s]; return whether all are done."""
    if sys.platform == "linux":
        thread_id = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread_id, os.getpriority(os.PRIO_PROCESS, thread_id) + increment)
    while time.monotonic() < until:
        step = next(steps, None)
        if step is None:
            return True
        step()
    return False


def run_at_low_priority(
    steps: Iterator[Callable[[], object]], low_priority_s: float, report: Callable[[float], None] = lambda _: None
) -> None:
    """Run steps on a thread of low priority, because other workers on the machine need the CPU.

    A thread can lower its priority but not raise it again: another one continues.

    Args:
        steps: are run in order
        low_priority_s: no step starts at the lowest priority after this time, so that a busy machine delays them little
        report: called once a second with the time since the start [s]
    """
    started = time.monotonic()
    for increment, limit_s in zip(NICE_INCREMENTS, (low_priority_s, math.inf), strict=True):
        with ThreadPoolExecutor(1) as pool:
            done = pool.submit(_run_steps, steps, increment, started + limit_s)
            report(time.monotonic() - started)
            while not wait([done], COMPILING_PERIOD_S).done:
                report(time.monotonic() - started)
            if done.result():
                return


def _run(args: argparse.Namespace) -> int:
    enable_malloc_trim(MMAP_THRESHOLD_B, MALLOC_TRIM_THRESHOLD_B)  # before other threads have heaps of their own
    basics = "fleet.bus.session", "fleet.airframes", "fleet.metrics", "fleet.terrain.areas", "fleet.terrain.raster"
    run_at_low_priority(_import_steps(*basics), LOW_PRIORITY_S)  # here, as --help and --version need none of these
    from fleet.airframes import GENERIC, load
    from fleet.bus.session import connect
    from fleet.contract import FleetState
    from fleet.metrics import serve
    from fleet.terrain.areas import read_areas
    from fleet.terrain.raster import read_raster

    airframe, baselines = load(str(args.airframe or GENERIC)), _load_baselines(args.baseline)
    terrain = read_raster(args.terrain, colours=False) if args.terrain else None
    areas = read_areas(args.areas) if args.areas else ()
    stop = stop_on_signal()
    threading.Thread(target=_force_exit, args=(stop,), daemon=True).start()
    with connect(bus_config_from(args, WORKER)) as bus:

        def report(elapsed_s: float) -> None:  # repeated, for a viewer that starts later
            elapsed = int(elapsed_s // COMPILING_STEP_S * COMPILING_STEP_S)
            since = f" ({elapsed} s so far)" if elapsed else ""
            bus.publish(FleetState(t=0.0, sentence=f"compiling the twins' physics, once per installation{since}"))

        is_compiled = (Path(os.environ["NUMBA_CACHE_DIR"]) / CACHE_COMPLETE).exists()  # else a minute of CPU time
        run_at_low_priority(_preparation(), LOW_PRIORITY_S if is_compiled else 0.0, report)
        from twin_worker.alerts.conflict_probability import Separation
        from twin_worker.mismatch.coordinator import Coordinator
        from twin_worker.mismatch.process import DiagnosisProcess
        from twin_worker.service.work_rates import counters
        from twin_worker.service.worker import Worker

        executor = DiagnosisProcess()
        worker = Worker(
            bus,
            args.uavs,
            omega=args.omega,
            method=args.method,
            airframe=airframe,
            separation=Separation(*args.separation),
            schedule=args.pace,
            use_siblings=args.use_siblings,
            terrain=terrain,
            areas=areas,
            diagnosis=None if args.no_diagnosis else Coordinator(executor, baselines, adapt=not args.no_adapt),
        )
        _tune_runtime()
        report_status(f"twin_worker {bus.writer:016x}", f"serves UAV ids {args.uavs.start}-{args.uavs.stop - 1}")
        with contextlib.ExitStack() as stack:
            stack.callback(executor.close)
            if args.metrics:
                url = stack.enter_context(serve(args.metrics, counters(worker.state, bus)))
                report_status("twin_worker", f"metrics at {url}")
            worker.run(stop)
    return 0


def _run_many(args: argparse.Namespace) -> int:
    """Run several worker processes with the same options; restart failed ones, end all on a usage error.

    Raises:
        ValueError: when `--processes` is out of range; set 1 to 256.
    """
    if not 1 <= args.processes <= 256:
        raise ValueError(f"--processes: found {args.processes}, expected 1 to 256; set one per core")
    options_by_name = {f"worker {k}": [*args.options, "--processes=1"] for k in range(args.processes)}
    if args.metrics:
        from fleet.metrics import parse_address

        host, port = parse_address(args.metrics)
        for k, options in enumerate(options_by_name.values()):
            options.append(f"--metrics={host}:{port + k}")
    stop = stop_on_signal()
    with Children() as children:
        for name, options in options_by_name.items():
            children.start(name, "twin_worker", *options)
        while not stop.wait(_POLL_S):
            failed = children.failures()
            for code, sentence in failed:
                report_progress("twin_worker", sentence)
                if code == 2:
                    return 2
            if failed and not stop.wait(_RESTART_DELAY_S):
                for name in children.failed_names():
                    children.start(name, "twin_worker", *options_by_name[name])
    return 0


def main(argv: list[str] | None = None) -> int:
    """Run the worker until a stop signal."""
    parser = make_parser("twin_worker", "Identify, verify and predict each UAV of a range.", EXAMPLES)
    parser.add_argument("--uavs", type=id_range, default=range(50), metavar="LO-HI", help="UAV ids to serve (0-49)")
    router_arguments(parser)
    methods = ("auto", "dynamics", "hybrid", "paper")
    parser.add_argument(
        "--method",
        choices=methods,
        default=methods[0],
        help="prediction model: derivatives (dynamics), point mass (hybrid), the better (auto), or linear axes (paper)",
    )
    parser.add_argument(
        "--airframe",
        type=airframe_file,
        metavar="NAME|FILE",
        help="airframe data, a TOML file (that of a small fixed wing)",
    )
    parser.add_argument("--omega", type=float, default=0.0, help="minimum mean fit to verify, %% (0, as in the paper)")
    parser.add_argument(
        "--separation",
        type=_parse_separation,
        default=(50.0, 20.0),
        metavar="M,M",
        help="horizontal and vertical separation minima; below both, separation is lost (50,20)",
    )
    parser.add_argument(
        "--baseline",
        action="append",
        type=model_of,
        default=[],
        metavar="[ID=]MODEL",
        help="comparison model from `fleet calibrate` for one aircraft or all (default: its own first 105 s)",
    )
    parser.add_argument(
        "--pace",
        type=parse_schedule,
        default=LIVE_SCHEDULE,
        metavar="WORK=S,…",
        help="shortest periods of rollouts, identifications, ensembles, renewals "
        "(predict=1,identify=1,ensemble=20,renew=1), changes below which rollouts and identifications wait up "
        "to 10 s (departure=0.5,information=0.2; 0: never), size and look-ahead of an ensemble (members=24,span=180)",
    )
    parser.add_argument(
        "--terrain",
        metavar="FILE",
        help="terrain heights for ground alerts and proposals: GeoTIFF, SRTM .hgt, or FILE@south,west,north,east",
    )
    parser.add_argument(
        "--areas",
        type=input_file("a GeoJSON file"),
        metavar="FILE",
        help="GeoJSON polygons for geofence alerts of all aircraft: no-fly areas, or with the property fence=inclusion "
        "areas to stay in; floor_m and ceiling_m above sea level",
    )
    parser.add_argument(
        "--use-siblings", action="store_true", help="first models with what aircraft of their type have learnt"
    )
    parser.add_argument("--no-adapt", action="store_true", help="diagnose, but do not adapt the prediction models")
    parser.add_argument("--no-diagnosis", action="store_true", help="disable the diagnosis")
    parser.add_argument(
        "--processes", type=int, default=1, metavar="N", help="number of worker processes that share the range (1)"
    )
    log_arguments(parser)
    parser.add_argument(
        "--metrics", metavar="HOST:PORT", help="Prometheus metrics; further processes use the following ports"
    )
    args = parser.parse_args(argv)
    args.options = sys.argv[1:] if argv is None else argv
    return run_command("twin_worker", _run if args.processes == 1 else _run_many, args)


if __name__ == "__main__":
    sys.exit(main())
