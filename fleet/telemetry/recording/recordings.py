"""Read recordings of all kinds as messages of their aircraft, in order of recorded time."""

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fleet.telemetry.mavlink.aircraft_link import Craft
from fleet.telemetry.mavlink.intake import Intake, News
from fleet.telemetry.mavlink.onboard_log import OnboardLog
from fleet.telemetry.mavlink.parsing.decode import frames_of
from fleet.telemetry.mavlink.parsing.scan import COUNTS, STAMP, START, STOP
from fleet.telemetry.mavlink.steps import MOST_GAPS, SILENT_STEPS, STEP_S, Steps
from fleet.telemetry.onboard_logs.dataflash.reader import DataflashLog
from fleet.telemetry.onboard_logs.onboard_news import UNDATED_S, craft_of, log_steps
from fleet.telemetry.onboard_logs.ulog.reader import UlogLog
from fleet.telemetry.recording.fleet_log import MAGIC, sound
from fleet.telemetry.recording.fleet_news import FleetNews
from fleet.telemetry.recording.opening import COMPRESSED, Source
from fleet.telemetry.recording.tlog import Tlog

KINDS = {
    ".tlog": "telemetry log",
    ".bin": "DataFlash log",
    ".log": "DataFlash text log",
    ".ulg": "ULog",
    ".parauav": "fleet recording",
}
_HEAD = 1 << 16  # bytes examined to detect the kind
_MOST_AT_ONCE = 500_000  # maximum frames at one recorded time

_log = logging.getLogger("parauav.recordings")


class Recording:
    """One opened recording: its kind, its aircraft, and its unreadable parts.

    Args:
        path: a recording of one of `KINDS`, possibly compressed
        offset: UAV id = MAVLink system id + offset; in a fleet recording, recorded id + offset
    Raises:
        ValueError: if it is not a recording, or empty; check the file.
        OSError: if it cannot be opened; check the path.
    """

    def __init__(self, path: Path | str, offset: int = 0) -> None:
        self.source = Source(path)
        self.name, self.offset = self.source.name, offset
        self._told: list[str] = []
        self.suffix = self._recognise()
        self.crafts: dict[int, Craft] = {}  # by UAV id, filled while reading
        self._opened: OnboardLog | Tlog | FleetNews | None = None

    @property
    def kind(self) -> str:
        """Return the kind of recording."""
        return KINDS[self.suffix]

    @property
    def share(self) -> float:
        """Return the read progress, 0..1."""
        return self._opened.share if isinstance(self._opened, Tlog) else self.source.share

    def words(self) -> str:
        """Return the current activity."""
        return "reading"

    @property
    def skipped(self) -> list[str]:
        """Return messages on skipped parts and assumptions; complete after reading to the end."""
        found = [*self._told, *(self._opened.skipped if self._opened else ()), self.source.trouble]
        return [f"{self.name}: {sentence.removeprefix(f'{self.name}: ')}" for sentence in found if sentence]

    def steps(self, results: bool = False) -> Iterator[tuple[float, list[Any]]]:
        """Return the recording in steps of 0.1 s: (end of the step [s since 1970], messages).

        Args:
            results: include recorded messages of the workers
        Raises:
            ValueError: if it has no messages; check the file.
        """
        steps: Iterator[tuple[float, list[Any]]]
        if self.suffix == ".parauav":
            self._opened = FleetNews(self.source, self.offset)
            steps = self._opened.steps(results)
        else:
            steps = self._mavlink() if self.suffix == ".tlog" else self._onboard()
        count = 0
        for now, news in steps:
            count += len(news)
            yield now, news
        if not count:
            said = "; ".join(self.skipped) or f"{self.name}: found no aircraft in it"
            raise ValueError(f"{said}; expected the {self.kind} of a flight; check the file")

    def _mavlink(self) -> Iterator[tuple[float, list[News]]]:
        self._opened = tlog = Tlog(self.source)
        intake = Intake(self.offset)
        steps = Steps(intake.take)
        waiting = left_out = 0  # frames at the current time, and frames beyond the limit
        for frames in tlog.batches():
            waiting += len(frames.at)
            if waiting > _MOST_AT_ONCE:
                left_out += len(frames.at)
            else:
                intake.digest(frames)
            self.crafts.update((craft.uav, craft) for craft in intake.crafts.values())
            for step in steps.upto(frames.arrival):
                waiting = 0
                yield step
        if steps.gaps > MOST_GAPS:
            self._told.append(
                f"{steps.gaps} silences of over {SILENT_STEPS * STEP_S:.0f} s, more than {MOST_GAPS}: "
                "the later ones are skipped"
            )
        if left_out:
            self._told.append(
                f"{left_out} frames skipped: over {_MOST_AT_ONCE:,} in {STEP_S} s, more than any radio carries"
            )
        yield from steps.last()

    def _onboard(self) -> Iterator[tuple[float, list[News]]]:
        self._opened = log = _READERS[self.suffix](self.source.open, self.name)
        craft = craft_of(log, self.offset)
        self.crafts[craft.uav] = craft
        if log.epoch_s is None:
            self._told.append(f"no date in it: times count from {UNDATED_S:.0f} s since 1970, the year 2000")
        yield from log_steps(log, craft)

    def _recognise(self) -> str:
        """Detect the kind by the content, else by the file name."""
        with self.source.open() as stream:
            head = stream.read(_HEAD) or b""
        path = self.source.path
        named = (path.with_suffix("") if path.suffix in COMPRESSED else path).suffix.lower()
        if not head:
            raise ValueError(f"{self.name}: {self.source.trouble or 'is empty'}; expected a recording; check the file")
        found = _by_content(head)
        if found and named in KINDS and found != named:
            self._told.append(f"is a {KINDS[found]} by its content, in spite of its name; read as such")
        if not found and named not in KINDS:
            kinds = ", ".join(f"{KINDS[suffix]} ({suffix})" for suffix in KINDS)
            raise ValueError(f"{self.name}: found no recording in it, expected one of {kinds}; convert it")
        return found or named


def _by_content(head: bytes) -> str:
    """Return the suffix that matches the content, or an empty string."""
    if head.startswith(b"ULog\x01\x12"):
        return ".ulg"
    if head.startswith(MAGIC):
        return ".parauav"
    buf = np.frombuffer(head, np.uint8)
    at, _, _ = frames_of(buf, np.array([[0, len(head), 0]]), np.zeros(COUNTS, np.int64), STAMP)
    found = {
        ".tlog": int((at[:, STOP] - at[:, START]).sum()) + STAMP * len(at),
        ".bin": 89 * head.count(b"\xa3\x95\x80"),
        ".parauav": sum(stop - start for start, stop in sound(head)),
        ".log": sum(map(len, [line for line in head.split(b"\n") if line.startswith((b"FMT,", b"PARM,"))])),
    }
    best = max(found, key=lambda suffix: found[suffix])
    return best if found[best] else ""


_READERS: dict[str, Callable[..., OnboardLog]] = {".bin": DataflashLog, ".log": DataflashLog, ".ulg": UlogLog}


def replay_messages(
    path: Path | str, offset: int = 0, crafts: dict[int, Craft] | None = None, skipped: list[str] | None = None
) -> Iterator[News]:
    """Read a recording as the gateway would receive it, in time order; fleet time is recorded time.

    Args:
        path: a recording of one of `KINDS`, possibly compressed
        offset: UAV id = MAVLink system id + offset
        aircraft: filled with the state of each aircraft, by UAV id
        skipped: filled with messages on skipped parts at the end
    Raises:
        ValueError: if it is not a recording; check the file.
        OSError: if it cannot be opened; check the path.
    """
    recording = Recording(path, offset)
    if crafts is not None:
        recording.crafts = crafts
    for _, news in recording.steps():
        yield from news
    for sentence in recording.skipped:
        _log.warning(sentence)
    if skipped is not None:
        skipped += recording.skipped
