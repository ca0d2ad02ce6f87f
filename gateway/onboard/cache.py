"""Cache of parameters and missions of aircraft in the user's cache folder; entries are verified before use."""

import logging
from pathlib import Path

import msgspec

from fleet.contract import Item
from fleet.process import private_files

_log = logging.getLogger(__name__)
_MAX_BYTES = 1 << 24  # bytes read of one entry; 5,000 parameters and 1,000 items have 0.5 MB


class CachedAircraft(msgspec.Struct, frozen=True):
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

    def __init__(self, folder: Path | None = None) -> None:
        self._refused = ""  # why nothing is read or stored
        self._logged = False
        try:
            self._folder = private_files.onboard_folder() if folder is None else folder
        except RuntimeError as error:
            self._refused, self._folder = str(error), Path()
        if not self._refused and self._folder.is_dir():
            self._check()

    def read(self, key: str) -> CachedAircraft | None:
        """Return the entry of an aircraft; None without one or if the file is damaged."""
        try:
            if self._refused:
                return None
            with (self._folder / f"{key}.json").open("rb") as file:
                return msgspec.json.decode(file.read(_MAX_BYTES), type=CachedAircraft)
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return None

    def store(self, key: str, record: CachedAircraft) -> None:
        """Store the entry of an aircraft; log a warning if that fails."""
        if record == self.read(key):
            return
        if self._folder != Path():
            self._check()
        if self._refused:
            if not self._logged:
                _log.warning("parameters and missions cannot be cached: %s", self._refused)
            self._logged = True
            return
        try:
            private_files.write_secret(self._folder / f"{key}.json", msgspec.json.encode(record))
        except OSError as error:
            _log.warning("parameters and missions cannot be cached in %s (%s)", self._folder, error.strerror)

    def _check(self) -> None:
        """Create the folder, or check that no other user can write there."""
        try:
            private_files.ensure_private_folder(self._folder, "PARAUAV_ONBOARD")
            self._refused = ""
        except ValueError as error:
            self._refused = str(error)
        except OSError as error:
            self._refused = f"{self._folder} ({error.strerror})"
