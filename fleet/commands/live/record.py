"""Record all messages of a running fleet into a file for `fleet replay`."""

import argparse
import math
import threading
import time
from collections import Counter
from functools import partial
from pathlib import Path
from typing import IO, Any

from rich.console import Console
from rich.live import Live
from rich.text import Text

from fleet.bus.codec import Stamp, encode, encoding
from fleet.bus.session import Bus, connect
from fleet.cli import stop_on_signal
from fleet.config import bus_config_from, router_arguments
from fleet.contract import TOPICS, Sample, Samples
from fleet.process.file_options import output_file
from fleet.process.logs import report_progress
from fleet.telemetry.recording.fleet_log import BusRecord

EXAMPLES = """
  fleet record monday.parauav                  until Ctrl-C
  fleet record monday.parauav --for 600
  fleet record monday.parauav --overwrite --router tcp/192.168.1.10:7447
"""
SUFFIX = ".parauav"
MAX_BUFFER_BYTES = 64 << 20  # bytes waiting for the disk; beyond, messages are dropped and counted
WRITE_S = 0.25  # between two writes: maximum loss in a crash [s]
_LOG_PERIOD_S = 10.0  # between progress lines where the output is not a terminal [s]


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("file", type=output_file, metavar="FILE", help=f"recording to write, {SUFFIX}")
    parser.add_argument("--for", dest="seconds", type=float, default=0.0, metavar="S", help="duration (until Ctrl-C)")
    parser.add_argument("--overwrite", action="store_true", help="replace FILE where it exists")
    router_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Record until stopped; return exit code 1 if messages were dropped."""
    _check(args)
    stop = stop_on_signal()
    with connect(bus_config_from(args)) as bus, _open_file(args.file, args.overwrite) as file:
        recorder = BusRecorder(bus, file)
        recorder.subscribe()
        _record(recorder, args, stop)
    report_progress("fleet record", f"{recorder.summary()}; {args.file} is complete")
    if recorder.dropped:
        report_progress("fleet record", f"{recorder.dropped} messages dropped, the disk was too slow")
    return 1 if recorder.dropped else 0


def _check(args: argparse.Namespace) -> None:
    """Validate the options before anything is opened."""
    if not 0 <= args.seconds < math.inf:
        raise ValueError(f"--for: found {args.seconds} s, expected 0 (until Ctrl-C) or more; change it")
    if args.file.suffix != SUFFIX:
        raise ValueError(f"FILE: found {args.file.name!r}, expected a name that ends in {SUFFIX}; rename it")
    if args.file.exists() and not args.overwrite:
        raise ValueError(_exists(args.file))


def _exists(path: Path) -> str:
    return f"FILE: found an existing file {str(path)!r}, expected a new name; choose one, or add --overwrite"


def _open_file(path: Path, overwrite: bool) -> IO[bytes]:
    try:
        return path.open("wb" if overwrite else "xb", buffering=0)
    except FileExistsError:
        raise ValueError(_exists(path)) from None
    except OSError as error:
        raise OSError(f"FILE: {str(path)!r} cannot be written ({error.strerror}); choose another place") from None


class BusRecorder:
    """Pack received messages on threads of the bus, write them on the caller's thread.

    Args:
        bus: source of the messages
        file: unbuffered
    """

    def __init__(self, bus: Bus, file: IO[bytes]) -> None:
        self.dropped = 0
        self.counts: Counter[str] = Counter()  # messages written, by topic
        self.size = 0  # bytes written
        self._started = time.monotonic()
        self._clock_offset = time.time() - self._started  # independent of later changes of the system clock
        self._bus, self._file = bus, file
        self._lock = threading.Lock()
        self._buffer = bytearray()
        self._buffer_counts: Counter[str] = Counter()

    def subscribe(self) -> None:
        """Query rarely published messages, so that a recording started in flight has the missions; then subscribe."""
        recorded = [kind for kind in TOPICS.values() if kind is not Samples]  # batches are recorded as samples
        for kind in recorded:
            if kind is not Sample:
                replies: list[tuple[Any, Stamp | None]] = self._bus.get(kind)
                for message, stamp in replies:
                    self._on_message(kind, encode(message), encoding(kind), stamp)
        for kind in recorded:
            self._bus.subscribe_raw(kind, partial(self._on_message, kind))

    def _on_message(self, kind: type, payload: bytes, encoding_name: str, stamp: Stamp | None) -> None:
        packed = BusRecord(self._clock_offset + time.monotonic(), encoding_name, payload, stamp).pack()
        with self._lock:
            if len(self._buffer) + len(packed) > MAX_BUFFER_BYTES:
                self.dropped += 1
            else:
                self._buffer += packed
                self._buffer_counts[kind.topic] += 1  # type: ignore[attr-defined]

    def write(self) -> None:
        """Write the buffered messages.

        Raises:
            OSError: when the disk is full or removed; the file is valid up to its last complete record.
        """
        with self._lock:
            data, self._buffer = self._buffer, bytearray()
            counts, self._buffer_counts = self._buffer_counts, Counter()
        unwritten = memoryview(data)
        while unwritten:
            unwritten = unwritten[self._file.write(unwritten) :]
        self.size += len(data)
        self.counts += counts

    @property
    def seconds(self) -> float:
        """Return the duration of the recording [s]."""
        return time.monotonic() - self._started

    def summary(self) -> str:
        """Describe the recorded amount."""
        by_topic = ", ".join(f"{n:,} {topic.lstrip('@')}" for topic, n in self.counts.most_common())
        totals = f"{self.seconds:.0f} s, {self.counts.total():,} messages, {self.size / 1e6:.1f} MB"
        return f"{totals} ({by_topic or 'no messages yet: is a gateway running?'})"


def _record(recorder: BusRecorder, args: argparse.Namespace, stop: threading.Event) -> None:
    """Write and show progress until stopped or the duration has elapsed."""
    console = Console(stderr=True)
    due = _LOG_PERIOD_S
    with Live(console=console, auto_refresh=False, transient=True) as live:
        ended = False
        while not ended:
            remaining = args.seconds - recorder.seconds if args.seconds else WRITE_S
            ended = stop.wait(max(0.0, min(remaining, WRITE_S))) or (args.seconds and recorder.seconds >= args.seconds)
            recorder.write()
            if console.is_terminal:
                live.update(Text(f"recording {args.file.name}: {recorder.summary()}"), refresh=True)
            elif recorder.seconds >= due and not ended:
                due += _LOG_PERIOD_S
                report_progress("fleet record", recorder.summary())
