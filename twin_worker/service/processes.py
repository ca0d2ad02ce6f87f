"""Run several workers for one id range on one machine; they share it by the ownership protocol."""

import threading

from fleet.process.children import Children
from fleet.process.logs import tell

_LOOK_S = 0.5
_AGAIN_S = 5.0  # before a restart, so that an immediate failure does not loop at full load [s]


def run_many(options: list[list[str]], stop: threading.Event) -> int:
    """Run one worker per list of options until `stop` is set; restart failed ones, end all on a usage error."""
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
