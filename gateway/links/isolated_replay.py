"""Recordings beside live links, played by a gateway of their own: whatever is in a file, no live link waits for it."""

import argparse
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from fleet.config import passed_on
from fleet.process.children import PARENT
from gateway.settings.link_spec import Spec

Say = Callable[[str], None]
Process = subprocess.Popen[bytes]

_PATIENCE_S = 8.0  # between the request to end and the end of patience [s]


def divided(specs: Sequence[Spec]) -> tuple[list[Spec], list[Spec]]:
    """Return the links to open here, and the recordings to be played apart: all of them where there is a live link."""
    files = [spec for spec in specs if spec.kind == "replay"]
    live = [spec for spec in specs if spec.kind != "replay"]
    return (live, files) if live else (files, [])


@contextmanager
def played_apart(files: Sequence[Spec], args: argparse.Namespace, say: Say) -> Iterator[Process | None]:
    """Play recordings in a process of its own until they end or the block does.

    Args:
        files: the recordings; none: no process
        args: of this gateway, the router's and the limits passed on
        say: is told how the process ended, where it did not end well
    """
    if not files:
        yield None
        return
    options = [f"--link={spec.text.partition('#')[0]}#offset={spec.offset}" for spec in files]
    options += [*passed_on(args), "--listen-only", f"--most-uavs={args.most_uavs}"]
    options += ["--log-json"] if args.log_json else []
    command = [sys.executable, "-m", "gateway", *options]
    child = subprocess.Popen(command, stdin=subprocess.DEVNULL, env=os.environ | {PARENT: str(os.getpid())})
    ended = threading.Event()
    watch = threading.Thread(target=_watched, args=(child, ended, say), daemon=True)
    watch.start()
    try:
        yield child
    finally:
        ended.set()
        if child.poll() is None:
            child.terminate()
        try:
            child.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
        watch.join()


def _watched(child: Process, ended: threading.Event, say: Say) -> None:
    code = child.wait()
    if code and not ended.is_set():
        say(f"the recordings ended with exit code {code}; the live links go on")
