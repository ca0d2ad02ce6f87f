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

from fleet.cli import guarded, parser_for
from twin_worker.confidence.calibration.evaluate_table import adapted, claimed, figures, left_out, said
from twin_worker.confidence.calibration.fit_table import fit
from twin_worker.confidence.calibration.scored_predictions import Scored, read
from twin_worker.confidence.calibration_table import Table
from twin_worker.confidence.groups import ANY, wider
from twin_worker.confidence.table_files import Source, load, read_tables, write

LEAST_STARTS, LEAST_FLIGHTS = 30, 3  # minimum for a table
ENOUGH_FLIGHTS = 8  # with fewer, differences between methods of one family are not significant

EXAMPLES = """
  python -m twin_worker.confidence.calibration fit predictions.npz --out twin_worker/confidence/calibration/pretend.json
  python -m twin_worker.confidence.calibration check other.npz --with pretend.json
"""


def _fit(args: argparse.Namespace) -> int:
    scored = read(args.files)
    names = set(scored.group.tolist())
    fitted: dict[bytes, Table] = {}  # by selected rows: a parent group with the same predictions has the same table
    tables = []
    for group in dict.fromkeys(name for own in sorted(names) for name in wider(own)):
        rows = scored.within(group)
        mine = scored.part(rows)
        if why := _too_few(scored, group):
            print(f"{group}: no table from {len(mine)} predictions, {why}")
            continue
        known = fitted.get(rows.tobytes())
        table = replace(known, group=group) if known else _table(mine, group)
        fitted[rows.tobytes()] = table
        tables.append(table)
    if not tables:
        raise ValueError(f"calibration: found no group of {LEAST_STARTS} predictions; give more flights")
    command = " ".join(["python -m twin_worker.confidence.calibration fit", *map(_named, args.files)])
    write(args.out, tables, [_source(path) for path in args.files], date.today().isoformat(), command)
    print(f"{args.out.name}: {len(tables)} tables")
    return 0


def _too_few(scored: Scored, group: str) -> str:
    """Return the reason why a group is too small for its own table; empty if it is not."""
    flights = _flights(scored, group)
    if scored.within(group).sum() < LEAST_STARTS or flights < LEAST_FLIGHTS:
        return f"{flights} flights; {LEAST_STARTS} of {LEAST_FLIGHTS} are needed"
    chain = list(wider(group))
    if ANY not in group and flights < ENOUGH_FLIGHTS and _flights(scored, chain[1]) > flights:
        return f"{flights} flights; with those of {chain[1]} there are more"
    return ""


def _flights(scored: Scored, group: str) -> int:
    return len(set(scored.flight[scored.within(group)].tolist()))


def _table(mine: Scored, group: str) -> Table:
    table = fit(mine, group)
    measured = figures(mine, left_out(mine, group))
    apart = "settings" if mine.several(group) else "flights"
    what = f"{group}: {table.starts} predictions of {table.flights} flights; {apart} left out"
    print(said(what, measured), flush=True)
    return replace(table, held_out=measured)


def _named(path: Path) -> str:
    """Return a file name with its folder, because the files of all flights have the same name."""
    return f"{path.absolute().parent.name}/{path.name}"


def _source(path: Path) -> Source:
    scored = read([path])
    return Source(_named(path), len(scored), tuple(sorted(set(scored.flight.tolist()))))


def _check(args: argparse.Namespace) -> int:
    scored = read(args.files)
    tables = read_tables(args.tables) if args.tables else load()
    for group in sorted(set(scored.group.tolist())):
        mine = scored.part(scored.group == group)
        table, which = tables.choose(group)
        print(f"{group}: {len(mine)} predictions of {len(set(mine.flight.tolist()))} flights; {which}")
        print(said("  table alone", figures(mine, claimed(table, mine))))
        print(said("  adapted in flight", figures(mine, adapted(tables, mine))), flush=True)
    return 0


def main(argv: list[str] | None = None) -> int:
    """Run the command line: fit or check calibration tables."""
    parser = parser_for("python -m twin_worker.confidence.calibration", "Fit or check calibration tables.", EXAMPLES)
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="fit|check")
    for verb, what in (("fit", "fit tables"), ("check", "evaluate tables on other predictions")):
        one = verbs.add_parser(verb, help=what)
        one.add_argument("files", nargs="+", type=Path, metavar="FILE", help="scored predictions, .npz")
        if verb == "fit":
            one.add_argument("--out", type=Path, required=True, metavar="FILE", help="tables to write, .json")
        else:
            one.add_argument("--with", dest="tables", type=Path, metavar="FILE", help="tables (those of the package)")
    args = parser.parse_args(argv)
    return guarded("twin_worker.confidence.calibration", _fit if args.verb == "fit" else _check, args)


if __name__ == "__main__":
    sys.exit(main())
