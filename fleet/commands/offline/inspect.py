"""Describe the content of a recording and its use for a twin: table, JSON, page to print."""

import argparse
import contextlib
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from rich.console import Console

from fleet.commands.offline.schema import fields_of, parts_of, summary
from fleet.process.children import run_to_end
from fleet.process.interrupt import deferred
from fleet.process.logs import tell
from fleet.report.progress import shown
from fleet.report.report_text import table
from fleet.telemetry.inspection.findings import Facts, File, Findings, findings
from fleet.telemetry.inspection.survey import Survey, survey
from fleet.telemetry.recording.recordings import Recording

EXAMPLES = """
  fleet inspect flight.tlog
  fleet inspect monday/*.tlog.xz --plot monday.pdf     a page for every aircraft
  fleet inspect flight.tlog --json flight.json --plot flight.png
  fleet inspect flight.tlog --twin                     also replay it through a twin
  fleet inspect --keys                                 meaning of the keys of the JSON
"""
PLOTS = (".png", ".svg", ".pdf")


class Heard(NamedTuple):
    """Result of reading one recording."""

    file: File
    surveys: dict[int, Survey]
    facts: dict[int, Facts]


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("file", nargs="*", type=Path, metavar="FILE", help="recordings, also compressed")
    parser.add_argument("--json", nargs="?", const="-", metavar="FILE", help="JSON to FILE, or instead of the table")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="a page for every aircraft: .png, .svg or .pdf")
    parser.add_argument("--twin", action="store_true", help="replay the recording through a twin and report the result")
    parser.add_argument("--offset", type=int, default=0, help="UAV id = MAVLink system id + this (0)")
    parser.add_argument("--keys", action="store_true", help="explain every key of the JSON and stop")


def run(args: argparse.Namespace) -> int:
    """Show every recording; return exit code 1 if anything was skipped, assumed or unusable, 2 for invalid options."""
    if args.keys:
        print(keys())
        return 0
    _check(args)
    told: list[File] = []
    sheets: list[tuple[Survey, Findings, Facts, str]] = []
    console = Console()
    for path in args.file:
        heard = read(path, args.offset)
        file = msgspec.structs.replace(heard.file, twin=_twin(path)) if args.twin else heard.file
        told.append(file)
        if args.json != "-":
            console.print(table(file))
        if args.plot:
            known = heard.surveys.values()
            sheets += [
                (k, t, heard.facts.get(k.uav, Facts()), path.name) for k, t in zip(known, file.aircraft, strict=True)
            ]
    if args.json:
        _write_json(told, args.json)
    if args.plot and sheets:
        from fleet.report.inspection_page import Sheet, write  # loads matplotlib: not for --help

        for made in write(args.plot, [Sheet(*sheet) for sheet in sheets]):
            tell("fleet inspect", f"wrote {made}")
    return 1 if any(file.sentences or not file.aircraft or "sentence" in (file.twin or {}) for file in told) else 0


def keys() -> str:
    """Describe the keys of the JSON."""
    lines = ['{"files": [File, ...]}']
    for part in (File, *parts_of(File)):
        lines += ["", f"{part.__name__}: {summary(part)}", *fields_of(part)]
    return "\n".join(lines)


def read(path: Path, offset: int = 0) -> Heard:
    """Read one recording; report every error in it as a text."""
    surveys: dict[int, Survey] = {}
    facts: dict[int, Facts] = {}
    said: list[str] = []
    try:
        recording = Recording(path, offset)
        with shown([recording], _say, Console(stderr=True), leave=False):
            surveys = survey((news for _, step in recording.steps() for news in step), recording.kind)
        facts = {uav: Facts(craft.firmware, tuple(craft.texts)) for uav, craft in recording.crafts.items()}
        said += recording.skipped
    except (ValueError, OSError) as error:
        said.append(str(error))
    if not surveys and not said:
        said.append(f"{path.name}: found no aircraft, expected at least one heartbeat of one; check the file")
    aircraft = tuple(findings(known, facts.get(uav, Facts())) for uav, known in surveys.items())
    said = [sentence.removeprefix(f"{path.name}: ") for sentence in dict.fromkeys(said)]
    return Heard(File(file=str(path), bytes=_size(path), sentences=tuple(said), aircraft=aircraft), surveys, facts)


def _say(line: str) -> None:
    tell("fleet inspect", line)


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _check(args: argparse.Namespace) -> None:
    """Validate the options before anything is read.

    Raises:
        ValueError: when an option is invalid; the text names it.
    """
    if not args.file:
        raise ValueError("FILE: found none, expected at least one recording; name one")
    for path in args.file:
        if not path.is_file():
            raise ValueError(f"FILE: found no recording {str(path)!r}, expected a file; check the path")
    if args.plot and args.plot.suffix not in PLOTS:
        raise ValueError(f"--plot: found {args.plot.name!r}, expected a name in {' '.join(PLOTS)}; change the suffix")
    for option, name in (("--plot", args.plot), ("--json", args.json)):
        if name and not Path(name).absolute().parent.is_dir():
            raise ValueError(f"{option}: found no folder {str(Path(name).parent)!r}, expected one; create it first")
        if name and any(path.exists() and Path(name).exists() and path.samefile(name) for path in args.file):
            raise ValueError(f"{option}: found the recording {str(name)!r} itself, expected another file; rename it")


def _twin(path: Path) -> dict[str, Any]:
    """Replay the recording through a twin in a separate process; return results by UAV id, or `sentence`."""
    with _folder() as folder:
        answer = folder / "twin.json"
        code, errors = run_to_end("twin_worker.evaluation.replay", str(path), "--json", str(answer))
        try:
            told = json.loads(answer.read_text())
        except (OSError, ValueError):
            last = (errors.strip().splitlines() or ["no reason given"])[-1]
            return {"sentence": f"the twin ended with code {code}: {last}"}
    return told if isinstance(told, dict) else {"sentence": "the output of the twin is not a JSON object"}


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    """Create a temporary folder and remove it at the end, also after Ctrl-C during either."""
    with deferred():
        folder = tempfile.TemporaryDirectory()
    try:
        yield Path(folder.name)
    finally:
        with deferred():
            folder.cleanup()


def _write_json(told: list[File], name: str) -> None:
    text = json.dumps({"files": msgspec.to_builtins(told)}, indent=1) + "\n"
    if name == "-":
        sys.stdout.write(text)
    else:
        with deferred():  # an incomplete file could be taken for a complete one
            Path(name).write_text(text)
