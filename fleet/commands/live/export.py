"""Export positions, predictions, regions and alerts as GeoJSON, KML, MCAP or Rerun, live or from a recording.

The ending of FILE selects the format. GeoJSON and KML contain the flown path and the newest prediction of each
aircraft: the path up to its confidence horizon, the path beyond it, ellipses of the prediction region, and the active
alerts. MCAP contains every message on its time, with Foxglove schemas (LocationFix, GeoJSON, SceneUpdate, Log); a
Rerun recording (.rrd) has the same and needs the package rerun-sdk (extra `rerun`).
"""

import argparse
import math
import os
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

from fleet.bus.session import connect
from fleet.cli import id_range, stop_on_signal
from fleet.config import bus_config_from, router_arguments
from fleet.contract import Message
from fleet.export.features import MapFeature, summarise
from fleet.export.map_files import geojson_text, kml_text
from fleet.export.mcap_file import McapExport
from fleet.export.message_source import LiveSource, only, recorded_messages
from fleet.export.rerun_file import RerunExport, check_rerun
from fleet.process.file_options import input_file, output_file
from fleet.process.logs import report_progress
from fleet.telemetry.recording.fleet_news import BusMessageReader
from fleet.telemetry.recording.opening import COMPRESSED, RecordingFile

EXAMPLES = """
  fleet export now.geojson                              5 s of a running fleet
  fleet export monday.mcap --for 0                      until Ctrl-C
  fleet export monday.kml --from monday.parauav         a recording of `fleet record`
  fleet export seven.geojson --uavs 7 --overwrite
"""
FORMATS = (".geojson", ".kml", ".mcap", ".rrd")
SECONDS = 5.0  # default duration of a live export: every aircraft predicts at least once [s]
_RECORDING = ".parauav"


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("file", type=output_file, metavar="FILE", help=f"file to write, {', '.join(FORMATS)}")
    parser.add_argument(
        "--from", dest="source", type=input_file(), metavar="RECORDING", help="read a .parauav recording"
    )
    parser.add_argument(
        "--for",
        dest="seconds",
        type=float,
        metavar="S",
        help=f"duration of a live export, 0: until Ctrl-C ({SECONDS:g})",
    )
    parser.add_argument("--uavs", type=id_range, metavar="LO-HI", help="ids of the exported aircraft (all)")
    parser.add_argument("--overwrite", action="store_true", help="replace FILE where it exists")
    router_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Write the file; return exit code 1 if no aircraft has a position, a prediction or an alert."""
    check_arguments(args)
    with ExitStack() as stack:
        reader, live = None, None
        if args.source is not None:
            reader = BusMessageReader(RecordingFile(args.source))
            messages = recorded_messages(reader)
        else:
            stop = stop_on_signal()
            live = LiveSource(stack.enter_context(connect(bus_config_from(args))))
            messages = _with_progress(live, stop, SECONDS if args.seconds is None else args.seconds)
        if args.uavs is not None:
            messages = only(messages, args.uavs.__contains__)
        content = _write(args.file, messages)
    problems = list(reader.skipped) if reader is not None else []
    problems += [f"{live.dropped} messages dropped, the disk was too slow"] if live is not None and live.dropped else []
    for problem in problems:
        report_progress("fleet export", problem)
    if not content:
        where = f"in {args.source.name}" if args.source is not None else "on the bus: is a gateway running?"
        report_progress("fleet export", f"no aircraft {where}; {args.file} is empty")
        return 1
    listed = ", ".join(f"{count:,} {name.replace('_', ' ')}" for name, count in content.most_common())
    report_progress("fleet export", f"{args.file}: {listed}, {args.file.stat().st_size / 1e6:.1f} MB")
    return 0


def check_arguments(args: argparse.Namespace) -> None:
    """Validate the options before anything is opened.

    Raises:
        ValueError: when an option is invalid; the text names it.
    """
    if args.file.suffix.lower() not in FORMATS:
        raise ValueError(
            f"FILE: found {args.file.name!r}, expected a name that ends in {', '.join(FORMATS)}; rename it"
        )
    if args.file.suffix.lower() == ".rrd":
        check_rerun()
    if args.file.exists() and not args.overwrite:
        raise ValueError(
            f"FILE: found an existing file {str(args.file)!r}, expected a new name; choose one, or add --overwrite"
        )
    if args.seconds is not None and not 0 <= args.seconds < math.inf:
        raise ValueError(f"--for: found {args.seconds:g} s, expected 0 (until Ctrl-C) or more; change it")
    if args.source is None:
        return
    if args.seconds is not None:
        raise ValueError("--for: found --from too, expected only one; a recording is exported as a whole, drop --for")
    if (
        Path(args.source.name.removesuffix(next(filter(args.source.name.endswith, COMPRESSED), ""))).suffix
        != _RECORDING
    ):
        raise ValueError(
            f"--from: found {args.source.name!r}, expected a {_RECORDING} recording; others have no predictions, "
            "use `fleet up --replay` and `fleet record` first"
        )


def _with_progress(live: LiveSource, stop: threading.Event, seconds: float) -> Iterator[Message]:
    report_progress("fleet export", f"collecting {f'for {seconds:g} s' if seconds else 'until Ctrl-C'}")
    return live.messages(stop, seconds)


def _write(path: Path, messages: Iterator[Message]) -> Counter[str]:
    """Write a temporary file beside the file and rename it when it is complete; return what was written."""
    temporary = path.with_name(f".{path.name}.part")
    try:
        counts = _write_content(temporary, messages, path.suffix.lower())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return counts


def _write_content(path: Path, messages: Iterator[Message], suffix: str) -> Counter[str]:
    """Write a file in the format of `suffix`."""
    if suffix == ".rrd":
        return _copy(messages, RerunExport(path))
    with path.open("wb") as file:
        if suffix == ".mcap":
            return _copy(messages, McapExport(file))
        flights = summarise(messages)
        features: list[MapFeature] = [feature for uav in sorted(flights) for feature in flights[uav].features()]
        file.write((kml_text(features) if suffix == ".kml" else geojson_text(features)).encode())
        return Counter(feature.kind for feature in features)


def _copy(messages: Iterator[Message], export: McapExport | RerunExport) -> Counter[str]:
    """Write every message and complete the file."""
    with export:
        for message in messages:
            export.add(message)
    return export.counts
