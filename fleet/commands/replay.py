"""Play recordings into a running fleet, as if they were flown now."""

import argparse
import subprocess
import sys

from fleet.bus import ROUTER
from fleet.cli import stop_on_signal

EXAMPLES = """
  fleet replay flight.tlog
  fleet replay flight.tlog.xz --speed 4
  fleet replay one.tlog two.tlog --speed max --router tcp/127.0.0.1:7447
"""
_PATIENCE_S = 10.0


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `fleet replay`."""
    parser.add_argument("file", nargs="+", metavar="FILE", help="telemetry log: .tlog or .tlog.xz")
    parser.add_argument("--speed", default="1", metavar="N|max", help="times real time, or max (1)")
    parser.add_argument("--offset", type=int, default=0, help="UAV id = MAVLink system id + this (0)")
    parser.add_argument("--router", default=ROUTER, help=f"where the bus is ({ROUTER})")


def run(args: argparse.Namespace) -> int:
    """Start a gateway that plays the files; its exit code is ours."""
    command = [sys.executable, "-m", "gateway", "--router", args.router, f"--offset={args.offset}", "--listen-only"]
    for name in args.file:
        command += ["--link", f"replay:{name}?speed={args.speed}"]
    stop = stop_on_signal()
    child = subprocess.Popen(command)
    try:
        while child.poll() is None and not stop.wait(0.2):
            pass
    finally:
        if child.poll() is None:
            child.terminate()
    code = child.wait(_PATIENCE_S)
    return code if code >= 0 else 128 - code
