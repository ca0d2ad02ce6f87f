"""What aircraft told before, kept in the user's cache folder: a proposal to be checked, never the truth."""

import logging
from pathlib import Path

import msgspec

from fleet.contract import Item
from fleet.process import private_files

_log = logging.getLogger(__name__)
_MOST = 1 << 24  # bytes read of one card; 5,000 parameters and 1,000 items have 0.5 MB


class Card(msgspec.Struct, frozen=True):
    """What one aircraft told."""

    values: dict[str, float] = {}
    count: int = 0  # of its parameters
    hash: float | None = None  # over all of them, as the autopilot tells it
    items: tuple[Item, ...] = ()


class Cache:
    """Cards by aircraft.

    Args:
        where: their folder, made when the first one is kept; one that others could have changed is left alone
    """

    def __init__(self, where: Path | None = None) -> None:
        self._refused = ""  # why nothing is read or kept
        self._said = False
        try:
            self._where = private_files.onboard_folder() if where is None else where
        except RuntimeError as error:
            self._refused, self._where = str(error), Path()
        if not self._refused and self._where.is_dir():
            self._check()

    def read(self, key: str) -> Card | None:
        """Return what an aircraft told before; None where nothing is known or the file is damaged."""
        try:
            if self._refused:
                return None
            with (self._where / f"{key}.json").open("rb") as file:
                return msgspec.json.decode(file.read(_MOST), type=Card)
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return None

    def keep(self, key: str, card: Card) -> None:
        """Keep what an aircraft tells now; without a disk nothing is kept."""
        if card == self.read(key):
            return
        if self._where != Path():
            self._check()
        if self._refused:
            if not self._said:
                _log.warning("what aircraft told cannot be kept: %s", self._refused)
            self._said = True
            return
        try:
            private_files.write(self._where / f"{key}.json", msgspec.json.encode(card))
        except OSError as error:
            _log.warning("what aircraft told cannot be kept in %s (%s)", self._where, error.strerror)

    def _check(self) -> None:
        """Make the folder, or see that nobody else can have written there."""
        try:
            private_files.folder(self._where, "PARAUAV_ONBOARD")
            self._refused = ""
        except ValueError as error:
            self._refused = str(error)
        except OSError as error:
            self._refused = f"{self._where} ({error.strerror})"
