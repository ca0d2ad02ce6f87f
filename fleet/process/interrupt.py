"""Ctrl-C: a command ends with exit code 130 and one line, whatever it is doing, from its first import to its exit.

While the work of a command runs, Ctrl-C raises KeyboardInterrupt in the main thread, once, so that files, terminals
and child processes are cleaned up. Before and after there is nothing to clean up, and the process ends at once.
Once its work is done a process does not tear down the interpreter: threads of foreign libraries that ask for it in that
moment are ended inside Rust or C++ code, which aborts the process ("FATAL: exception not rethrown", exit code 134).
The package `fleet` imports this module before anything else. The handler is installed only where the program is one of
`COMMANDS`; a program that uses ParaUAV as a library keeps its own.
"""

import _thread
import atexit
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

INTERRUPTED = 130  # exit code: 128 + SIGINT
COMMANDS = ("fleet", "gateway", "twin_worker", "viewer")  # console scripts, and packages whose modules are run with -m
PARENT = "PARAUAV_PARENT"  # process id of the parent that started this process as its child
_AGAIN_S = 0.02  # before a KeyboardInterrupt that was dropped is raised anew [s]


class _State:
    """Which phase the process is in, and whether SIGINT has arrived."""

    working = False  # the work of a command runs: KeyboardInterrupt is raised
    deferring = False
    arrived = False
    raised = False
    code: int | None = None  # exit code of the work, once it is done


_now = _State()


def interruptible(work: Callable[[], int]) -> int:
    """Run the work of a command and return its exit code, or 130 after Ctrl-C.

    Exceptions that a library made of the KeyboardInterrupt count as that; others propagate.
    """
    _now.arrived = _now.raised = False
    try:
        try:
            _now.working = True
            code = work()
        finally:
            _now.working = False
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception:
        if not _now.arrived:
            raise
        return INTERRUPTED
    return INTERRUPTED if _now.arrived else code


def exits_with(code: int) -> int:
    """Note the exit code that the process is about to end with, and return it."""
    _now.code = code
    return code


@contextmanager
def deferred() -> Iterator[None]:
    """Let Ctrl-C wait until the block is over, for steps that must not be left half done; they must be short."""
    _now.deferring = True
    try:
        yield
    finally:
        _now.deferring = False
        if _now.arrived and _now.working and not _now.raised:
            _now.raised = True
            raise KeyboardInterrupt


def install() -> None:
    """Install the handler, unless whoever started the process lets it ignore Ctrl-C (as nohup does)."""
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return
    signal.signal(signal.SIGINT, _on_sigint)
    sys.unraisablehook = _on_unraisable
    atexit.register(_exit)  # registered first, so it runs last


def _on_sigint(*_: object) -> None:
    _now.arrived = True
    if _now.working and _now.deferring:
        return
    if not _now.working or _now.raised:  # nothing to clean up, or Ctrl-C came again during the cleaning up
        _end()
    _now.raised = True
    raise KeyboardInterrupt


def _on_unraisable(what: Any) -> None:
    """Raise KeyboardInterrupt anew where the interpreter had to drop it: in callbacks from C and in `__del__`."""
    if not issubclass(what.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(what)
    elif _now.working:
        _now.raised = False
        _thread.start_new_thread(_insist, ())  # raised here, in the hook, it would be dropped again


def _insist() -> None:
    while _now.working and not _now.raised:
        time.sleep(_AGAIN_S)
        _thread.interrupt_main()


def _end() -> None:
    if not os.environ.get(PARENT):  # which says so itself
        cursor = "\x1b[?25h" if os.isatty(2) else ""  # a progress bar hides it
        os.write(2, f"{cursor}{_PROGRAM}: interrupted\n".encode())
    os._exit(INTERRUPTED)


def _exit() -> None:
    """End the process with its exit code, without tearing down the interpreter; from here on Ctrl-C is ignored."""
    if signal.getsignal(signal.SIGINT) is _on_sigint:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    if _now.code is None:
        return
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):  # closed, or a pipe that nobody reads; the interpreter reports that
            return
    os._exit(_now.code)


def _program() -> str:
    """Name the command this process runs; empty for any other program."""
    name = sys.argv[0] if sys.argv else ""
    if name == "-m":  # so it reads until the module is found
        module = sys.orig_argv[-len(sys.argv)]
        return module.removesuffix(".cli") if module.partition(".")[0] in COMMANDS else ""
    name = os.path.basename(name)
    return name if name in COMMANDS else ""


_PROGRAM = _program()
if _PROGRAM:
    install()
