"""Several workers of one range on one machine: they share it by their claims, as workers on several machines do."""

import sys
import threading

from fleet.children import Children

_LOOK_S = 0.5
_AGAIN_S = 5.0  # before one that died is started again, so that what kills it at once does not run hot [s]


def run_many(count: int, options: list[str], stop: threading.Event) -> int:
    """Run so many workers until told to stop; one that dies is started again, one that refuses its options ends all."""
    with Children() as children:
        for k in range(count):
            children.start(f"worker {k}", "twin_worker", *options)
        while not stop.wait(_LOOK_S):
            failed = children.failed()
            for code, sentence in failed:
                print(sentence, file=sys.stderr, flush=True)
                if code == 2:
                    return 2
            if failed and not stop.wait(_AGAIN_S):
                for name in children.dead():
                    children.start(name, "twin_worker", *options)
    return 0
