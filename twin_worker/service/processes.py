"""Several workers of one range on one machine: they share it by their claims, as workers on several machines do."""

import threading

from fleet.process.children import Children
from fleet.process.logs import tell

_LOOK_S = 0.5
_AGAIN_S = 5.0  # before one that died is started again, so that what kills it at once does not run hot [s]


def run_many(options: list[list[str]], stop: threading.Event) -> int:
    """Run a worker with each of these options until told to stop; who dies is started again, a refusal ends all."""
    with Children() as children:
        started = {f"worker {k}": each for k, each in enumerate(options)}
        for name, each in started.items():
            children.start(name, "twin_worker", *each)
        while not stop.wait(_LOOK_S):
            failed = children.failed()
            for code, sentence in failed:
                tell("twin_worker", sentence)
                if code == 2:
                    return 2
            if failed and not stop.wait(_AGAIN_S):
                for name in children.dead():
                    children.start(name, "twin_worker", *started[name])
    return 0
