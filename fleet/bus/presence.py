"""Liveliness token of a worker: `worker/{id}/{low}-{high}/{started_ms}`."""

import re
from typing import NamedTuple

_TOKEN_PATTERN = re.compile(r"worker/([0-9a-f]{16})/(\d{1,9})-(\d{1,9})/(\d{1,18})", re.ASCII)


class WorkerToken(NamedTuple):
    """Parsed liveliness token of a worker.

    Attributes:
        worker: its id on the bus, 16 hex digits
        ids: UAV ids it may own
        started_ms: start time, distinguishes it from an earlier incarnation [ms since 1970]
    """

    worker: str
    ids: range
    started_ms: int

    @property
    def token(self) -> str:
        """Return the text of the token."""
        return f"worker/{self.worker}/{self.ids.start}-{self.ids.stop - 1}/{self.started_ms}"


def parse_token(token: str) -> WorkerToken | None:
    """Parse a token; None where it is not a worker's."""
    match = _TOKEN_PATTERN.fullmatch(token)
    if match is None:
        return None
    worker, low, high, started = match.groups()
    return WorkerToken(worker, range(int(low), int(high) + 1), int(started))
