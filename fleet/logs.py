"""What a process says of itself: sentences for people, or with `--log-json` a line of JSON each for machines."""

import argparse
import json
import logging
import sys
from datetime import UTC, datetime

from fleet.plain import plain

SAID = "parauav"  # the logger of what a command says as a matter of course


def log_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `--log-json`."""
    parser.add_argument("--log-json", action="store_true", help="say everything as lines of JSON, on standard error")


def begin(process: str, *, as_json: bool = False) -> None:
    """Say from now on what is logged, warnings and worse to people, everything to machines."""
    handler = logging.StreamHandler()
    handler.setFormatter(Lines(process) if as_json else Words(process))
    logging.basicConfig(level=logging.INFO if as_json else logging.WARNING, handlers=[handler])


def say(process: str, sentence: str) -> None:
    """Say what a command says as a matter of course."""
    if logging.getLogger().isEnabledFor(logging.INFO):
        logging.getLogger(SAID).info("%s", sentence)
    else:
        print(f"{process}: {plain(sentence)}", flush=True)


def fail(process: str, sentence: str) -> None:
    """Say why a command ends."""
    if logging.getLogger().isEnabledFor(logging.INFO):
        logging.getLogger(SAID).error("%s", sentence)
    else:
        print(f"{process}: {plain(sentence)}", file=sys.stderr)


class Words(logging.Formatter):
    """Write sentences: what strangers wrote in them must not steer a terminal."""

    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        """Give one sentence, and how a defect was met."""
        words = f"{self._process}: {plain(record.getMessage())}"
        return f"{words}\n{self.formatException(record.exc_info)}" if record.exc_info else words


class Lines(logging.Formatter):
    """Write JSON: t (RFC 3339), level, process, from (module), message, and defect where one was met."""

    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        """Give one line."""
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
