"""Where diagnoses are worked out: a process of their own that yields to everything else, within a share of a core.

A job and its answer are larger than a pipe holds, and a process that yields empties or fills it only when it gets to
run: on a busy machine, or while the process starts, after seconds. So a thread sends and receives, and who gives a job
never waits. A job that dies, takes too long or leaves by an exception is answered by a sentence, and the process is
started again for the next.
"""

import contextlib
import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess

from twin_worker.mismatch.job import Answer, Job, failed, work

SHARE = 0.2  # of one core, on average [-]
LIMIT_CPU_S = 180.0  # processor time of one job; the first compiles, too [s]
LIMIT_S = 900.0  # wall time of one job, which is longer only where it waits for what never comes [s]
_NICE = 15  # how far it yields
_PATIENCE_S = 1.0  # with the end of process and thread [s]
_ENDING_S = 30.0  # for a process that has closed its pipe to end by itself; it yields in that, too [s]
Work = Callable[[Job], Answer]


class Background:
    """One process that works out one job at a time.

    Args:
        share: of one core that it may take on average [-]
        work: what is done with a job; a function the process can import
        limit_cpu_s: processor time of one job [s]
        limit_s: wall time of one job [s]
    """

    def __init__(
        self, share: float = SHARE, work: Work = work, limit_cpu_s: float = LIMIT_CPU_S, limit_s: float = LIMIT_S
    ) -> None:
        self._share, self._work, self._limit_cpu_s, self._limit_s = share, work, limit_cpu_s, limit_s
        self._process: SpawnProcess | None = None
        self._pipe: Connection | None = None
        self._thread: threading.Thread | None = None  # of the job in hand
        self._answer: Answer | None = None
        self._busy = self._closed = self._late = False
        self._free_at = 0.0  # monotonic [s]
        self._lock = threading.Lock()  # held while the process starts or ends

    @property
    def free(self) -> bool:
        """Return whether a job may be given now."""
        return not self._busy and not self._closed and time.monotonic() >= self._free_at

    def give(self, job: Job) -> None:
        """Begin a job; its answer comes with `answer`."""
        self._busy, self._answer = True, None
        self._thread = threading.Thread(target=self._exchange, args=(job,), daemon=True, name="diagnosis")
        self._thread.start()

    def answer(self) -> Answer | None:
        """Return an answer that has arrived; None while there is none."""
        found = self._answer
        if found is not None:
            self._free_at = time.monotonic() + found.cpu_s * (1.0 / self._share - 1.0)
            self._answer, self._busy = None, False
        return found

    def close(self) -> None:
        """End the process: what it still works out nobody will receive."""
        self._closed = True
        self._end()
        if self._thread is not None:
            self._thread.join(_PATIENCE_S)

    def _exchange(self, job: Job) -> None:
        """Send a job and receive its answer; without one say why."""
        begun, self._late = time.monotonic(), False
        guard = threading.Timer(self._limit_s, self._too_late)
        guard.daemon = True
        guard.start()
        why = ""
        try:
            pipe = self._started()
            pipe.send(job)
            found: Answer = pipe.recv()
        except (EOFError, OSError):
            why = self._why(self._end())
        except Exception as error:  # what cannot be sent or read is a defect of that job alone
            self._end()
            why = f"{type(error).__name__}: {error}"
        finally:
            guard.cancel()
        if why:
            took = min(time.monotonic() - begun, self._limit_cpu_s)
            found = failed(job, why, cpu_s=took)
        self._answer = found

    def _started(self) -> Connection:
        """Return the pipe to a process that lives.

        Raises:
            OSError: when no process can be started, or none is wanted any more.
        """
        with self._lock:
            if self._closed:
                raise OSError("the diagnosis is closed")
            if self._process is None or not self._process.is_alive() or self._pipe is None:
                spawn = multiprocessing.get_context("spawn")
                self._pipe, theirs = spawn.Pipe()
                given = theirs, self._work, self._limit_cpu_s
                self._process = spawn.Process(target=_serve, args=given, daemon=True, name="diagnosis")
                self._process.start()
                theirs.close()
            return self._pipe

    def _too_late(self) -> None:
        """Kill a process that does not answer: whoever waits for it sees its pipe end."""
        self._late = True
        process = self._process
        if process is not None:
            process.kill()

    def _end(self) -> int | None:
        """End the process and return its exit code; None where there was none."""
        with self._lock:
            process, pipe = self._process, self._pipe
            self._process = self._pipe = None
        if process is None or pipe is None:
            return None
        if not self._closed:
            process.join(_ENDING_S)  # one that is about to end tells its own exit code
        if process.is_alive():
            process.kill()
            process.join(_PATIENCE_S)
        if self._thread is None or self._thread is threading.current_thread() or not self._thread.is_alive():
            pipe.close()  # else the thread still reads from it, until the end that it sees now
        return process.exitcode

    def _why(self, code: int | None) -> str:
        """Say why there is no answer."""
        if self._late:
            return f"found no answer after {self._limit_s:.0f} s"
        if code is not None and code == -getattr(signal, "SIGXCPU", 0):
            return f"found no answer after {self._limit_cpu_s:.0f} s of processor time"
        if code is not None and code < 0:
            return f"its process was killed by signal {-code}"
        return "its process could not be started" if code is None else f"its process ended with exit code {code}"


def _serve(pipe: Connection, work: Work, limit_cpu_s: float) -> None:
    """Work out jobs until the pipe ends, as it does when the parent is no more; Ctrl-C is the parent's business."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    with contextlib.suppress(EOFError, OSError):
        while True:
            job = pipe.recv()
            begun = time.process_time()
            _limit_cpu(begun + limit_cpu_s)
            try:
                found = work(job)
            except Exception as error:  # a defect met by one job must not stop the others
                why, cpu_s = f"{type(error).__name__}: {error}", time.process_time() - begun
                found = failed(job, why, cpu_s=cpu_s, details=traceback.format_exc())
            pipe.send(found)


def _limit_cpu(seconds: float) -> None:
    """Let the system end this process at so much processor time in all, also inside compiled code; no core dump."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource  # not on Windows, where the wall time alone limits a job

        for what, soft in ((resource.RLIMIT_CORE, 0), (resource.RLIMIT_CPU, int(seconds) + 1)):
            hard = resource.getrlimit(what)[1]
            resource.setrlimit(what, (soft if hard == resource.RLIM_INFINITY else min(soft, hard), hard))
