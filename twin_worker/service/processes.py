"""Run several workers for one id range on one machine; they share it by the ownership protocol."""

import threading

from fleet.process.children import Children
from fleet.process.logs import report_progress

_POLL_S = 0.5
_RESTART_DELAY_S = 5.0  # before a restart, so that an immediate failure does not loop at full load [s]


def run_many(options: list[list[str]], stop: threading.Event) -> int:
    """Run one worker per list of options until `stop` is set; restart failed ones, end all on a usage error."""
    with Children() as children:
        options_by_name = {f"worker {k}": arguments for k, arguments in enumerate(options)}
        for name, each in options_by_name.items():
            children.start(name, "twin_worker", *each)
        while not stop.wait(_POLL_S):
            failed = children.failures()
            for code, sentence in failed:
                report_progress("twin_worker", sentence)
                if code == 2:
                    return 2
            if failed and not stop.wait(_RESTART_DELAY_S):
                for name in children.failed_names():
                    children.start(name, "twin_worker", *options_by_name[name])
    return 0
