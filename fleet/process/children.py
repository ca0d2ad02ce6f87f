"""Child processes that end with their parent: start by module name, store their last lines of output, stop in order."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from contextlib import AbstractContextManager

from fleet.process.interrupt import PARENT, interrupt_deferred
from fleet.process.logs import strip_time
from fleet.process.sanitise import printable

_STOP_TIMEOUT_S = 8.0  # between SIGTERM and SIGKILL [s]
_SINGLE_TIMEOUT_S = 10.0  # longest wait for a single child after SIGTERM [s]


def run_until(stop: threading.Event, module: str, *options: str) -> int:
    """Run `python -m module options…` in the foreground until it ends or `stop` is set; return its exit code."""
    child = subprocess.Popen([sys.executable, "-m", module, *options], env=os.environ | {PARENT: str(os.getpid())})
    try:
        while child.poll() is None and not stop.wait(0.2):
            pass
    finally:
        if child.poll() is None:
            child.terminate()
    code = child.wait(_SINGLE_TIMEOUT_S)
    return code if code >= 0 else 128 - code


def run_to_end(module: str, *options: str) -> tuple[int, str]:
    """Run `python -m module options…` to its end and return its exit code and standard error; Ctrl-C ends it too."""
    child = None
    try:
        with interrupt_deferred():  # otherwise Ctrl-C could leave it running
            command = [sys.executable, "-m", module, *options]
            child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        _, errors = child.communicate()
        return child.returncode, errors
    finally:
        with interrupt_deferred():
            if child is not None and child.poll() is None:
                child.kill()
                child.communicate()


class Children(AbstractContextManager):
    """Processes of one fleet."""

    def __init__(self) -> None:
        self._running: dict[str, subprocess.Popen[str]] = {}
        self._last_lines: dict[str, deque[str]] = {}
        self._readers: dict[str, threading.Thread] = {}

    def start(self, name: str, module: str, *options: str) -> None:
        """Start `python -m module options…` and store its last lines of output."""
        child = subprocess.Popen(
            [sys.executable, "-m", module, *options],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,  # Ctrl-C reaches the parent only, which then stops the children in order
            env=os.environ | {"PYTHONUNBUFFERED": "1", PARENT: str(os.getpid())},
        )
        self._running[name] = child
        self._last_lines[name] = deque(maxlen=6)
        self._readers[name] = threading.Thread(target=self._read_output, args=(name, child), daemon=True)
        self._readers[name].start()

    def _read_output(self, name: str, child: subprocess.Popen[str]) -> None:
        assert child.stdout is not None
        with child.stdout:
            for line in child.stdout:
                if line.strip():
                    self._last_lines[name].append(strip_time(printable(line.rstrip())))  # the parent adds its own time

    def last_lines(self) -> list[str]:
        """Return each child's last line."""
        return [lines[-1] for lines in self._last_lines.values() if lines]

    def finished(self) -> list[str]:
        """Return the names of the children that ended with exit code 0."""
        return [name for name, child in self._running.items() if child.poll() == 0]

    def failed_names(self) -> list[str]:
        """Return the names of the children that failed."""
        return [name for name, child in self._running.items() if child.poll()]

    def failures(self) -> list[tuple[int, str]]:
        """Return exit code and message of the failed children; exit code 2 uses the child's own message."""
        results = []
        for name, child in self._running.items():
            if code := child.poll():
                self._readers[name].join(timeout=1.0)  # its last lines may still be in the pipe
                lines = self._last_lines[name]
                text = f"{name}: found it ended with exit code {code}, expected it to run until stopped; "
                text += f"last output: {' | '.join(lines) or 'none'}"
                results.append((code, lines[-1] if code == 2 and lines else text))
        return results

    def stop(self) -> None:
        """Send SIGTERM to all, newest first, then SIGKILL to those still running."""
        for child in reversed(self._running.values()):
            if child.poll() is None:
                child.send_signal(signal.SIGTERM)
        deadline = time.monotonic() + _STOP_TIMEOUT_S
        for child in self._running.values():
            try:
                child.wait(timeout=max(deadline - time.monotonic(), 0.0))
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()

    def __exit__(self, *_: object) -> None:
        self.stop()
