"""Replay recordings into a running fleet as live telemetry."""

import argparse
import threading
from dataclasses import asdict
from functools import partial
from pathlib import Path
from urllib.parse import quote

from fleet.cli import stop_on_signal
from fleet.config import router_arguments, router_options
from fleet.process.children import run_until
from fleet.process.file_options import check_file
from fleet.process.logs import report_progress
from fleet.report.progress import show_progress
from fleet.telemetry.recording.ids import MAX_PER_LINK, IdAllocator
from fleet.telemetry.recording.opening import read_speed
from fleet.telemetry.recording.options import RecordingOptions, add_recording_arguments

EXAMPLES = """
  fleet replay flight.tlog
  fleet replay flight.tlog.xz log7.bin --speed 4
  fleet replay one.tlog two.ulg --speed max --router tcp/127.0.0.1:7447
  fleet replay monday.parauav --results                        recorded results, not new ones
  fleet replay flight.tlog --copies 50                         fifty aircraft, 500 m apart
  fleet replay flight.tlog --copies 50 --to 127.0.0.1:14550    the same as MAVLink over UDP
  fleet replay flight.tlog --copies 500 --to 127.0.0.1:14550 --to 127.0.0.1:14551    250 aircraft a link
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `fleet replay`."""
    parser.add_argument("file", nargs="+", metavar="FILE", help="recordings of any kind, also compressed")
    parser.add_argument("--speed", default="1", metavar="N|max", help="factor of real time, or max (1)")
    parser.add_argument("--copies", type=int, default=1, metavar="N", help="aircraft for each recorded one (1)")
    parser.add_argument(
        "--results", action="store_true", help="replay also the recorded models, predictions and alerts"
    )
    parser.add_argument(
        "--to",
        action="append",
        metavar="HOST:PORT",
        help="send a .tlog as MAVLink over UDP to this address of this machine; "
        f"repeatable: the copies are distributed, at most {MAX_PER_LINK} aircraft each",
    )
    parser.add_argument("--offset", type=int, default=0, help="UAV id = MAVLink system id + this (0)")
    add_recording_arguments(parser)
    router_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Start a gateway that replays the files and return its exit code; or send the files as datagrams."""
    check_arguments(args)
    for name in args.file:
        check_file("FILE", name)
    if args.to:
        return _send(args)
    options = [f"--link={replay_link(name, args)}" for name in args.file]
    options += [*router_options(args), f"--offset={args.offset}", "--listen-only"]
    return run_until(stop_on_signal(), "gateway", *options)


def _send(args: argparse.Namespace) -> int:
    """Send every file in a thread of its own; return exit code 1 if one was not sent completely."""
    from fleet.telemetry.replay.broadcaster import Broadcaster, loopback_address, share_out

    broadcasts, destinations = [], []
    for destination, numbers in zip(map(loopback_address, args.to), share_out(args.copies, len(args.to)), strict=True):
        ids = IdAllocator(1, MAX_PER_LINK)
        for name in args.file if numbers else ():
            broadcasts.append(Broadcaster(Path(name), read_speed(args.speed, "--speed"), numbers, args.copies, ids))
            destinations.append(destination)
    stop = stop_on_signal()
    pairs = zip(broadcasts, destinations, strict=True)
    threads = [
        threading.Thread(target=broadcast.send, args=(destination, stop), name=broadcast.name)
        for broadcast, destination in pairs
    ]
    with show_progress(broadcasts, partial(report_progress, "fleet replay")):
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    for broadcast in broadcasts:
        report_progress("fleet replay", broadcast.problem or f"{broadcast.name}: {broadcast.progress_text()}")
    return 1 if any(broadcast.problem for broadcast in broadcasts) else 0


def check_arguments(args: argparse.Namespace) -> None:
    """Validate the options before anything is opened.

    Raises:
        ValueError: when an option is invalid; the text names it.
    """
    read_speed(args.speed, "--speed")
    if getattr(args, "to", None) and RecordingOptions.of(args).arguments():
        raise ValueError("--to: found --mission, --params or --columns too, expected none of them; drop them")
    if not 1 <= args.copies <= 10_000:
        raise ValueError(f"--copies: found {args.copies}, expected 1 to 10,000; change it")
    if args.results and args.copies > 1:
        raise ValueError("--results: found --copies too, expected only one; recorded results have no copies, drop one")


def replay_link(name: str, args: argparse.Namespace) -> str:
    """Return the gateway's `--link` for one recording, from its name and --speed, --copies and --results."""
    path = quote(str(Path(name).resolve()), safe="/ ")
    options = {name: value for name, value in asdict(RecordingOptions.of(args)).items() if value}
    extra = "".join(f"&{name}={quote(value, safe='/')}" for name, value in _absolute(options).items())
    return f"replay:{path}?speed={args.speed}&copies={args.copies}&results={int(args.results)}{extra}"


def _absolute(options: dict[str, str]) -> dict[str, str]:
    """Return the options with absolute paths; the name of a shipped column map is no path."""
    return {name: str(Path(value).resolve()) if Path(value).exists() else value for name, value in options.items()}
