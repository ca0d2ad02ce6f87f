"""The `fleet` command, one verb per file in `fleet/commands/`, and functions common to all console commands."""

import argparse
import ast
import difflib
import importlib
import math
import os
import pkgutil
import queue
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterable
from functools import cache
from importlib.util import find_spec
from itertools import takewhile
from pathlib import Path
from typing import Any, NoReturn

from fleet import __version__, commands
from fleet.process.children import run_until
from fleet.process.interrupt import INTERRUPTED, PARENT, run_interruptible, set_exit_code
from fleet.process.logs import configure_logging, report_failure, report_progress

NETWORK_LINKS = ("udpin", "udpout", "udpbcast", "tcpin", "tcp")
LINK_KINDS = (*NETWORK_LINKS, "serial", "replay")
LISTENING = ("udpin", "tcpin")  # kinds of links whose host is optional: loopback
ORPHAN_GRACE_S = 30.0  # time for an orphan process to shut down in order [s]

Command = Callable[[argparse.Namespace], int]


_INT = re.compile(r"[-+]?\d+")
_REWORDED = (  # message of argparse, and what is said instead: `argument NAME` is already removed from it
    (r"(.*): invalid choice: (.*) \(choose from (.*)\)", r"\1: found \2, expected \3"),
    (r"(.*): expected (?:one|at least one|\d+) arguments?", r"\1: found no value, expected one; write it after \1"),
    (r"(.*): ignored explicit argument (.*)", r"\1: found value \2, expected none; leave it out"),
    (r"(.*): not allowed with argument (.*)", r"\1: found \2 as well, expected one of both; leave one out"),
    (r"the following arguments are required: (.*)", r"\1: found none, expected one; add it"),
)


class Parser(argparse.ArgumentParser):
    """Parser whose errors state what was found and expected, with the nearest valid word, after the usage."""

    def __init__(self, **options: Any) -> None:
        super().__init__(formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False, **options)
        self.register("type", int, _whole_number)
        self.register("type", float, _finite_number)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """Parse arguments; an unknown option is reported before absent arguments, whose place its value may take."""
        for word in () if self._subparsers else takewhile("--".__ne__, sys.argv[1:] if args is None else args):
            if word.startswith("--") and word.partition("=")[0] not in self._option_string_actions:
                self.error(self.describe_unknown(word))
        return super().parse_known_args(args, namespace)

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """Parse all arguments; an unknown one is an error of the verb, with its usage."""
        parsed, unknown = self.parse_known_args(args, namespace)
        if unknown:
            verb: Parser = getattr(parsed, "parser", self)
            verb.error(verb.describe_unknown(unknown[0]))
        return parsed

    def error(self, message: str) -> NoReturn:
        """Print usage and error and exit with code 2."""
        text = message.removeprefix("argument ")
        for pattern, replacement in _REWORDED:
            if match := re.fullmatch(pattern, text, re.S):
                text = match.expand(replacement)
                if "invalid choice" in pattern:
                    known = [word.strip("' ") for word in match[3].split(",")]
                    text = f"{match[1]}: found {match[2]}, expected {', '.join(known)}"
                    text += did_you_mean(match[2].strip("'"), known)
                break
        self.print_usage(sys.stderr)
        report_failure(self.prog, text, logged=False)
        raise SystemExit(2)

    def option_strings(self) -> list[str]:
        """Return all option names, in the order of the help."""
        return [name for action in self._actions for name in action.option_strings]

    def describe_unknown(self, word: str) -> str:
        """Describe an argument that no option and no position takes."""
        name = word.partition("=")[0]
        if not name.startswith("-"):
            return f"found {word!r} behind all arguments, expected nothing more; leave it out or quote spaces"
        if full := [option for option in self.option_strings() if option.startswith(name)]:
            return (
                f"{name}: found an abbreviation of {', '.join(full)}, expected the name of an option; write it in full"
            )
        return f"found no option {name!r}, expected one of the usage above{did_you_mean(name, self.option_strings())}"


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return `; did you mean X?` with the nearest known word; without a near one, a remedy."""
    names = {name.lstrip("-"): name for name in known}  # leading dashes would make all options alike
    near = difflib.get_close_matches(word.lower().lstrip("-"), list(names), n=1, cutoff=0.5)
    return f"; did you mean {names[near[0]]}?" if near else "; see --help"


def _whole_number(text: str) -> int:
    if not _INT.fullmatch(text):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a whole number; correct it")
    return int(text)


def _finite_number(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a number; correct it")
    return number


def make_parser(prog: str, summary: str, examples: str) -> Parser:
    """Create a parser whose help ends with examples."""
    parser = Parser(
        prog=prog,
        description=summary,
        epilog="examples:\n" + examples.strip("\n"),
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
        report_failure(prog, describe_error(error), logged=logs)
        return set_exit_code(2)
    if code == INTERRUPTED and not os.environ.get(PARENT):  # otherwise the parent reports it
        report_failure(prog, "interrupted", logged=logs)
    return set_exit_code(code)


def describe_error(error: Exception) -> str:
    """Return the text of an expected failure; one of the operating system with what was expected and the remedy."""
    if not isinstance(error, OSError) or error.filename is None or error.errno is None:
        return str(error)
    name = repr(str(error.filename))
    if isinstance(error, FileNotFoundError):
        return f"found no file {name}, expected one; check the path"
    if isinstance(error, IsADirectoryError):
        return f"found a folder {name}, expected a file; name a file in it"
    if isinstance(error, NotADirectoryError):
        return f"found a file in place of a folder in {name}, expected a folder; check the path"
    if isinstance(error, PermissionError):
        return f"found no permission for {name}, expected to be allowed; change it with chmod, or choose another"
    return f"found an error with {name} ({error.strerror}), expected none; check disk and path"


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


def check_port(option: str, port: int) -> None:
    """Check the number of a TCP port.

    Raises:
        ValueError: when it is out of range; the text names the option.
    """
    if not 0 < port < 65_536:
        raise ValueError(f"{option}: found {port}, expected 1 to 65535; choose another port")


def host_and_port(option: str, text: str) -> tuple[str, int]:
    """Parse HOST:PORT.

    Raises:
        ValueError: when it is malformed; the text names the option.
    """
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65_536:
        raise ValueError(f"{option}: found {text!r}, expected HOST:PORT such as 127.0.0.1:14550; correct {option}")
    return host, int(port)


def check_link(option: str, text: str) -> None:
    """Check kind and address of a link to aircraft, e.g. `udpin:HOST:PORT`; settings are checked by the gateway.

    Raises:
        ValueError: when the kind is unknown or the address malformed; the text names the option.
    """
    kind, _, rest = text.partition("#")[0].partition(":")
    if kind not in LINK_KINDS:
        near = did_you_mean(kind, LINK_KINDS) if kind != "udp" else "; did you mean udpin:0.0.0.0:14550?"
        kinds = ", ".join(LINK_KINDS)
        raise ValueError(f"{option}: found {text!r}, expected {kinds}, each with an address behind a :{near}")
    host, _, port = rest.rpartition(":")
    if kind in NETWORK_LINKS and not (port.isdecimal() and 0 < int(port) < 65_536 and (host or kind in LISTENING)):
        raise ValueError(f"{option}: found {text!r}, expected {kind}:HOST:PORT; write e.g. {kind}:127.0.0.1:14550")
    if kind == "serial" and not (host if port.isdecimal() else rest):
        raise ValueError(f"{option}: found {text!r}, expected serial:PATH:BAUD; write e.g. serial:/dev/ttyUSB0:57600")


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


@cache
def command_modules() -> dict[str, str]:
    """List the verbs and the module of each."""
    modules = pkgutil.walk_packages(commands.__path__, f"{commands.__name__}.")
    return {module.name.rpartition(".")[2]: module.name for module in modules if not module.ispkg}


@cache
def _summary(module: str) -> str:
    """Return the first line of a module's docstring without importing it."""
    spec = find_spec(module)
    assert spec is not None and spec.origin is not None
    document = ast.get_docstring(ast.parse(Path(spec.origin).read_text(encoding="utf-8"))) or ""
    return document.partition("\n")[0]


def fleet_parser(complete: Iterable[str]) -> Parser:
    """Return the parser of `fleet`: all verbs, with the options of those in `complete`, whose modules are imported."""
    parser = make_parser(
        "fleet",
        "Digital twins for UAV swarms.",
        "  fleet up --uavs 8\n  fleet status --json\n  fleet schema prediction\n",
    )
    verbs = parser.add_subparsers(title="verbs", dest="verb", metavar="VERB", required=True)
    wanted = frozenset(complete)
    for name, path in sorted(command_modules().items()):
        summary = _summary(path)
        if name not in wanted:
            verbs.add_parser(name, help=summary)
            continue
        module = importlib.import_module(path)
        verb = verbs.add_parser(
            name, help=summary, description=summary, epilog="examples:\n" + module.EXAMPLES.strip("\n")
        )
        module.arguments(verb)
        verb.set_defaults(run=module.run, parser=verb)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run `fleet <verb>`."""
    words = sys.argv[1:] if argv is None else argv
    requested = words[0] if words else ""
    parser, verbs = fleet_parser([requested]), command_modules()  # one verb needs no import of the others
    if requested.startswith("-") and requested not in parser.option_strings():
        parser.error(parser.describe_unknown(requested))
    if not requested or not (requested.startswith("-") or requested in verbs):
        absent = f"verb {requested!r}" if requested else "verb"
        parser.error(f"found no {absent}, expected {', '.join(sorted(verbs))}{did_you_mean(requested, verbs)}")
    args = parser.parse_args(words)
    return run_command(f"fleet {args.verb}", args.run, args)


if __name__ == "__main__":
    sys.exit(main())
