"""Ctrl-C: a command ends with exit code 130 and one line at any time from its first import to its exit.

While the work of a command runs, Ctrl-C raises KeyboardInterrupt in the main thread, once, so that files, terminals
and child processes are cleaned up. Before and after there is nothing to clean up, and the process ends at once.
After its work a process does not tear down the interpreter: threads of foreign libraries that need the interpreter
during teardown end inside Rust or C++ code, which aborts the process ("FATAL: exception not rethrown", exit code 134).
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
_RETRY_S = 0.02  # before a dropped KeyboardInterrupt is raised again [s]


class _State:
    """Phase of the process, and whether SIGINT arrived."""

    working = False  # the work of a command runs: KeyboardInterrupt is raised
    deferring = False
    arrived = False
    raised = False
    code: int | None = None  # exit code of the work, once it is done


_state = _State()


def run_interruptible(work: Callable[[], int]) -> int:
    """Run the work of a command and return its exit code, or 130 after Ctrl-C.

    An exception into which a library converted the KeyboardInterrupt counts as Ctrl-C; others propagate.
    """
    _state.arrived = _state.raised = False
    try:
        try:
            _state.working = True
            code = work()
        finally:
            _state.working = False
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception:
        if not _state.arrived:
            raise
        return INTERRUPTED
    return INTERRUPTED if _state.arrived else code


def set_exit_code(code: int) -> int:
    """Store the exit code with which the process will end, and return it."""
    _state.code = code
    return code


@contextmanager
def interrupt_deferred() -> Iterator[None]:
    """Defer Ctrl-C until the end of the block, for short steps that must be completed."""
    _state.deferring = True
    try:
        yield
    finally:
        _state.deferring = False
        if _state.arrived and _state.working and not _state.raised:
            _state.raised = True
            raise KeyboardInterrupt


def install() -> None:
    """Install the exit without teardown, and the handler unless SIGINT is ignored (as in a background job)."""
    atexit.register(_exit_at_end)  # registered first, so it runs last
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _on_sigint)
        sys.unraisablehook = _on_unraisable


def _on_sigint(*_: object) -> None:
    _state.arrived = True
    if _state.working and _state.deferring:
        return
    if not _state.working or _state.raised:  # nothing to clean up, or a second Ctrl-C during cleanup
        _exit_interrupted()
    _state.raised = True
    raise KeyboardInterrupt


def _on_unraisable(unraisable: Any) -> None:
    """Raise KeyboardInterrupt again where the interpreter dropped it: in callbacks from C and in `__del__`."""
    if not issubclass(unraisable.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
    elif _state.working:
        _state.raised = False
        _thread.start_new_thread(_raise_again, ())  # raised here, in the hook, it would be dropped again


def _raise_again() -> None:
    while _state.working and not _state.raised:
        time.sleep(_RETRY_S)
        _thread.interrupt_main()


def _exit_interrupted() -> None:
    if not os.environ.get(PARENT):  # otherwise the parent reports it
        cursor = "\x1b[?25h" if os.isatty(2) else ""  # a progress bar hides the cursor
        os.write(2, f"{cursor}{_PROGRAM}: interrupted\n".encode())
    os._exit(INTERRUPTED)


def _exit_at_end() -> None:
    """End the process with its exit code without tearing down the interpreter; ignore Ctrl-C from here on."""
    if signal.getsignal(signal.SIGINT) is _on_sigint:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    if _state.code is None:
        return
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):  # closed, or a pipe without reader; the interpreter reports it
            return
    os._exit(_state.code)


def _program() -> str:
    """Return the name of the command this process runs; empty for any other program."""
    name = sys.argv[0] if sys.argv else ""
    if name == "-m":  # its value until the module is located
        module = sys.orig_argv[-len(sys.argv)]
        return module.removesuffix(".cli") if module.partition(".")[0] in COMMANDS else ""
    name = os.path.basename(name)
    return name if name in COMMANDS else ""


_PROGRAM = _program()
if _PROGRAM:
    install()
