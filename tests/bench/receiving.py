"""How many datagrams a CPU-second takes off a socket: many at once, and one by one.

python -m tests.bench.receiving --json receiving.json
"""

import argparse
import json
import socket
import time
from pathlib import Path

from gateway.links.receive import BatchReceiver, SingleReceiver

DATAGRAM = bytes(60)
BURST = 200  # within what any system's buffer holds


def measure(kind: type[BatchReceiver] | type[SingleReceiver], bursts: int, senders: int) -> float:
    """Give datagrams per CPU-second of taking alone, from so many senders."""
    far, *near = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(1 + senders))
    for sock in (far, *near):
        sock.bind(("127.0.0.1", 0))
    reader, spent, taken = kind(far), 0.0, 0
    for burst in range(bursts + 1):
        for i in range(BURST):
            near[i % senders].sendto(DATAGRAM, far.getsockname())
        began = time.thread_time()
        while (heard := reader.receive()) is not None:
            taken += len(heard.start) if burst else 0  # the first compiles
        spent += time.thread_time() - began if burst else 0.0
    for sock in (far, *near):
        sock.close()
    assert taken == bursts * BURST, f"lost {bursts * BURST - taken}"
    return taken / spent


def main() -> None:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m tests.bench.receiving", description=__doc__, formatter_class=form)
    parser.add_argument("--bursts", type=int, default=300, help=f"of {BURST} datagrams (300)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was measured")
    args = parser.parse_args()
    found = {
        f"{kind.__name__}, {senders} senders": round(measure(kind, args.bursts, senders))
        for senders in (1, 50)
        for kind in (BatchReceiver, SingleReceiver)
    }
    print(json.dumps(found, indent=1))
    if args.json:
        args.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
