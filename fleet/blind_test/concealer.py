"""`python -m fleet.blind_test.concealer`: simulate the flights of a blind test and encrypt their labels."""

import argparse
import json
import sys
from pathlib import Path

from fleet.blind_test.seal import encrypt
from fleet.cli import run_command
from fleet.process.logs import report_progress
from fleet.simulator.conceal.exam import simulate_exam
from fleet.simulator.conceal.multirotor.exam import simulate_rotor_exam

_REPORT_EVERY = 10


def _progress(name: str, done: int, total: int) -> None:
    """Log the number of flights done; the order of the flights is independent of their labels."""
    if done % _REPORT_EVERY == 0 or done == total:
        report_progress("prove", f"{done} of {total} flights simulated")


def _run(args: argparse.Namespace) -> int:
    if args.aircraft == "quad":
        labels = simulate_rotor_exam(args.seed, args.flights, args.out, _progress, args.jobs)
    else:
        labels = simulate_exam(args.seed, args.flights, args.out, _progress, args.jobs, smallest=args.smallest)
    encrypt(json.dumps(labels, sort_keys=True).encode(), args.sealed, args.key)
    return 0


def main(argv: list[str] | None = None) -> int:
    """Simulate the flights and encrypt their labels."""
    parser = argparse.ArgumentParser(prog="python -m fleet.blind_test.concealer", description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--flights", type=int, required=True)
    parser.add_argument("--jobs", type=int, required=True)
    parser.add_argument("--smallest", type=float, default=1.0)
    parser.add_argument("--aircraft", choices=("wing", "quad"), default="wing")
    for name in ("out", "sealed", "key"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    return run_command("prove", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
