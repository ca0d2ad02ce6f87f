"""Cache of parameters and missions of aircraft in the user's cache folder; entries are verified before use."""

import logging
from pathlib import Path

import msgspec

from fleet.contract import Item
from fleet.process import private_files

_log = logging.getLogger(__name__)
_MOST = 1 << 24  # bytes read of one entry; 5,000 parameters and 1,000 items have 0.5 MB


class Card(msgspec.Struct, frozen=True):
    """Cache entry of one aircraft."""

    values: dict[str, float] = {}
    count: int = 0  # of its parameters
    hash: float | None = None  # over all parameters, from the autopilot
    items: tuple[Item, ...] = ()


class Cache:
    """Cache entries by aircraft.

    Args:
        folder: created with the first entry; a folder that other users can change is refused
    """

    def __init__(self, where: Path | None = None) -> None:
        self._refused = ""  # why nothing is read or stored
        self._said = False
        try:
            self._where = private_files.onboard_folder() if where is None else where
        except RuntimeError as error:
            self._refused, self._where = str(error), Path()
        if not self._refused and self._where.is_dir():
            self._check()

    def read(self, key: str) -> Card | None:
        """Return the entry of an aircraft; None without one or if the file is damaged."""
        try:
            if self._refused:
                return None
            with (self._where / f"{key}.json").open("rb") as file:
                return msgspec.json.decode(file.read(_MOST), type=Card)
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return None

    def keep(self, key: str, card: Card) -> None:
        """Store the entry of an aircraft; log a warning if that fails."""
        if card == self.read(key):
            return
        if self._where != Path():
            self._check()
        if self._refused:
            if not self._said:
                _log.warning("parameters and missions cannot be cached: %s", self._refused)
            self._said = True
            return
        try:
            private_files.write(self._where / f"{key}.json", msgspec.json.encode(card))
        except OSError as error:
            _log.warning("parameters and missions cannot be cached in %s (%s)", self._where, error.strerror)

    def _check(self) -> None:
        """Create the folder, or check that no other user can write there."""
        try:
            private_files.folder(self._where, "PARAUAV_ONBOARD")
            self._refused = ""
        except ValueError as error:
            self._refused = str(error)
        except OSError as error:
            self._refused = f"{self._where} ({error.strerror})"
