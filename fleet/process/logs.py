"""What a process says of itself: sentences for people, or with `--log-json` a line of JSON each for machines.

Every line of a log begins with its time (RFC 3339, UTC). What a command was asked for (a table, JSON, the reason why a
command that logs nothing refuses its arguments) is an answer and no log line.
"""

import argparse
import json
import logging
import re
import sys
import time
from datetime import UTC, datetime

from fleet.process.sanitise import plain

SAID = "parauav"  # the logger of what a command says as a matter of course
_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z ")


def log_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `--log-json`."""
    parser.add_argument("--log-json", action="store_true", help="say everything as lines of JSON, on standard error")


def begin(process: str, *, as_json: bool = False) -> None:
    """Say from now on what is logged, warnings and worse to people, everything to machines."""
    handler = logging.StreamHandler()
    handler.setFormatter(Lines(process) if as_json else Words(process))
    logging.basicConfig(level=logging.INFO if as_json else logging.WARNING, handlers=[handler])


def timed(line: str, t: float | None = None) -> str:
    """Put a time before a line of a log; `t` is the time of day, None: now [s since 1970]."""
    at = datetime.fromtimestamp(time.time() if t is None else t, UTC)
    return f"{at.isoformat(timespec='milliseconds').removesuffix('+00:00')}Z {line}"


def untimed(line: str) -> str:
    """Take the time off a line of a log, where there is one."""
    found = _TIME.match(line)
    return line if found is None else line[found.end() :]


def say(process: str, sentence: str) -> None:
    """Say what a command says as a matter of course."""
    if logging.getLogger().isEnabledFor(logging.INFO):
        logging.getLogger(SAID).info("%s", sentence)
    else:
        print(timed(f"{process}: {plain(sentence)}"), flush=True)


def tell(process: str, sentence: str) -> None:
    """Say on standard error how the work of a command goes on: standard output is for its answer."""
    print(timed(f"{process}: {plain(sentence)}"), file=sys.stderr, flush=True)


def fail(process: str, sentence: str, *, logged: bool = True) -> None:
    """Say why a command ends.

    Args:
        process: its name
        sentence: the reason
        logged: it is one that logs; else the reason is its answer
    """
    if logging.getLogger().isEnabledFor(logging.INFO):
        logging.getLogger(SAID).error("%s", sentence)
    else:
        line = f"{process}: {plain(sentence)}"
        print(timed(line) if logged else line, file=sys.stderr)


class Words(logging.Formatter):
    """Write sentences with their time: what strangers wrote in them must not steer a terminal."""

    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        """Return one sentence, and how a defect was met."""
        words = timed(f"{self._process}: {plain(record.getMessage())}", record.created)
        return f"{words}\n{self.formatException(record.exc_info)}" if record.exc_info else words


class Lines(logging.Formatter):
    """Write JSON: t (RFC 3339), level, process, from (module), message, and defect where one was met."""

    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        """Return one line."""
        line = {
            "t": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "process": self._process,
            "from": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            line["defect"] = self.formatException(record.exc_info)
        return json.dumps(line)
