"""Replay of recordings in a separate gateway process, so that a file cannot delay live links."""

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

_PATIENCE_S = 8.0  # between the request to terminate and the kill [s]


def divided(specs: Sequence[Spec]) -> tuple[list[Spec], list[Spec]]:
    """Return the links to open here, and the recordings to replay separately: all, if there is a live link."""
    files = [spec for spec in specs if spec.kind == "replay"]
    live = [spec for spec in specs if spec.kind != "replay"]
    return (live, files) if live else (files, [])


@contextmanager
def played_apart(files: Sequence[Spec], args: argparse.Namespace, say: Say) -> Iterator[Process | None]:
    """Replay recordings in a separate process until they or the block end.

    Args:
        files: the recordings; none: no process
        args: arguments of this gateway; those of the router and the limits are passed on
        report: called with a message if the process fails
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
        say(f"the replay of recordings ended with exit code {code}; the live links continue")
