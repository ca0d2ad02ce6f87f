"""What aircraft told before, kept in the user's cache folder: a proposal to be checked, never the truth."""

import contextlib
import logging
import os
import tempfile
from pathlib import Path

import msgspec

from fleet.contract import Item

_log = logging.getLogger(__name__)


class Card(msgspec.Struct, frozen=True):
    """What one aircraft told."""

    values: dict[str, float] = {}
    count: int = 0  # of its parameters
    hash: float | None = None  # over all of them, as the autopilot tells it
    items: tuple[Item, ...] = ()


def folder() -> Path:
    """Name the folder: in this user's cache, or what PARAUAV_ONBOARD says."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("PARAUAV_ONBOARD") or Path(base) / "parauav" / "onboard")


class Cache:
    """Cards by aircraft.

    Args:
        where: their folder, made when the first one is kept
    """

    def __init__(self, where: Path | None = None) -> None:
        self._where = folder() if where is None else where

    def read(self, key: str) -> Card | None:
        """Give what an aircraft told before; None where nothing is known or the file is damaged."""
        try:
            return msgspec.json.decode((self._where / f"{key}.json").read_bytes(), type=Card)
        except (OSError, msgspec.DecodeError):
            return None

    def keep(self, key: str, card: Card) -> None:
        """Keep what an aircraft tells now; without a disk nothing is kept."""
        if card == self.read(key):
            return
        try:
            self._where.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=self._where, suffix=".new", delete=False) as file:
                file.write(msgspec.json.encode(card))
            os.replace(file.name, self._where / f"{key}.json")
        except OSError as error:
            _log.warning("what aircraft told cannot be kept in %s (%s)", self._where, error.strerror)
            with contextlib.suppress(OSError, UnboundLocalError):
                os.unlink(file.name)
