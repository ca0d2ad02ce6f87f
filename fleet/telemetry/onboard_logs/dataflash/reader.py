"""Reader of ArduPilot DataFlash logs, binary (.bin) or text (.log), as `OnboardLog`.

A log is read twice: first for identity, date and the best source of each field, then for its rows. Damage is skipped,
counted and reported; the rest is read. Source: ArduPilot AP_Logger.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import IO

import numpy as np

from fleet.telemetry.mavlink.onboard_log import Chunk, OnboardEvent
from fleet.telemetry.onboard_logs.dataflash import binary as dataflash_binary
from fleet.telemetry.onboard_logs.dataflash import reader as dataflash_text
from fleet.telemetry.onboard_logs.dataflash.binary import read_pieces
from fleet.telemetry.onboard_logs.dataflash.clock import LogClock
from fleet.telemetry.onboard_logs.dataflash.messages import EventExtractor
from fleet.telemetry.onboard_logs.dataflash.records import Damage, Format, Records, parse_format
from fleet.telemetry.onboard_logs.dataflash.rows import RowBuilder, SourceSelector, derived_fields
from fleet.telemetry.tables.dataflash import ROWS
from fleet.telemetry.tables.row import FieldSource
from fleet.vehicles import FIXED_WING, HELICOPTER, MULTIROTOR, QUADPLANE, UNKNOWN

_FIRMWARE = re.compile(r"\b(?:Ardu|APM:)(Plane|Copter|Rover|Sub)\b.*V?\d")
_PLANE_PARAMS = {"TRIM_ARSPD_CM", "AIRSPEED_CRUISE", "LIM_ROLL_CD", "ROLL_LIMIT_DEG", "TECS_CLMB_MAX"}
_COPTER_PARAMS = {"FRAME", "FRAME_CLASS", "ANGLE_MAX", "PILOT_THR_FILT", "WPNAV_SPEED"}
_IDENTIFYING_PARAMS = {"MAV_SYSID", "SYSID_THISMAV", "Q_ENABLE"} | _PLANE_PARAMS | _COPTER_PARAMS


class Identity:
    """Collect the identity of the aircraft from records and events."""

    def __init__(self) -> None:
        self._params: dict[str, float] = {}
        self._kind = ""
        self._frame = ""
        self._names: set[str] = set()
        self.firmware = ""

    def update(self, block: list[Records], events: list[OnboardEvent]) -> None:
        """Evaluate a block."""
        self._names.update(
            f"{records.format_.name}.{column}"
            for records in block
            for column in records.format_.columns
            if records.format_.name in ("CTUN", "MOT")
        )
        for event in events:
            if event.kind == "param" and event.value[0] in _IDENTIFYING_PARAMS:
                self._params[event.value[0]] = event.value[1]
            elif event.kind == "text":
                self._update_from_text(event.value[1])

    @property
    def system(self) -> int:
        """Return the MAVLink system id, 1 if not in the log."""
        value = self._params.get("MAV_SYSID", self._params.get("SYSID_THISMAV", 1.0))
        return int(value) if 1 <= value <= 255 else 1

    @property
    def vehicle(self) -> str:
        """Return the vehicle type as in `Status.vehicle`."""
        kind = self._kind or self._kind_from_columns()
        if kind == "Plane":
            return QUADPLANE if self._params.get("Q_ENABLE", 0.0) > 0 else FIXED_WING
        if kind == "Copter":
            return HELICOPTER if "HELI" in self._frame.upper() else MULTIROTOR
        return UNKNOWN

    def _update_from_text(self, text: str) -> None:
        if (match := _FIRMWARE.search(text)) and not self.firmware:
            self._kind, self.firmware = match[1], text
        if text.startswith("Frame:") and not self._frame:
            self._frame = text

    def _kind_from_columns(self) -> str:
        """Derive the vehicle type from its specific log columns and parameters."""
        if "CTUN.NavRoll" in self._names or self._params.keys() & _PLANE_PARAMS:
            return "Plane"
        copter = any(name.startswith("MOT.") for name in self._names) or "CTUN.ThrIn" in self._names
        return "Copter" if copter or "CTUN.ABst" in self._names or self._params.keys() & _COPTER_PARAMS else ""


Opener = Callable[[], IO[bytes]]
_HEAD_BYTES = 1 << 16  # bytes examined to distinguish binary from text
_MAX_FIXES = 64  # GPS fixes used; the median ignores stale ones
_GPS_EPOCH_S = 315_964_800.0  # 1980-01-06 since 1970 [s]
_WEEK_S = 604_800.0
_LEAP_SECONDS = ((1_483_228_800.0, 18), (1_435_708_800.0, 17), (1_341_100_800.0, 16), (0.0, 15))
"""(start [s since 1970], GPS time minus UTC [s]). Source: IERS Bulletin C."""


class DataflashLog:
    """One aircraft's DataFlash log, opened."""

    autopilot = "ardupilot"

    def __init__(self, source: Path | str | Opener, name: str = "") -> None:
        """Read identity and sources; `chunks` returns the content.

        Args:
            source: a file, or a function that opens it (for compressed files)
            name: name for messages, default the file name

        Raises:
            OSError: if it cannot be opened; check the path.
        """
        self._open: Opener = source if callable(source) else partial(_opened, Path(source))
        self.name = name = name or ("log" if callable(source) else Path(source).name)
        self.skipped: list[str] = []
        with self._open() as stream:
            head = next(dataflash_binary.read_pieces(stream, Damage("byte")), b"")[:_HEAD_BYTES]
        self._is_text = _is_text(head, name)
        self._use_gps_week = False
        selector, identity, epoch, clock = self._first_pass()
        if not np.isfinite(clock.newest_t):
            self._use_gps_week = True  # no time since boot: try the GPS time of the week
            selector, identity, epoch, clock = self._first_pass()
        self._sources = selector.select()
        self._start_t = clock.first_t if clock.first_t is not None else 0.0
        self.system, self.vehicle, self.firmware = identity.system, identity.vehicle, identity.firmware
        self.epoch_s = epoch.seconds()

    @property
    def sources(self) -> dict[str, FieldSource]:
        """Return the table row used for each field or part."""
        return dict(self._sources)

    def chunks(self) -> Iterator[Chunk]:
        """Return the log from the start; may be called repeatedly."""
        damage = self._damage()
        clock, builder, extractor = self._clock(damage), RowBuilder(self._sources), EventExtractor(self.vehicle)
        self.skipped[:] = []
        total = 0
        for block, last in self._blocks(damage):
            counts = Counter[str]()
            for records in block:
                counts[records.format_.name] += len(records)
            stamped = clock.stamp(block, last)
            events = extractor.extract(stamped, last)
            stamped = [
                extractor.executed_items(command) if command.format_.name == "CMD" else command for command in stamped
            ]
            table = builder.add_block(stamped, clock.newest_t, last)
            total += sum(counts.values())
            if counts or events or table:
                yield Chunk(table, events, dict(counts))
        self.skipped[:] = [f"{self.name}: {sentence}" for sentence in self._problems(damage, total)]

    def _problems(self, damage: Damage, total: int) -> Iterator[str]:
        if not total:
            yield "found no DataFlash message, expected an ArduPilot log; check the file"
        yield from damage.messages()
        yield from derived_fields(self._sources)

    def _first_pass(self) -> tuple[SourceSelector, Identity, "_EpochEstimator", LogClock]:
        damage = self._damage()
        clock, extractor = self._clock(damage), EventExtractor("")
        selector, identity, epoch = SourceSelector(), Identity(), _EpochEstimator()
        for block, last in self._blocks(damage):
            stamped = clock.stamp(block, last)
            identity.update(stamped, extractor.extract(stamped, last))
            selector.count(
                [extractor.executed_items(command) if command.format_.name == "CMD" else command for command in stamped]
            )
            epoch.update(stamped)
        return selector, identity, epoch, clock

    def _blocks(self, damage: Damage) -> Iterator[tuple[list[Records], bool]]:
        parser = dataflash_text if self._is_text else dataflash_binary
        for block in parser.read_blocks(self._open, damage):
            yield block, False
        yield [], True

    def _damage(self) -> Damage:
        return Damage("line" if self._is_text else "byte")

    def _clock(self, damage: Damage) -> LogClock:
        return LogClock(damage, frozenset(ROWS) - {"CMD", "MISE"}, getattr(self, "_start_t", 0.0), self._use_gps_week)


def _opened(path: Path) -> IO[bytes]:
    return path.open("rb")


def _is_text(head: bytes, name: str) -> bool:
    binary = head.find(bytes((*dataflash_binary.MAGIC, dataflash_binary.FMT)))
    text = head.find(b"FMT,")
    if binary < 0 and text < 0:
        return name.lower().removesuffix(".xz").removesuffix(".gz").endswith((".log", ".txt"))
    return binary < 0 or 0 <= text < binary


class _EpochEstimator:
    """Estimate the date of log time 0: the median of the first GPS fixes, because single fixes may be stale."""

    def __init__(self) -> None:
        self._offsets: list[float] = []

    def update(self, block: list[Records]) -> None:
        for records in block:
            if records.format_.name != "GPS" or len(self._offsets) >= _MAX_FIXES:
                continue
            names = (("GMS", "GWk"), ("TimeMS", "Week"))
            pair = next((pair for pair in names if records.has(*pair, "Status")), None)
            if pair is not None:
                ms, week = getattr(records, pair[0]), getattr(records, pair[1])
                fix = (records.Status >= 3) & (week > 1000) & (week < 10_000) & (ms >= 0) & (ms < _WEEK_S * 1e3)
                gps = _GPS_EPOCH_S + week * _WEEK_S + ms * 1e-3
                self._offsets += [
                    gps_to_utc(gps_t) - t for gps_t, t in zip(gps[fix].tolist(), records.t[fix].tolist(), strict=True)
                ]

    def seconds(self) -> float | None:
        return float(np.median(self._offsets[:_MAX_FIXES])) if self._offsets else None


def gps_to_utc(gps: float) -> float:
    """Convert GPS time to UTC [s since 1970]."""
    return next((gps - leap for since, leap in _LEAP_SECONDS if gps - leap >= since), gps)


MAX_LINE = 4096  # of a line [bytes]
MAX_FORMATS = 512
_TEXT_CODES = "nNZ"  # columns that may contain a comma


def read_blocks(opener: Callable[[], IO[bytes]], damage: Damage) -> Iterator[list[Records]]:
    """Read a log from the start: the records of each MiB, with line numbers from 1."""
    parser = TextParser(damage)
    with opener() as stream:
        for data in read_pieces(stream, damage):
            yield parser.feed(data)
    yield parser.feed(b"\n")


class TextParser:
    """Split text into messages, and group messages by format."""

    def __init__(self, damage: Damage) -> None:
        self._damage = damage
        self._carry = b""
        self._in_long_line = False  # inside a line longer than the limit
        self._line = 0
        self._formats: dict[bytes, Format] = {}
        self._collected: dict[Format, tuple[list[int], list[list[bytes]]]] = {}

    def feed(self, data: bytes) -> list[Records]:
        """Parse the next bytes; return the messages they complete."""
        lines = (self._carry + data).split(b"\n")
        self._carry = lines.pop()
        for line in lines:
            self._line += 1
            if self._in_long_line or len(line) > MAX_LINE:
                self._count_damage("lines too long")
                self._in_long_line = False
            else:
                self._parse_line(line)
        if len(self._carry) > MAX_LINE:
            self._in_long_line, self._carry = True, b""
        collected, self._collected = self._collected, {}
        return [Records(format_, np.array(places), rows) for format_, (places, rows) in collected.items()]

    def _parse_line(self, line: bytes) -> None:
        head, comma, rest = line.partition(b",")
        if not comma:
            if self._formats and line.strip():  # text before the first format is allowed
                self._count_damage("lines without message")
            return
        format_ = self._formats.get(head)
        if format_ is None:
            self._parse_other(head.strip(), rest)
            return
        cells = rest.split(b",")
        column_count = len(format_.codes)
        if len(cells) != column_count:
            if len(cells) < column_count or format_.codes[-1:] not in _TEXT_CODES:
                self._count_damage(f"lines of {format_.name} with a wrong number of columns")
                return
            cells = rest.split(b",", column_count - 1)
        places, rows = self._collected.setdefault(format_, ([], []))
        places.append(self._line)
        rows.append(cells)

    def _parse_other(self, head: bytes, rest: bytes) -> None:
        if head == b"FMT":
            self._declare_format(rest)
        elif self._formats:
            self._count_damage("lines of an unknown name")

    def _declare_format(self, rest: bytes) -> None:
        cells = [cell.decode("ascii", "replace").strip() for cell in rest.split(b",", 4)]
        if len(cells) < 4 or len(self._formats) >= MAX_FORMATS:
            self._count_damage("formats that contradict themselves")
            return
        name, codes, columns = cells[2], cells[3], cells[4] if len(cells) > 4 else ""
        if name == "FMT":
            return
        new_format = parse_format(name, codes, columns.strip(", "))
        if new_format is None:
            self._count_damage("formats that contradict themselves")
        else:
            self._formats[name.encode()] = new_format

    def _count_damage(self, kind: str) -> None:
        self._damage.count(kind, self._line)
