"""Repeat the experiments of the paper: fly simulated aircraft, identify or predict them, draw the figures.

`identify` flies the mission of the paper's figure 6, by default in calm air; `predict` random missions in wind.
"""

import argparse
import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

from fleet.cli import id_range, stop_on_signal
from fleet.process.children import run_until
from fleet.process.file_options import input_file, output_file, output_folder
from fleet.process.interrupt import INTERRUPTED
from fleet.process.logs import report_progress
from fleet.telemetry.recording.options import RecordingOptions, add_recording_arguments

if TYPE_CHECKING:
    from fleet.contract import Item
    from fleet.simulator.vehicle.missions import StartState

EXAMPLES = """
  fleet paper identify --out figures --json paper.json            the paper's mission in calm air
  fleet paper identify --wind 3 --turbulence 1 --out windy        the same mission in wind
  fleet paper identify --uavs 0-1 --for 180 --first pbsid
  fleet paper identify flight.tlog.xz          on recordings instead of simulated flights
  fleet paper predict --out figures --jobs 2   60 s ahead from every start, with the paper's method and the twin's
"""
_UAVS = range(16)
_AIR = {"identify": (0.0, "none"), "predict": (3.0, "1")}  # mean wind [m/s] and turbulence
_MIN_SECONDS = {
    "identify": (70, "20 + 40 + 4 s and some starts"),
    "predict": (200, "120 + 60 s and some starts"),
}  # flown time [s]
_STARTS, _EVERY_S = 20, 5.0  # predictions in the paper; interval between our starts [s]
_COMPARED_METHODS = "paper,route_wind"  # methods compared with the twin's
_LOSS = 0.01  # share of frames lost in transit [-]


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("experiment", choices=tuple(_AIR), help="identify: figures 7 and 8; predict: figure 9")
    parser.add_argument(
        "file", nargs="*", type=input_file(), metavar="FILE", help="recordings (none: fly simulated aircraft)"
    )
    parser.add_argument("--uavs", type=id_range, metavar="A-B", help="aircraft to fly (0-15)")
    parser.add_argument("--seed", type=int, default=5, help="random seed of aircraft, missions, weather and noise (5)")
    parser.add_argument("--for", dest="seconds", type=float, default=300.0, metavar="S", help="flight time (300)")
    parser.add_argument("--wind", type=float, metavar="M/S", help="mean wind at 100 m (identify: 0, predict: 3)")
    parser.add_argument(
        "--turbulence", metavar="LEVEL", help="MIL-F-8785C: none, light … or 0..7 (identify: none, predict: 1)"
    )
    parser.add_argument(
        "--first", choices=("projection", "pbsid", "both"), default="both", help="first step: the paper's, PBSID (both)"
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes that share the predictions (1)")
    parser.add_argument("--out", type=output_folder, metavar="DIR", help="draw the figures into DIR")
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write the numbers to FILE")
    add_recording_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Fly simulated aircraft if no recording is given, then start the experiment and return its exit code.

    Raises:
        ValueError: when an option is invalid; the text names it.
    """
    min_s, reason = _MIN_SECONDS[args.experiment]
    if not min_s <= args.seconds <= 3600:
        raise ValueError(f"--for: found {args.seconds:.0f} s, expected {min_s}..3600 ({reason} at least); change --for")
    args.uavs = args.uavs or _UAVS
    wind, turbulence = _AIR[args.experiment]
    args.wind = wind if args.wind is None else args.wind
    args.turbulence = args.turbulence or turbulence
    starts = int((args.seconds - 180) / _EVERY_S) * len(args.uavs)
    if args.experiment == "predict" and not args.file and starts < _STARTS:
        raise ValueError(
            f"--for: found time for {starts} starts, expected {_STARTS} as in the paper; raise --for or --uavs"
        )
    stop = stop_on_signal()
    with _recordings(args, stop) as files:
        return INTERRUPTED if stop.is_set() else _evaluate(args, files, stop)


@contextlib.contextmanager
def _recordings(args: argparse.Namespace, stop: Event) -> Iterator[list[Path]]:
    """Yield the given recordings, or fly one into a temporary folder."""
    if args.file:
        yield args.file
        return
    with tempfile.TemporaryDirectory(prefix="fleet-paper-") as folder:
        path = Path(folder) / "flight.tlog"
        _fly(args, path, stop)
        yield [path]


def _fly(args: argparse.Namespace, path: Path, stop: Event) -> None:
    from fleet.simulator.flight import drive  # loads JSBSim and the compiler: not for --help
    from fleet.simulator.flight.uav import SimulatedUav
    from fleet.simulator.vehicle.weather import turbulence_level

    level = turbulence_level(args.turbulence)
    uavs = [
        SimulatedUav(i, args.seed, wind=args.wind, turbulence=level, plan=_plan(args.experiment, args.seed, i))
        for i in args.uavs
    ]
    title = f"flying {len(uavs)} aircraft"
    drive.to_tlog(path, uavs, seconds=args.seconds, loss=_LOSS, seed=args.seed, title=title, stop=stop)


def _plan(experiment: str, seed: int, uav_id: int) -> "tuple[tuple[Item, ...], StartState] | None":
    """Return the mission of one aircraft: that of the paper to identify; None, a random one, to predict."""
    import numpy as np

    from fleet.simulator.vehicle.missions import paper_mission

    if experiment != "identify":
        return None
    return paper_mission(int(np.random.SeedSequence((seed, uav_id)).generate_state(1)[0]))


def _evaluate(args: argparse.Namespace, files: list[Path], stop: Event) -> int:
    """Identify with the paper's two steps, or predict with its method and the twin's."""
    options = [f"--{name}={value}" for name, value in (("out", args.out), ("json", args.json)) if value]
    if args.experiment == "identify":
        calm = args.wind == 0 and args.turbulence in ("0", "none")
        air = "calm air" if calm else f"wind {args.wind:g} m/s, turbulence {args.turbulence}"
        command = ["twin_worker.paper_experiments", args.experiment, f"--first={args.first}"]
        command.append(f"--air={'as recorded' if args.file else air}")
    else:
        command = ["twin_worker.evaluation", f"--methods={_COMPARED_METHODS}", f"--every={_EVERY_S}"]
        command.append(f"--jobs={args.jobs}")
    options += RecordingOptions.of(args).arguments()
    code = run_until(stop, *command, *options, *map(str, files))
    if stop.is_set():
        report_progress("paper", "stopped; unfinished results are not written")
        return INTERRUPTED
    return code
