"""Reader of ArduPilot DataFlash logs, binary (.bin) or text (.log), as `OnboardLog`.

A log is read twice: first for identity, date and the best source of each field, then for its rows. Damage is skipped,
counted and reported; the rest is read. Source: ArduPilot AP_Logger.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import IO

import numpy as np

from fleet.telemetry.mavlink.onboard_log import Chunk
from fleet.telemetry.onboard_logs.dataflash import binary as dataflash_binary
from fleet.telemetry.onboard_logs.dataflash import text as dataflash_text
from fleet.telemetry.onboard_logs.dataflash.clock import Clock
from fleet.telemetry.onboard_logs.dataflash.identity import Identity
from fleet.telemetry.onboard_logs.dataflash.messages import Talk
from fleet.telemetry.onboard_logs.dataflash.records import Damage, Records
from fleet.telemetry.onboard_logs.dataflash.rows import Rows, Survey, origins
from fleet.telemetry.tables.dataflash import ROWS
from fleet.telemetry.tables.row import Row

Opener = Callable[[], IO[bytes]]
_HEAD = 1 << 16  # bytes examined to distinguish binary from text
_FIXES = 64  # GPS fixes used; the median ignores stale ones
_GPS_EPOCH_S = 315_964_800.0  # 1980-01-06 since 1970 [s]
_WEEK_S = 604_800.0
_LEAPS = ((1_483_228_800.0, 18), (1_435_708_800.0, 17), (1_341_100_800.0, 16), (0.0, 15))
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
            head = next(dataflash_binary.pieces(stream, Damage("byte")), b"")[:_HEAD]
        self._is_text = _is_text(head, name)
        self._weekly = False
        survey, identity, epoch, clock = self._survey()
        if not np.isfinite(clock.newest):
            self._weekly = True  # no time since boot: try the GPS time of the week
            survey, identity, epoch, clock = self._survey()
        self._sources = survey.chosen()
        self._start = clock.first if clock.first is not None else 0.0
        self.system, self.vehicle, self.firmware = identity.system, identity.vehicle, identity.firmware
        self.epoch_s = epoch.seconds()

    @property
    def sources(self) -> dict[str, Row]:
        """Return the table row used for each field or part."""
        return dict(self._sources)

    def chunks(self) -> Iterator[Chunk]:
        """Return the log from the start; may be called repeatedly."""
        damage = self._damage()
        clock, rows, talk = self._clock(damage), Rows(self._sources), Talk(self.vehicle)
        self.skipped[:] = []
        total = 0
        for block, last in self._blocks(damage):
            counts = Counter[str]()
            for records in block:
                counts[records.form.name] += len(records)
            stamped = clock.stamp(block, last)
            said = talk.take(stamped, last)
            stamped = [talk.carried_out(r) if r.form.name == "CMD" else r for r in stamped]
            table = rows.take(stamped, clock.newest, last)
            total += sum(counts.values())
            if counts or said or table:
                yield Chunk(table, said, dict(counts))
        self.skipped[:] = [f"{self.name}: {sentence}" for sentence in self._sentences(damage, total)]

    def _sentences(self, damage: Damage, total: int) -> Iterator[str]:
        if not total:
            yield "found no DataFlash message, expected an ArduPilot log; check the file"
        yield from damage.sentences()
        yield from origins(self._sources)

    def _survey(self) -> tuple[Survey, Identity, "_Epoch", Clock]:
        damage = self._damage()
        clock, talk = self._clock(damage), Talk("")
        survey, identity, epoch = Survey(), Identity(), _Epoch()
        for block, last in self._blocks(damage):
            stamped = clock.stamp(block, last)
            identity.look(stamped, talk.take(stamped, last))
            survey.look([talk.carried_out(r) if r.form.name == "CMD" else r for r in stamped])
            epoch.look(stamped)
        return survey, identity, epoch, clock

    def _blocks(self, damage: Damage) -> Iterator[tuple[list[Records], bool]]:
        form = dataflash_text if self._is_text else dataflash_binary
        for block in form.blocks(self._open, damage):
            yield block, False
        yield [], True

    def _damage(self) -> Damage:
        return Damage("line" if self._is_text else "byte")

    def _clock(self, damage: Damage) -> Clock:
        return Clock(damage, frozenset(ROWS) - {"CMD", "MISE"}, getattr(self, "_start", 0.0), self._weekly)


def _opened(path: Path) -> IO[bytes]:
    return path.open("rb")


def _is_text(head: bytes, name: str) -> bool:
    binary = head.find(bytes((*dataflash_binary.MAGIC, dataflash_binary.FMT)))
    text = head.find(b"FMT,")
    if binary < 0 and text < 0:
        return name.lower().removesuffix(".xz").removesuffix(".gz").endswith((".log", ".txt"))
    return binary < 0 or 0 <= text < binary


class _Epoch:
    """Estimate the date of log time 0: the median of the first GPS fixes, because single fixes may be stale."""

    def __init__(self) -> None:
        self._found: list[float] = []

    def look(self, block: list[Records]) -> None:
        for r in block:
            if r.form.name != "GPS" or len(self._found) >= _FIXES:
                continue
            names = (("GMS", "GWk"), ("TimeMS", "Week"))
            pair = next((pair for pair in names if r.has(*pair, "Status")), None)
            if pair is not None:
                ms, week = getattr(r, pair[0]), getattr(r, pair[1])
                fix = (r.Status >= 3) & (week > 1000) & (week < 10_000) & (ms >= 0) & (ms < _WEEK_S * 1e3)
                gps = _GPS_EPOCH_S + week * _WEEK_S + ms * 1e-3
                self._found += [utc(g) - t for g, t in zip(gps[fix].tolist(), r.t[fix].tolist(), strict=True)]

    def seconds(self) -> float | None:
        return float(np.median(self._found[:_FIXES])) if self._found else None


def utc(gps: float) -> float:
    """Convert GPS time to UTC [s since 1970]."""
    return next((gps - leap for since, leap in _LEAPS if gps - leap >= since), gps)
