"""Liveliness token of a worker: `worker/{id}/{low}-{high}/{started_ms}`."""

import re
from typing import NamedTuple

_FORM = re.compile(r"worker/([0-9a-f]{16})/(\d{1,9})-(\d{1,9})/(\d{1,18})", re.ASCII)


class Present(NamedTuple):
    """Parsed liveliness token of a worker.

    Attributes:
        worker: its id on the bus, 16 hex digits
        ids: UAV ids it may own
        started_ms: start time, distinguishes it from an earlier incarnation [ms since 1970]
    """

    worker: str
    ids: range
    born: int

    @property
    def token(self) -> str:
        """Return the text of the token."""
        return f"worker/{self.worker}/{self.ids.start}-{self.ids.stop - 1}/{self.born}"


def read(token: str) -> Present | None:
    """Parse a token; None where it is not a worker's."""
    found = _FORM.fullmatch(token)
    if found is None:
        return None
    worker, low, high, born = found.groups()
    return Present(worker, range(int(low), int(high) + 1), int(born))
