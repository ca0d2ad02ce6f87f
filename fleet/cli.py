"""The `fleet` command, one verb per file in `fleet/commands/`, and functions common to all console commands."""

import argparse
import importlib
import os
import pkgutil
import queue
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path

from fleet import __version__, commands
from fleet.process.children import run_until
from fleet.process.interrupt import INTERRUPTED, PARENT, run_interruptible, set_exit_code
from fleet.process.logs import configure_logging, report_failure, report_progress

ORPHAN_GRACE_S = 30.0  # time for an orphan process to shut down in order [s]

Command = Callable[[argparse.Namespace], int]


def make_parser(prog: str, summary: str, examples: str) -> argparse.ArgumentParser:
    """Create a parser whose help ends with examples."""
    parser = argparse.ArgumentParser(
        prog=prog,
        description=summary,
        epilog="examples:\n" + examples.strip("\n"),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"parauav {__version__}")
    return parser


def run_command(prog: str, run: Command, args: argparse.Namespace) -> int:
    """Run a command; report an expected failure in one line with exit code 2, Ctrl-C with exit code 130.

    A command that runs until it is stopped handles Ctrl-C itself (`stop_on_signal`) and returns 0.
    """
    logs = hasattr(args, "log_json")
    configure_logging(prog, as_json=logs and args.log_json)
    try:
        code = run_interruptible(lambda: run(args))
    except (ValueError, OSError) as error:
        report_failure(prog, str(error), logged=logs)
        return set_exit_code(2)
    if code == INTERRUPTED and not os.environ.get(PARENT):  # otherwise the parent reports it
        report_failure(prog, "interrupted", logged=logs)
    return set_exit_code(code)


def stop_on_signal() -> threading.Event:
    """Return an event that Ctrl-C, SIGTERM and the end of the parent set, for an orderly shutdown."""
    stop, signals = threading.Event(), queue.SimpleQueue[int]()
    for number in (signal.SIGINT, signal.SIGTERM):
        # not stop.set(): a handler runs in the main thread, which may own that event's lock in wait(): a deadlock
        signal.signal(number, lambda number, _: signals.put(number))

    def forward() -> None:
        signals.get()
        stop.set()

    threading.Thread(target=forward, daemon=True).start()
    if parent := os.environ.get(PARENT):
        threading.Thread(target=_stop_with_parent, args=(int(parent), stop), daemon=True).start()
    return stop


def _stop_with_parent(parent: int, stop: threading.Event) -> None:
    """Stop when the parent process has ended, also if it was killed."""
    while not stop.wait(1.0):
        if os.getppid() != parent:
            stop.set()
            threading.Event().wait(ORPHAN_GRACE_S)  # after this a process blocked in a foreign library is ended
            os._exit(1)


def run_module(verb: str, lost: str, module: str, *options: str) -> int:
    """Run `python -m module options…` for a verb and return its exit code, or 130 after Ctrl-C.

    Args:
        verb: name in messages
        lost: what Ctrl-C loses, for the message
        module, options: command line of the child process
    """
    stop = stop_on_signal()
    code = run_until(stop, module, *options)
    if not stop.is_set():
        return code
    report_progress(verb, f"stopped; {lost}")
    return INTERRUPTED


def check_parent(option: str, path: Path | str | None) -> None:
    """Check that the folder of an output exists.

    Raises:
        ValueError: when it does not; the text names the option.
    """
    if path and not Path(path).absolute().parent.is_dir():
        raise ValueError(f"{option}: found no folder {str(Path(path).parent)!r}, expected one; create it first")


def host_and_port(option: str, text: str) -> tuple[str, int]:
    """Parse HOST:PORT.

    Raises:
        ValueError: when it is malformed; the text names the option.
    """
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65_536:
        raise ValueError(f"{option}: found {text!r}, expected HOST:PORT such as 127.0.0.1:14550; correct {option}")
    return host, int(port)


def id_range(text: str) -> range:
    """Parse `0-49` or `7` as UAV ids.

    Raises:
        ArgumentTypeError: when it is not a range of ids below 1,000,000; argparse shows the text.
    """
    low, _, high = text.partition("-")
    if not low.isdecimal() or (high and not high.isdecimal()) or int(high or low) < int(low) or len(high or low) > 6:
        raise argparse.ArgumentTypeError(
            f"found {text!r}, expected a range of ids such as 0-49; write the lower one first"
        )
    return range(int(low), int(high or low) + 1)


def command_modules() -> dict[str, str]:
    """List the verbs and the module of each."""
    modules = pkgutil.walk_packages(commands.__path__, f"{commands.__name__}.")
    return {module.name.rpartition(".")[2]: module.name for module in modules if not module.ispkg}


def main(argv: list[str] | None = None) -> int:
    """Run `fleet <verb>`."""
    parser = make_parser(
        "fleet",
        "Digital twins for UAV swarms.",
        "  fleet up --uavs 8\n  fleet status --json\n  fleet schema prediction\n",
    )
    verbs = parser.add_subparsers(title="verbs", dest="verb", metavar="VERB", required=True)
    listed = command_modules()
    requested = (sys.argv[1:] if argv is None else argv)[:1]
    # one verb needs no import of the others
    for name in requested if requested and requested[0] in listed else sorted(listed):
        module = importlib.import_module(listed[name])
        summary = (module.__doc__ or "").strip().splitlines()[0]
        verb = verbs.add_parser(
            name,
            help=summary,
            description=summary,
            epilog="examples:\n" + module.EXAMPLES.strip("\n"),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.arguments(verb)
        verb.set_defaults(run=module.run)
    args = parser.parse_args(argv)
    return run_command(f"fleet {args.verb}", args.run, args)


if __name__ == "__main__":
    sys.exit(main())
