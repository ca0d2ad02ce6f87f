"""Describe the content of a recording and its use for a twin: table, JSON, page to print."""

from __future__ import annotations  # what reads recordings is imported when it is used: `--help` needs none of it

import argparse
import contextlib
import json
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from rich.console import Console

from fleet.commands.offline.schema import fields_of, parts_of, summary
from fleet.process.children import run_to_end
from fleet.process.file_options import input_file, output_file
from fleet.process.interrupt import interrupt_deferred
from fleet.process.logs import report_progress
from fleet.report.progress import show_progress
from fleet.report.report_text import table
from fleet.telemetry.recording.options import NO_OPTIONS, RecordingOptions, add_recording_arguments

if TYPE_CHECKING:
    from fleet.telemetry.inspection.findings import AircraftFindings, FileFindings, LinkTexts
    from fleet.telemetry.inspection.survey import Survey

EXAMPLES = """
  fleet inspect flight.tlog
  fleet inspect monday/*.tlog.xz --plot monday.pdf     a page for every aircraft
  fleet inspect flight.tlog --json flight.json --plot flight.png
  fleet inspect flight.tlog --twin                     also replay it through a twin
  fleet inspect --keys                                 meaning of the keys of the JSON
"""
PLOTS = (".png", ".svg", ".pdf")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("file", nargs="*", type=input_file(), metavar="FILE", help="recordings, also compressed")
    parser.add_argument(
        "--json", nargs="?", type=_json_file, const="-", metavar="FILE", help="JSON to FILE, or instead of the table"
    )
    parser.add_argument(
        "--plot", type=output_file, metavar="FILE", help="a page for every aircraft: .png, .svg or .pdf"
    )
    parser.add_argument("--twin", action="store_true", help="replay the recording through a twin and report the result")
    parser.add_argument("--offset", type=int, default=0, help="UAV id = MAVLink system id + this (0)")
    add_recording_arguments(parser)
    parser.add_argument("--keys", action="store_true", help="explain every key of the JSON and stop")


def _json_file(text: str) -> str:
    return text if text == "-" else str(output_file(text))


def run(args: argparse.Namespace) -> int:
    """Show every recording; return exit code 1 if anything was skipped, assumed or unusable, 2 for invalid options."""
    from fleet.telemetry.inspection.findings import LinkTexts

    if args.keys:
        print(describe_keys())
        return 0
    _check(args)
    options = RecordingOptions.of(args)
    files: list[FileFindings] = []
    pages: list[tuple[Survey, AircraftFindings, LinkTexts, str]] = []
    console = Console()
    for path in args.file:
        file, surveys, facts = inspect_file(path, args.offset, options)
        if args.twin:
            file = msgspec.structs.replace(file, twin=_run_twin(path, options))
        files.append(file)
        if args.json != "-":
            console.print(table(file))
        if args.plot:
            pairs = zip(surveys.values(), file.aircraft, strict=True)
            pages += [(survey, findings, facts.get(survey.uav, LinkTexts()), path.name) for survey, findings in pairs]
    if args.json:
        _write_json(files, args.json)
    if args.plot and pages:
        from fleet.report.inspection_page import ReportPage, write  # loads matplotlib: not for --help

        for page_file in write(args.plot, [ReportPage(*page) for page in pages]):
            report_progress("fleet inspect", f"wrote {page_file}")
    return 1 if any(file.sentences or not file.aircraft or "sentence" in (file.twin or {}) for file in files) else 0


def describe_keys() -> str:
    """Describe the keys of the JSON."""
    from fleet.telemetry.inspection.findings import FileFindings

    lines = ['{"files": [File, ...]}']
    for part in (FileFindings, *parts_of(FileFindings)):
        lines += ["", f"{part.__name__}: {summary(part)}", *fields_of(part)]
    return "\n".join(lines)


def inspect_file(
    path: Path, offset: int = 0, options: RecordingOptions = NO_OPTIONS
) -> tuple[FileFindings, dict[int, Survey], dict[int, LinkTexts]]:
    """Read one recording; return its findings, with every error as a text, and survey and texts by UAV id."""
    from fleet.telemetry.inspection.findings import FileFindings, LinkTexts, compute_findings
    from fleet.telemetry.inspection.survey import survey_recording
    from fleet.telemetry.recording.recordings import Recording

    surveys: dict[int, Survey] = {}
    facts: dict[int, LinkTexts] = {}
    sentences: list[str] = []
    try:
        recording = Recording(path, offset, options)
        report = partial(report_progress, "fleet inspect")
        with show_progress([recording], report, Console(stderr=True), leave=False):
            surveys = survey_recording((news for _, step in recording.steps() for news in step), recording.kind)
        facts = {uav: LinkTexts(link.firmware, tuple(link.texts)) for uav, link in recording.aircraft.items()}
        sentences += recording.skipped
    except (ValueError, OSError) as error:
        sentences.append(str(error))
    if not surveys and not sentences:
        sentences.append(f"{path.name}: found no aircraft, expected at least one heartbeat of one; check the file")
    aircraft = tuple(compute_findings(known, facts.get(uav, LinkTexts())) for uav, known in surveys.items())
    sentences = [sentence.removeprefix(f"{path.name}: ") for sentence in dict.fromkeys(sentences)]
    file = FileFindings(file=str(path), bytes=_size(path), sentences=tuple(sentences), aircraft=aircraft)
    return file, surveys, facts


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _check(args: argparse.Namespace) -> None:
    """Validate the options before anything is read."""
    if not args.file:
        raise ValueError("FILE: found none, expected at least one recording; name one")
    if args.plot and args.plot.suffix not in PLOTS:
        raise ValueError(f"--plot: found {args.plot.name!r}, expected a name in {' '.join(PLOTS)}; change the suffix")
    for option, name in (("--plot", args.plot), ("--json", args.json)):
        if name and any(path.exists() and Path(name).exists() and path.samefile(name) for path in args.file):
            raise ValueError(f"{option}: found the recording {str(name)!r} itself, expected another file; rename it")


def _run_twin(path: Path, options: RecordingOptions) -> dict[str, Any]:
    """Replay the recording through a twin in a separate process; return results by UAV id, or `sentence`."""
    with _folder() as folder:
        output = folder / "twin.json"
        code, errors = run_to_end(
            "twin_worker.evaluation.replay", str(path), "--json", str(output), *options.arguments()
        )
        try:
            result = json.loads(output.read_text())
        except (OSError, ValueError):
            last = (errors.strip().splitlines() or ["no reason given"])[-1]
            return {"sentence": f"the twin ended with code {code}: {last}"}
    return result if isinstance(result, dict) else {"sentence": "the output of the twin is not a JSON object"}


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    """Create a temporary folder and remove it at the end, also after Ctrl-C during either."""
    with interrupt_deferred():
        folder = tempfile.TemporaryDirectory()
    try:
        yield Path(folder.name)
    finally:
        with interrupt_deferred():
            folder.cleanup()


def _write_json(files: list[FileFindings], name: str) -> None:
    text = json.dumps({"files": msgspec.to_builtins(files)}, indent=1) + "\n"
    if name == "-":
        sys.stdout.write(text)
    else:
        with interrupt_deferred():  # an incomplete file could be taken for a complete one
            Path(name).write_text(text)
