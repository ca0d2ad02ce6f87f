"""Replay of recordings in a separate gateway process, so that a file cannot delay live links."""

import argparse
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from fleet.config import router_options
from fleet.process.children import PARENT
from gateway.settings.link_spec import LinkSpec

LogCallback = Callable[[str], None]
Process = subprocess.Popen[bytes]

_STOP_TIMEOUT_S = 8.0  # between the request to terminate and the kill [s]


def split_replays(specs: Sequence[LinkSpec]) -> tuple[list[LinkSpec], list[LinkSpec]]:
    """Return the links to open here, and the recordings to replay separately: all, if there is a live link."""
    files = [spec for spec in specs if spec.kind == "replay"]
    live = [spec for spec in specs if spec.kind != "replay"]
    return (live, files) if live else (files, [])


@contextmanager
def replay_process(
    files: Sequence[LinkSpec], args: argparse.Namespace, report: LogCallback
) -> Iterator[Process | None]:
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
    options += [*router_options(args), "--listen-only", f"--most-uavs={args.most_uavs}"]
    options += ["--log-json"] if args.log_json else []
    command = [sys.executable, "-m", "gateway", *options]
    child = subprocess.Popen(command, stdin=subprocess.DEVNULL, env=os.environ | {PARENT: str(os.getpid())})
    ended = threading.Event()
    watcher = threading.Thread(target=_report_exit, args=(child, ended, report), daemon=True)
    watcher.start()
    try:
        yield child
    finally:
        ended.set()
        if child.poll() is None:
            child.terminate()
        try:
            child.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
        watcher.join()


def _report_exit(child: Process, ended: threading.Event, report: LogCallback) -> None:
    code = child.wait()
    if code and not ended.is_set():
        report(f"the replay of recordings ended with exit code {code}; the live links continue")
