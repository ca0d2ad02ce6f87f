"""Conceal effects in flights for a blind examination: recordings in a folder, labels in a file elsewhere."""

import argparse
import json
import sys
from pathlib import Path

EXAMPLES = """
  python -m fleet.pretend.conceal --seed 1 --flights 12 --out flights --labels labels.json
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--seed", type=int, required=True, help="draws aircraft, missions, weather, noise and effects")
    parser.add_argument("--flights", type=int, default=12, metavar="N", help="recordings to be examined (12)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the recordings")
    parser.add_argument("--labels", type=Path, metavar="FILE", help="write what is hidden to FILE; else nobody knows")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (2)")


def run(args: argparse.Namespace) -> int:
    """Fly, and write the labels where asked.

    Raises:
        ValueError: when an option makes no sense; the sentence says which.
    """
    from fleet.pretend.conceal.exam import exam  # loads JSBSim: not for --help

    if args.seed < 0 or not 1 <= args.jobs <= 64:
        raise ValueError(f"found seed {args.seed}, jobs {args.jobs}, expected 0 or more and 1..64; change them")
    labels = exam(args.seed, args.flights, args.out, _say, args.jobs)
    if args.labels:
        args.labels.write_text(json.dumps(labels, indent=1) + "\n")
    print(f"conceal: {len(labels)} flights in {args.out}")
    return 0


def _say(name: str, done: int, wanted: int) -> None:
    print(f"\rconceal: {done}/{wanted} {name}   ", end="\n" if done == wanted else "", file=sys.stderr, flush=True)


def main(argv: list[str] | None = None) -> int:
    """Run `python -m fleet.pretend.conceal`."""
    parser = argparse.ArgumentParser("fleet.pretend.conceal", description=__doc__, epilog=f"example:{EXAMPLES}")
    arguments(parser)
    args = parser.parse_args(argv)
    try:
        return run(args)
    except (ValueError, OSError) as error:
        print(f"conceal: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("conceal: stopped; the examination is not complete", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
