"""Child processes that end with their parent: start by module name, keep their last words, stop cleanly."""

import os
import signal
import subprocess
import sys
import threading
from collections import deque
from contextlib import AbstractContextManager

_PATIENCE_S = 8.0  # between the request to stop and the end of patience [s]


class Children(AbstractContextManager):
    """Processes of one fleet."""

    def __init__(self) -> None:
        self._running: dict[str, subprocess.Popen[str]] = {}
        self._words: dict[str, deque[str]] = {}

    def start(self, name: str, module: str, *options: str) -> None:
        """Start `python -m module options…`; what it prints becomes its last words."""
        child = subprocess.Popen(
            [sys.executable, "-m", module, *options],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,  # Ctrl-C reaches the parent alone, which then ends the children in order
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )
        self._running[name] = child
        self._words[name] = deque(maxlen=6)
        threading.Thread(target=self._listen, args=(name, child), daemon=True).start()

    def _listen(self, name: str, child: subprocess.Popen[str]) -> None:
        assert child.stdout is not None
        for line in child.stdout:
            if line.strip():
                self._words[name].append(line.rstrip())

    def words(self) -> list[str]:
        """Give each child's last line."""
        return [words[-1] for words in self._words.values() if words]

    def dead(self) -> list[str]:
        """Say which children failed, and their last words; one that ended with 0 was done."""
        ended = [(name, child.poll()) for name, child in self._running.items()]
        return [f"{name} ended with {code}: {' | '.join(self._words[name])}" for name, code in ended if code]

    def stop(self) -> None:
        """Ask all to stop, newest first, then insist."""
        for child in reversed(self._running.values()):
            if child.poll() is None:
                child.send_signal(signal.SIGTERM)
        for child in self._running.values():
            try:
                child.wait(timeout=_PATIENCE_S)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()

    def __exit__(self, *_: object) -> None:
        self.stop()
