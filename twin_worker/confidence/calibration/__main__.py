"""`python -m twin_worker.confidence.calibration fit|check FILE…`: fit and evaluate calibration tables.

`fit` writes a table for every group and parent group, and prints their cross-validated coverage and horizons (folds are
flights, or settings of law, airframe and parameters where a table spans several). `check` prints coverage and horizons
of tables on other predictions, with and without adaptation.
"""

import argparse
import sys
from dataclasses import replace
from datetime import date
from pathlib import Path

from fleet.cli import make_parser, run_command
from twin_worker.confidence.calibration.evaluate_table import (
    figures,
    regions_adapted,
    regions_cross_fitted,
    regions_of_table,
    report_text,
)
from twin_worker.confidence.calibration.fit_table import fit
from twin_worker.confidence.calibration.scored_predictions import ScoredPredictions, read
from twin_worker.confidence.calibration_table import CalibrationTable
from twin_worker.confidence.table_files import ANY, TableSource, group_chain, load, read_tables, write

MIN_STARTS, MIN_FLIGHTS = 30, 3  # minimum for a table
SUFFICIENT_FLIGHTS = 8  # with fewer, differences between methods of one family are not significant

EXAMPLES = """
  python -m twin_worker.confidence.calibration fit predictions.npz --out twin_worker/confidence/calibration/pretend.json
  python -m twin_worker.confidence.calibration check other.npz --with pretend.json
"""


def _fit(args: argparse.Namespace) -> int:
    scored = read(args.files)
    names = set(scored.group.tolist())
    fitted: dict[
        bytes, CalibrationTable
    ] = {}  # by selected rows: a parent group with the same predictions has the same table
    tables = []
    groups = dict.fromkeys(name for member in sorted(names) for name in group_chain(member))
    for group in groups if args.only is None else [name for name in groups if name in args.only]:
        rows = scored.in_group(group)
        subset = scored.select(rows)
        if reason := _rejection_reason(scored, group):
            print(f"{group}: no table from {len(subset)} predictions, {reason}")
            continue
        same_rows = fitted.get(rows.tobytes())
        table = replace(same_rows, group=group) if same_rows else _fit_and_report(subset, group)
        fitted[rows.tobytes()] = table
        tables.append(table)
    if not tables:
        raise ValueError(f"calibration: found no group of {MIN_STARTS} predictions; give more flights")
    only = [] if args.only is None else ["--only", *args.only]
    command = " ".join(["python -m twin_worker.confidence.calibration fit", *map(_short_name, args.files), *only])
    write(args.out, tables, [_source(path) for path in args.files], date.today().isoformat(), command)
    print(f"{args.out.name}: {len(tables)} tables")
    return 0


def _rejection_reason(scored: ScoredPredictions, group: str) -> str:
    """Return the reason why a group is too small for its own table; empty if it is not."""
    flights = _flight_count(scored, group)
    if scored.in_group(group).sum() < MIN_STARTS or flights < MIN_FLIGHTS:
        return f"{flights} flights; {MIN_STARTS} of {MIN_FLIGHTS} are needed"
    chain = list(group_chain(group))
    if ANY not in group and flights < SUFFICIENT_FLIGHTS and _flight_count(scored, chain[1]) > flights:
        return f"{flights} flights; with those of {chain[1]} there are more"
    return ""


def _flight_count(scored: ScoredPredictions, group: str) -> int:
    return len(set(scored.flight[scored.in_group(group)].tolist()))


def _fit_and_report(predictions: ScoredPredictions, group: str) -> CalibrationTable:
    table = fit(predictions, group)
    measured = figures(predictions, regions_cross_fitted(predictions, group))
    unit = "settings" if predictions.spans_settings(group) else "flights"
    heading = f"{group}: {table.starts} predictions of {table.flights} flights; {unit} left out"
    print(report_text(heading, measured), flush=True)
    return replace(table, held_out=measured)


def _short_name(path: Path) -> str:
    """Return a file name with its folder, because the files of all flights have the same name."""
    return f"{path.absolute().parent.name}/{path.name}"


def _source(path: Path) -> TableSource:
    scored = read([path])
    return TableSource(_short_name(path), len(scored), tuple(sorted(set(scored.flight.tolist()))))


def _check(args: argparse.Namespace) -> int:
    scored = read(args.files)
    tables = read_tables(args.tables) if args.tables else load()
    for group in sorted(set(scored.group.tolist())):
        subset = scored.select(scored.group == group)
        table, description = tables.choose(group)
        print(f"{group}: {len(subset)} predictions of {len(set(subset.flight.tolist()))} flights; {description}")
        print(report_text("  table alone", figures(subset, regions_of_table(table, subset))))
        print(report_text("  adapted in flight", figures(subset, regions_adapted(tables, subset))), flush=True)
    return 0


def main(argv: list[str] | None = None) -> int:
    """Run the command line: fit or check calibration tables."""
    parser = make_parser("python -m twin_worker.confidence.calibration", "Fit or check calibration tables.", EXAMPLES)
    subparsers = parser.add_subparsers(dest="verb", required=True, metavar="fit|check")
    for action, description in (("fit", "fit tables"), ("check", "evaluate tables on other predictions")):
        subparser = subparsers.add_parser(action, help=description)
        subparser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="scored predictions, .npz")
        if action == "fit":
            subparser.add_argument("--out", type=Path, required=True, metavar="FILE", help="tables to write, .json")
            subparser.add_argument(
                "--only", nargs="+", metavar="GROUP", help="groups to write (all, and those they belong to)"
            )
        else:
            subparser.add_argument(
                "--with", dest="tables", type=Path, metavar="FILE", help="tables (those of the package)"
            )
    args = parser.parse_args(argv)
    return run_command("twin_worker.confidence.calibration", _fit if args.verb == "fit" else _check, args)


if __name__ == "__main__":
    sys.exit(main())
