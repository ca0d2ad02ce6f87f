"""Where diagnoses are worked out: a process of their own that yields to everything else, within a share of a core."""

import contextlib
import multiprocessing
import os
import signal
import time
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess

from twin_worker.mismatch.job import Answer, Job, work

SHARE = 0.2  # of one core, on average [-]
_NICE = 15  # how far it yields
_PATIENCE_S = 1.0  # with its end: what it still works out nobody will hear of [s]


class Background:
    """One process that works out one job at a time; a job it dies of is given up, and it is started again."""

    def __init__(self, share: float = SHARE) -> None:
        self._share = share
        self._process: SpawnProcess | None = None
        self._pipe: Connection | None = None
        self._busy = False
        self._free_at = 0.0  # monotonic [s]

    @property
    def free(self) -> bool:
        """Tell whether a job may be given now."""
        return not self._busy and time.monotonic() >= self._free_at

    def give(self, job: Job) -> None:
        """Begin a job; its answer comes with `answer`."""
        if self._process is None or not self._process.is_alive():
            self._start()
        assert self._pipe is not None
        self._busy = True
        self._pipe.send(job)

    def answer(self) -> Answer | None:
        """Give an answer that has arrived; None while there is none, and where the process died of the job."""
        if not self._busy or self._pipe is None or not self._pipe.poll():
            return None
        self._busy = False
        try:
            found: Answer = self._pipe.recv()
        except (EOFError, OSError):
            self.close()
            return None
        self._free_at = time.monotonic() + found.cpu_s * (1.0 / self._share - 1.0)
        return found

    def close(self) -> None:
        """End the process."""
        if self._pipe is not None:
            self._pipe.close()
        if self._process is not None:
            self._process.join(_PATIENCE_S)
            if self._process.is_alive():
                self._process.kill()
        self._process = self._pipe = None

    def _start(self) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._pipe, theirs = spawn.Pipe()
        self._process = spawn.Process(target=_serve, args=(theirs,), daemon=True, name="diagnosis")
        self._process.start()
        theirs.close()


def _serve(pipe: Connection) -> None:
    """Work out jobs until the pipe ends, as it does when the parent is no more; Ctrl-C is the parent's business."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    with contextlib.suppress(EOFError, OSError):
        while True:
            pipe.send(work(pipe.recv()))
