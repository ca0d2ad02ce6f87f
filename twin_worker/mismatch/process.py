"""Run diagnoses in a separate low-priority process, within a share of one CPU core.

A job and its result exceed the pipe buffer, and the low-priority process can read or write seconds later on a busy
machine. A thread therefore sends and receives, and `submit` never blocks. A job that crashes, times out or raises
returns a result with the reason, and the process restarts for the next job.
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

from twin_worker.mismatch.job import DiagnosisJob, DiagnosisResult, failed_result, run_job

CPU_SHARE, URGENT_SHARE = 0.2, 0.8  # share of one core: usually, and after urgent jobs and unusual residuals [-]
LIMIT_CPU_S = 180.0  # CPU time of one job, including compilation [s]
LIMIT_S = 900.0  # wall time of one job; longer only if it waits indefinitely [s]
_NICE_INCREMENT = 15  # increment of the nice value
_JOIN_TIMEOUT_S = 1.0  # wait for the end of process and thread [s]
_EXIT_TIMEOUT_S = 30.0  # wait for a process to exit after it closed its pipe; it runs at low priority [s]
JobFunction = Callable[[DiagnosisJob], DiagnosisResult]


class DiagnosisProcess:
    """A process that executes one diagnosis job at a time.

    Args:
        share: average share of one core [-]
        function: runs one job; must be importable by the process
        limit_cpu_s: CPU time of one job [s]
        limit_s: wall time of one job [s]
    """

    def __init__(
        self,
        share: float = CPU_SHARE,
        function: JobFunction = run_job,
        limit_cpu_s: float = LIMIT_CPU_S,
        limit_s: float = LIMIT_S,
    ) -> None:
        self._share, self._function, self._limit_cpu_s, self._limit_s = share, function, limit_cpu_s, limit_s
        self._process: SpawnProcess | None = None
        self._pipe: Connection | None = None
        self._thread: threading.Thread | None = None  # of the running job
        self._result: DiagnosisResult | None = None
        self._busy = self._closed = self._timed_out = self._is_urgent = False
        self._free_at = 0.0  # monotonic [s]
        self._lock = threading.Lock()  # protects start and end of the process

    @property
    def free(self) -> bool:
        """Return whether a job can be submitted now."""
        return not self._busy and not self._closed and time.monotonic() >= self._free_at

    def submit(self, job: DiagnosisJob) -> None:
        """Start a job; `poll` returns its result."""
        self._busy, self._result, self._is_urgent = True, None, job.is_urgent
        self._thread = threading.Thread(target=self._exchange, args=(job,), daemon=True, name="diagnosis")
        self._thread.start()

    def poll(self) -> DiagnosisResult | None:
        """Return a finished result; None if there is none."""
        result = self._result
        if result is not None:
            is_urgent = self._is_urgent or result.check > 1.0
            share = max(URGENT_SHARE, self._share) if is_urgent else self._share
            self._free_at = time.monotonic() + result.cpu_s * (1.0 / share - 1.0)
            self._result, self._busy = None, False
        return result

    def close(self) -> None:
        """End the process and discard its running job."""
        self._closed = True
        self._stop_process()
        if self._thread is not None:
            self._thread.join(_JOIN_TIMEOUT_S)

    def _exchange(self, job: DiagnosisJob) -> None:
        """Send a job and receive its result; store a failed result if there is none."""
        started, self._timed_out = time.monotonic(), False
        guard = threading.Timer(self._limit_s, self._kill_on_timeout)
        guard.daemon = True
        guard.start()
        reason = ""
        try:
            pipe = self._open_pipe()
            pipe.send(job)
            result: DiagnosisResult = pipe.recv()
        except (EOFError, OSError):
            reason = self._exit_reason(self._stop_process())
        except Exception as error:  # data that cannot be pickled affect this job only
            self._stop_process()
            reason = f"{type(error).__name__}: {error}"
        finally:
            guard.cancel()
        if reason:
            result = failed_result(job, reason, cpu_s=min(time.monotonic() - started, self._limit_cpu_s))
        self._result = result

    def _open_pipe(self) -> Connection:
        """Return the pipe to a running process; start one if needed.

        Raises:
            OSError: when no process can be started, or the executor is closed; create another one.
        """
        with self._lock:
            if self._closed:
                raise OSError("diagnosis process: found it closed, expected open; create another one")
            if self._process is None or not self._process.is_alive() or self._pipe is None:
                spawn = multiprocessing.get_context("spawn")
                self._pipe, child_pipe = spawn.Pipe()
                arguments = child_pipe, self._function, self._limit_cpu_s
                self._process = spawn.Process(target=_serve, args=arguments, daemon=True, name="diagnosis")
                self._process.start()
                child_pipe.close()
            return self._pipe

    def _kill_on_timeout(self) -> None:
        """Kill a process that exceeds the wall time; the reader then sees the end of its pipe."""
        self._timed_out = True
        if (process := self._process) is not None:
            process.kill()

    def _stop_process(self) -> int | None:
        """End the process and return its exit code; None if there was none."""
        with self._lock:
            process, pipe = self._process, self._pipe
            self._process = self._pipe = None
        if process is None or pipe is None:
            return None
        if not self._closed:
            process.join(_EXIT_TIMEOUT_S)  # a process about to exit reports its own exit code
        if process.is_alive():
            process.kill()
            process.join(_JOIN_TIMEOUT_S)
        if self._thread is None or self._thread is threading.current_thread() or not self._thread.is_alive():
            pipe.close()  # otherwise the thread still reads the pipe until its end
        return process.exitcode

    def _exit_reason(self, code: int | None) -> str:
        """Describe why there is no result."""
        if self._timed_out:
            return f"found no result after {self._limit_s:.0f} s"
        if code is not None and code == -getattr(signal, "SIGXCPU", 0):
            return f"found no result after {self._limit_cpu_s:.0f} s of CPU time"
        if code is not None and code < 0:
            return f"its process was killed by signal {-code}"
        return "its process could not be started" if code is None else f"its process ended with exit code {code}"


def _serve(pipe: Connection, function: JobFunction, limit_cpu_s: float) -> None:
    """Execute jobs until the pipe closes, as it does when the parent ends; the parent handles Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(_NICE_INCREMENT)
    with contextlib.suppress(EOFError, OSError):
        while True:
            job = pipe.recv()
            started = time.process_time()
            _limit_cpu(started + limit_cpu_s)
            try:
                result = function(job)
            except Exception as error:  # an error in one job must not stop the others
                reason, cpu_s = f"{type(error).__name__}: {error}", time.process_time() - started
                result = failed_result(job, reason, cpu_s=cpu_s, details=traceback.format_exc())
            pipe.send(result)


def _limit_cpu(seconds: float) -> None:
    """Set the total CPU time limit of this process, also for compiled code; disable core dumps."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource  # not on Windows, where only the wall time limits a job

        for limit, soft in ((resource.RLIMIT_CORE, 0), (resource.RLIMIT_CPU, int(seconds) + 1)):
            hard = resource.getrlimit(limit)[1]
            resource.setrlimit(limit, (soft if hard == resource.RLIM_INFINITY else min(soft, hard), hard))
