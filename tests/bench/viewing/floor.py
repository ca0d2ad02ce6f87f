"""What merely hearing the feed costs in this language: every message is taken in and nothing is done with it.

python -m tests.bench.viewing.floor callback --router tcp/127.0.0.1:17447
"""

import argparse
import sys
import threading

from fleet.bus.bus_protocol import key_of
from fleet.bus.session import connect
from fleet.contract import Alert, FleetState, GatewayCounters, Mismatch, Mission, Model, Prediction, Sample, Status

HEARD = (
    Sample,
    Status,
    Mission,
    GatewayCounters,
    Model,
    Prediction,
    Alert,
    Mismatch,
    FleetState,
)  # as the viewer's feed
TICK_S = 0.1


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("way", choices=["callback", "collect"], help="one call of Python for each, or ten a second")
    parser.add_argument("--router", required=True)
    args = parser.parse_args()
    with connect(args.router) as bus:
        held = []
        for kind in HEARD:
            if args.way == "callback":
                held.append(bus._session.declare_subscriber(key_of(kind, "*"), lambda _: None))
            else:
                bus.subscribe_buffered(kind, lambda _: None)
        print("ready", flush=True)
        tick = threading.Event()
        while True:
            tick.wait(TICK_S)
            bus.dispatch()


if __name__ == "__main__":
    sys.exit(main())
