"""Telemetry from simulators slower or faster than real time, paused or late: links lost, and predictions afterwards.

    python -m tests.bench.late_arrival --seconds 150

One simulated flight goes through the gateway's decoding and a worker on a clock of its own; nothing waits. A link is
lost by mistake where telemetry arrived within the second before.
"""

import argparse
import time

from tests.support.late_arrival import ARRIVALS, flight, lived, relayed


def main() -> None:
    """Print the table."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m tests.bench.late_arrival", description=__doc__, formatter_class=form)
    parser.add_argument("--seconds", type=float, default=150.0, help="simulated time [s] (150)")
    parser.add_argument("--seed", type=int, default=1, help="of the flight (1)")
    parser.add_argument("--only", action="append", choices=ARRIVALS, help="one of the rows; repeatable (all)")
    args = parser.parse_args()
    sent, clock = flight(args.seconds, args.seed), [0.0]
    time.monotonic = lambda: clock[0]  # type: ignore[assignment]
    print("| speed | link lost by mistake | link lost | longest gap [s] | back after [s] | predictions | steps [s] |")
    print("|---|---|---|---|---|---|---|")
    for name in args.only or ARRIVALS:
        found = lived(relayed(sent, ARRIVALS[name]), lambda now: clock.__setitem__(0, now)).found
        print(f"| {name} | {found.row()} |", flush=True)


if __name__ == "__main__":
    main()
