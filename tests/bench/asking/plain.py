"""The same bytes by Zenoh alone: what no answer of ours comes before."""

import sys
import time

import zenoh

from fleet.bus.session import Bus, connect
from fleet.cli import stop_on_signal

KEYS = {"wildcard": "plain/one/*", "batch": "plain/all/*"}


def once(bus: Bus, name: str, wanted: int) -> float | None:
    """Ask once; give how long the last of so many answers took [s]; None where fewer came."""
    begun, came = time.perf_counter(), 0
    replies = bus._session.get(
        KEYS[name],
        zenoh.handlers.FifoChannel(wanted + 1),
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=5.0,
    )
    for reply in replies:
        came += reply.ok is not None and len(reply.ok.payload.to_bytes()) > 0
        if came == wanted:
            return time.perf_counter() - begun
    return None


def main(router: str, low: int, high: int, size: int) -> None:
    """Answer with so many bytes for each, until told to stop."""
    stop, one, whole = stop_on_signal(), bytes(size), bytes(size * (high - low))
    names = [f"plain/one/{uav}" for uav in range(low, high)]

    def each(query: zenoh.Query) -> None:
        with query:
            for name in names:
                query.reply(name, one)

    def at_once(query: zenoh.Query) -> None:
        with query:
            query.reply(f"plain/all/{low}", whole)

    with connect(router) as bus:
        held = [bus._session.declare_queryable(*pair) for pair in ((KEYS["wildcard"], each), (KEYS["batch"], at_once))]
        print(f"{len(held)} answers", flush=True)
        stop.wait()


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
