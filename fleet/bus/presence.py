"""The token by which a worker is known to live: `worker/{id}/{low}-{high}/{born}`."""

import re
from typing import NamedTuple

_FORM = re.compile(r"worker/([0-9a-f]{16})/(\d{1,9})-(\d{1,9})/(\d{1,18})", re.ASCII)


class Present(NamedTuple):
    """A worker that lives.

    Attributes:
        worker: its id on the bus, 16 hex digits
        ids: what it may hold
        born: when it came, which tells it from one of before [ms since 1970]
    """

    worker: str
    ids: range
    born: int

    @property
    def token(self) -> str:
        """Return its token."""
        return f"worker/{self.worker}/{self.ids.start}-{self.ids.stop - 1}/{self.born}"


def read(token: str) -> Present | None:
    """Read a token; None where it is no worker's."""
    found = _FORM.fullmatch(token)
    if found is None:
        return None
    worker, low, high, born = found.groups()
    return Present(worker, range(int(low), int(high) + 1), int(born))
