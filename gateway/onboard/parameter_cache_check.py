"""Cache of parameters by board number, MAVLink dialects, and the verification of cached parameters before use."""

import logging
import random
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.autopilots.laws import NAMES
from fleet.contract import Item
from fleet.process import private_files
from fleet.telemetry.mavlink.aircraft_link import AircraftLink
from fleet.telemetry.mavlink.microservices.params import HASH_NAME

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


class RequestDialect(NamedTuple):
    """Request protocol of one autopilot."""

    items_at_once: int = 1  # mission items requested at once
    probe: bool = False  # any item may be requested at any time, not only in order after the count
    hash: str = ""  # name of the parameter with the hash over all parameters
    volatile: tuple[str, ...] = ()  # prefixes of parameters that the autopilot changes itself
    streams: bool = False  # old versions support only groups of messages: REQUEST_DATA_STREAM


DIALECTS = {
    "ardupilot": RequestDialect(
        5, True, volatile=("STAT_", "SYS_NUM_RESETS", "BARO", "GND_", "ARSPD", "COMPASS_"), streams=True
    ),
    "px4": RequestDialect(hash=HASH_NAME),
}
ANY = RequestDialect()

STREAMS = {
    "ATTITUDE": dialect.MAV_DATA_STREAM_EXTRA1,
    "SERVO_OUTPUT_RAW": dialect.MAV_DATA_STREAM_RC_CHANNELS,
    "GLOBAL_POSITION_INT": dialect.MAV_DATA_STREAM_POSITION,
    "VFR_HUD": dialect.MAV_DATA_STREAM_EXTRA2,
    "NAV_CONTROLLER_OUTPUT": dialect.MAV_DATA_STREAM_EXTENDED_STATUS,
    "MISSION_CURRENT": dialect.MAV_DATA_STREAM_EXTENDED_STATUS,
}
"""Stream group of each message."""


RETRY_S = 1.0  # between two equal requests [s]
TRIES = 4  # unsuccessful attempts after which everything is requested again
BATCH = 10  # parameters per request
SAMPLE_SIZE = 20  # parameters checked among those that no twin reads
FENCE_PREFIXES = ("FENCE_", "GF_")


class CacheCheck:
    """Check of cached parameters against the aircraft: by the hash over all, or by all relevant ones and a sample.

    Args:
        aircraft: the aircraft
        cache: parameters and missions of earlier connections
    """

    def __init__(self, aircraft: AircraftLink, cache: Cache) -> None:
        self.finished = False  # adopted, or rejected so that all parameters must be requested
        self._aircraft, self._cache = aircraft, cache
        self._to = (aircraft.system, aircraft.component)
        self._cached: CachedAircraft | None = None
        self._names: list[str] = []
        self._requested_t, self._tries, self._open_count = float("-inf"), 0, -1

    @property
    def key(self) -> str:
        """Return the cache key of the aircraft; empty if its board has no number."""
        aircraft = self._aircraft
        return f"{aircraft.autopilot}-{aircraft.board_id}-{aircraft.system}" if aircraft.board_id else ""

    def requests(self, now: float) -> list[Any]:
        """Return the messages to send now; `now` is fleet time [s since 1970]."""
        if self._cached is None and self.key:
            self._begin(now)
        if not self.finished and self._cached is not None:
            self._compare(self._cached)
        open_names = self._open_names()
        if self.finished or (len(open_names) == self._open_count and now - self._requested_t < RETRY_S):
            return []
        self._tries = self._tries + 1 if len(open_names) == self._open_count else 1
        self._requested_t, self._open_count = now, len(open_names)
        if self._tries > TRIES:
            self.finished = True
            return []
        if self._cached is None:
            version = (dialect.MAV_CMD_REQUEST_MESSAGE, 0, dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION, 0, 0, 0, 0, 0, 0)
            return [dialect.MAVLink_command_long_message(*self._to, *version)]
        names = open_names[:BATCH]
        return [dialect.MAVLink_param_request_read_message(*self._to, name.encode(), -1) for name in names]

    def store(self) -> None:
        """Store parameters and mission in the cache, if complete."""
        params, route = self._aircraft.params, self._aircraft.mission
        if self.key and params.complete:
            items = route.items if route.complete else ()
            self._cache.store(self.key, CachedAircraft(dict(params.values), params.count, params.hash, items))

    def _begin(self, now: float) -> None:
        cached, request_dialect = self._cache.read(self.key), DIALECTS.get(self._aircraft.autopilot, ANY)
        if cached is None or not cached.values or (request_dialect.hash and cached.hash is None):
            self.finished = True
            return
        self._cached, self._open_count = cached, -1
        if request_dialect.probe:
            self._aircraft.mission.set_recalled(cached.items)
        self._names = (
            [request_dialect.hash] if request_dialect.hash else self._sample(cached, request_dialect.volatile, now)
        )

    def _sample(self, cached: CachedAircraft, volatile: tuple[str, ...], now: float) -> list[str]:
        """Return every parameter that a twin reads, and a random sample of the others."""
        steady = [name for name in sorted(cached.values) if not name.startswith(volatile or "\0")]
        vital = [name for name in steady if name in NAMES or name.startswith(FENCE_PREFIXES)]
        others = sorted(set(steady).difference(vital))
        return vital + random.Random(now).sample(others, min(SAMPLE_SIZE, len(others)))

    def _open_names(self) -> list[str]:
        """Return the parameters not yet received that the check needs."""
        params = self._aircraft.params
        received = {HASH_NAME} if params.hash is not None else set()
        return [name for name in self._names if name not in received and name not in params.values]

    def _compare(self, cached: CachedAircraft) -> None:
        params = self._aircraft.params
        same = all(params.values[name] == cached.values[name] for name in self._names if name in params.values)
        same &= params.hash in (None, cached.hash) and (
            not params.count or HASH_NAME in self._names or params.count == cached.count
        )
        if not same:
            self.finished = True  # another aircraft, or changed since
        elif not self._open_names():
            params.restore(cached.values | params.values, cached.count)
            self.finished = True
