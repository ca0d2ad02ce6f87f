"""Read recordings of all kinds as messages of their aircraft, in order of recorded time."""

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fleet.telemetry.mavlink.aircraft_link import AircraftLink
from fleet.telemetry.mavlink.intake import MavlinkReceiver, TelemetryMessage
from fleet.telemetry.mavlink.onboard_log import OnboardLog
from fleet.telemetry.mavlink.parsing.decode import find_frames
from fleet.telemetry.mavlink.parsing.scan import COUNTER_COUNT, STAMP_SIZE, START, STOP
from fleet.telemetry.mavlink.steps import MAX_GAPS, SILENT_STEPS, STEP_S, ReplaySteps
from fleet.telemetry.onboard_logs.columns.reader import TableLog
from fleet.telemetry.onboard_logs.dataflash.reader import DataflashLog
from fleet.telemetry.onboard_logs.onboard_news import DEFAULT_EPOCH_S, aircraft_of, log_steps
from fleet.telemetry.onboard_logs.ulog.reader import UlogLog
from fleet.telemetry.recording.fleet_log import MAGIC, find_records
from fleet.telemetry.recording.fleet_news import BusMessageReader
from fleet.telemetry.recording.opening import COMPRESSED, RecordingFile
from fleet.telemetry.recording.options import NO_OPTIONS, RecordingOptions
from fleet.telemetry.recording.stream import MavlinkStream
from fleet.telemetry.recording.tlog import Tlog

KINDS = {
    ".tlog": "telemetry log",
    ".bin": "DataFlash log",
    ".log": "DataFlash text log",
    ".ulg": "ULog",
    ".parauav": "fleet recording",
    ".mavlink": "MAVLink stream",
    ".csv": "table",
    ".tar": "archive of tables",
    ".mat": "MATLAB file",
    ".mcap": "ROS 2 bag (MCAP)",
    ".db3": "ROS 2 bag (SQLite)",
}
_ALIASES = {".raw": ".mavlink", ".rlog": ".mavlink", ".tgz": ".tar"}
_UNREADABLE = {
    ".px4log": "the log format of PX4 before 2016 (SDLOG2), which is not read; convert it with sdlog2_dump.py to CSV",
    ".bag": "a ROS 1 bag, which is not read; convert it with rosbags-convert to MCAP",
    ".h5": "an HDF5 file, which is not read; save the tables as CSV",
}
_MAGICS = {
    b"ULog\x01\x12": ".ulg",
    MAGIC: ".parauav",
    b"\x89MCAP0\r\n": ".mcap",
    b"SQLite format 3\0": ".db3",
    b"MATLAB 5.0": ".mat",
    b"MATLAB 7.3": ".mat",
}
_BY_CONTENT = (".mavlink", ".mcap", ".db3", ".tar")  # kinds that a name alone does not prove
_HEAD_BYTES = 1 << 16  # bytes examined to detect the kind
_MAX_AT_ONCE = 500_000  # maximum frames at one recorded time

_logger = logging.getLogger("parauav.recordings")


class Recording:
    """One opened recording: its kind, its aircraft, and its unreadable parts.

    Args:
        path: a recording of one of `KINDS`, possibly compressed
        offset: UAV id = MAVLink system id + offset; in a fleet recording, recorded id + offset
        options: mission, parameters and column map from files
    Raises:
        ValueError: if it is not a recording, or empty; check the file.
        OSError: if it cannot be opened; check the path.
    """

    def __init__(self, path: Path | str, offset: int = 0, options: RecordingOptions = NO_OPTIONS) -> None:
        self.options, self._supplement = options, options.supplement()
        self.source = RecordingFile(path)
        self.name, self.offset = self.source.name, offset
        self._notes: list[str] = []
        self.suffix = self._detect_suffix()
        self.aircraft: dict[int, AircraftLink] = {}  # by UAV id, filled while reading
        self._reader: OnboardLog | Tlog | MavlinkStream | BusMessageReader | None = None

    @property
    def kind(self) -> str:
        """Return the kind of recording."""
        return KINDS[self.suffix]

    @property
    def share(self) -> float:
        """Return the read progress, 0..1."""
        return self._reader.share if isinstance(self._reader, Tlog | MavlinkStream) else self.source.share

    def progress_text(self) -> str:
        """Return the current activity."""
        return "reading"

    @property
    def skipped(self) -> list[str]:
        """Return messages on skipped parts and assumptions; complete after reading to the end."""
        problems = [*self._notes, *(self._reader.skipped if self._reader else ()), self.source.problem]
        return [f"{self.name}: {sentence.removeprefix(f'{self.name}: ')}" for sentence in problems if sentence]

    def steps(self, results: bool = False) -> Iterator[tuple[float, list[Any]]]:
        """Return the recording in steps of 0.1 s: (end of the step [s since 1970], messages).

        Args:
            results: include recorded messages of the workers
        Raises:
            ValueError: if it has no messages; check the file.
        """
        steps: Iterator[tuple[float, list[Any]]]
        if self.suffix == ".parauav":
            self._reader = BusMessageReader(self.source, self.offset)
            steps = self._reader.steps(results)
        else:
            steps = self._mavlink() if self.suffix in (".tlog", ".mavlink") else self._onboard()
        count = 0
        for now, news in steps:
            count += len(news)
            yield now, [*self._supplement.apply(news)]
        if not count:
            problems = "; ".join(self.skipped) or f"{self.name}: found no aircraft in it"
            raise ValueError(f"{problems}; expected the {self.kind} of a flight; check the file")

    def _mavlink(self) -> Iterator[tuple[float, list[TelemetryMessage]]]:
        self._reader = tlog = Tlog(self.source) if self.suffix == ".tlog" else MavlinkStream(self.source)
        receiver = MavlinkReceiver(self.offset)
        steps = ReplaySteps(receiver.collect)
        frames_at_once = left_out = 0  # frames at the current time, and frames beyond the limit
        for frames in tlog.batches():
            frames_at_once += len(frames.headers)
            if frames_at_once > _MAX_AT_ONCE:
                left_out += len(frames.headers)
            else:
                receiver.process(frames)
            self.aircraft.update((link.uav, link) for link in receiver.aircraft.values())
            for step in steps.until(frames.arrival):
                frames_at_once = 0
                yield step
        if steps.gaps > MAX_GAPS:
            silences = f"{steps.gaps} silences of over {SILENT_STEPS * STEP_S:.0f} s"
            self._notes.append(f"{silences}, more than {MAX_GAPS}: the later ones are skipped")
        if left_out:
            limit = f"over {_MAX_AT_ONCE:,} in {STEP_S} s, more than any radio carries"
            self._notes.append(f"{left_out} frames skipped: {limit}")
        yield from steps.remaining()

    def _onboard(self) -> Iterator[tuple[float, list[TelemetryMessage]]]:
        self._reader = log = self._open_log()
        link = aircraft_of(log, self.offset)
        self.aircraft[link.uav] = link
        if log.epoch_s is None:
            self._notes.append(f"no date in it: times count from {DEFAULT_EPOCH_S:.0f} s since 1970, the year 2000")
        yield from log_steps(log, link)

    def _open_log(self) -> OnboardLog:
        if self.suffix in (".csv", ".tar", ".mat"):
            return TableLog(self.source.open, self.source.path, self.options.columns)
        if self.suffix in (".mcap", ".db3"):
            from fleet.telemetry.onboard_logs.ros2 import reader  # loads libraries that nothing else needs

            return (reader.McapLog if self.suffix == ".mcap" else reader.SqliteBagLog)(self.source.open, self.name)
        return _READERS[self.suffix](self.source.open, self.name)

    def _detect_suffix(self) -> str:
        with self.source.open() as stream:
            head = stream.read(_HEAD_BYTES) or b""
        path = self.source.path
        by_name = (path.with_suffix("") if path.suffix in COMPRESSED else path).suffix.lower()
        if not head:
            raise ValueError(f"{self.name}: {self.source.problem or 'is empty'}; expected a recording; check the file")
        named, by_name = by_name, _ALIASES.get(by_name, by_name)
        if refused := _UNREADABLE.get(".px4log" if _is_sdlog2(head) else by_name):
            raise ValueError(f"{self.name}: found {refused}")
        by_content = _suffix_by_content(head)
        if by_content and named in KINDS and by_content != by_name:
            self._notes.append(f"is a {KINDS[by_content]} by its content, in spite of its name; read as such")
        if not by_content and by_name in _BY_CONTENT:
            by_name = ""
        if not by_content and by_name not in KINDS:
            kinds = ", ".join(f"{KINDS[suffix]} ({suffix})" for suffix in KINDS)
            raise ValueError(f"{self.name}: found no recording in it, expected one of {kinds}; convert it")
        return by_content or by_name


def _is_sdlog2(head: bytes) -> bool:
    """Return whether the formats are those of PX4's SDLOG2, which ArduPilot shares but for the message TIME."""
    return head.startswith(b"\xa3\x95\x80") and b"TIMEQ" in head.replace(b"\0", b"") and b"StartTime" in head


def _suffix_by_content(head: bytes) -> str:
    """Return the suffix that matches the content, or an empty string."""
    for magic, suffix in _MAGICS.items():
        if head.startswith(magic):
            return suffix
    if head[257:262] == b"ustar":
        return ".tar"
    buf = np.frombuffer(head, np.uint8)
    headers, _, _ = find_frames(buf, np.array([[0, len(head), 0]]), np.zeros(COUNTER_COUNT, np.int64), STAMP_SIZE)
    matched_bytes = {
        ".tlog": int((headers[:, STOP] - headers[:, START]).sum()) + STAMP_SIZE * len(headers),
        ".bin": 89 * head.count(b"\xa3\x95\x80"),
        ".parauav": sum(stop - start for start, stop in find_records(head)),
        ".log": sum(len(line) for line in head.split(b"\n") if line.startswith((b"FMT,", b"PARM,"))),
    }
    best = max(matched_bytes, key=matched_bytes.__getitem__)
    if best == ".tlog" or not matched_bytes[best]:
        stream, _, _ = find_frames(buf, np.array([[0, len(head), 0]]), np.zeros(COUNTER_COUNT, np.int64), 0)
        streamed = int((stream[:, STOP] - stream[:, START]).sum())
        if streamed > 2 * matched_bytes[".tlog"]:
            return ".mavlink"
    return best if matched_bytes[best] else ""


_READERS: dict[str, Callable[..., OnboardLog]] = {
    ".bin": DataflashLog,
    ".log": DataflashLog,
    ".ulg": UlogLog,
}


def replay_messages(
    path: Path | str,
    offset: int = 0,
    aircraft: dict[int, AircraftLink] | None = None,
    skipped: list[str] | None = None,
    options: RecordingOptions = NO_OPTIONS,
) -> Iterator[TelemetryMessage]:
    """Read a recording as the gateway would receive it, in time order; fleet time is recorded time.

    Args:
        path: a recording of one of `KINDS`, possibly compressed
        offset: UAV id = MAVLink system id + offset
        aircraft: filled with the state of each aircraft, by UAV id
        skipped: filled with messages on skipped parts at the end
        options: mission, parameters and column map from files
    Raises:
        ValueError: if it is not a recording; check the file.
        OSError: if it cannot be opened; check the path.
    """
    recording = Recording(path, offset, options)
    if aircraft is not None:
        recording.aircraft = aircraft
    for _, messages in recording.steps():
        yield from messages
    for sentence in recording.skipped:
        _logger.warning(sentence)
    if skipped is not None:
        skipped += recording.skipped
