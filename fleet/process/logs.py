"""Log output: text lines for people, or with `--log-json` one line of JSON per message for machines.

Every log line begins with its time (RFC 3339, UTC). The result of a command (a table, JSON, the reason for which a
command without log rejects its arguments) is not a log line.
"""

import argparse
import json
import logging
import re
import sys
import time
from datetime import UTC, datetime

from fleet.process.sanitise import printable

STATUS_LOGGER = "parauav"  # logger of the regular status messages of a command
_TIME_PATTERN = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z ")


def log_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `--log-json`."""
    parser.add_argument("--log-json", action="store_true", help="write all messages as lines of JSON to standard error")


def configure_logging(process: str, *, as_json: bool = False) -> None:
    """Configure logging: warnings and above as text, or everything as JSON."""
    handler = logging.StreamHandler()
    handler.setFormatter(LogFormatter(process, as_json=as_json))
    logging.basicConfig(level=logging.INFO if as_json else logging.WARNING, handlers=[handler])


def add_time(line: str, t: float | None = None) -> str:
    """Prefix a log line with its time; `t`: None means now [s since 1970]."""
    at = datetime.fromtimestamp(time.time() if t is None else t, UTC)
    return f"{at.isoformat(timespec='milliseconds').removesuffix('+00:00')}Z {line}"


def strip_time(line: str) -> str:
    """Remove the time prefix of a log line, if any."""
    match = _TIME_PATTERN.match(line)
    return line if match is None else line[match.end() :]


def report_status(process: str, sentence: str) -> None:
    """Report a regular status message of a command on standard output, or as JSON."""
    if logging.getLogger().isEnabledFor(logging.INFO):
        logging.getLogger(STATUS_LOGGER).info("%s", sentence)
    else:
        print(add_time(f"{process}: {printable(sentence)}"), flush=True)


def report_progress(process: str, sentence: str) -> None:
    """Report the progress of a command on standard error; standard output is for its result."""
    print(add_time(f"{process}: {printable(sentence)}"), file=sys.stderr, flush=True)


def report_failure(process: str, sentence: str, *, logged: bool = True) -> None:
    """Report the reason for which a command fails.

    Args:
        process: name of the command
        sentence: the reason
        logged: True: write a log line with time; False: write the reason alone
    """
    if logging.getLogger().isEnabledFor(logging.INFO):
        logging.getLogger(STATUS_LOGGER).error("%s", sentence)
    else:
        line = f"{process}: {printable(sentence)}"
        print(add_time(line) if logged else line, file=sys.stderr)


class LogFormatter(logging.Formatter):
    """Format messages as text with time, or as JSON.

    Text escapes control characters, because messages can contain untrusted text. JSON has t (RFC 3339), level,
    process, from (module), message, and defect (traceback).
    """

    def __init__(self, process: str, *, as_json: bool) -> None:
        super().__init__()
        self._process, self._as_json = process, as_json

    def format(self, record: logging.LogRecord) -> str:
        """Return the message with the traceback of an exception, if any."""
        defect = self.formatException(record.exc_info) if record.exc_info else ""
        if not self._as_json:
            text = add_time(f"{self._process}: {printable(record.getMessage())}", record.created)
            return f"{text}\n{defect}" if defect else text
        line = {
            "t": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "process": self._process,
            "from": record.name,
            "message": record.getMessage(),
        }
        return json.dumps(line | ({"defect": defect} if defect else {}))
