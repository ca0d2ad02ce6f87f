"""Read a raw MAVLink stream without time stamps, as a serial port or a socket delivers it: frames timed by boot time.

One aircraft's `time_boot_ms` is the clock of the whole stream; a frame without it has the newest time before it.
SYSTEM_TIME gives the date.
"""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from fleet.telemetry.mavlink.parsing import scan as s
from fleet.telemetry.mavlink.parsing.decode import IDS, Decoder, Frames, find_frames
from fleet.telemetry.mavlink.parsing.received import collect_payloads
from fleet.telemetry.onboard_logs.onboard_news import DEFAULT_EPOCH_S
from fleet.telemetry.recording.opening import RecordingFile
from fleet.telemetry.recording.tlog import BACK_S, CHUNK, MAX_DAMAGE, MAX_DAMAGE_RATIO, PRESCAN_SHARE, boot_times

_SYSTEM_TIME = IDS["SYSTEM_TIME"]
_MIN_UNIX_S, _MAX_UNIX_S = 1.2e9, 4e9  # plausible GPS time
_MAX_STEP_S = 3600.0  # a larger step of boot time is a restart, or damage [s]


class MavlinkStream:
    """One opened stream.

    Args:
        source: the file
    """

    def __init__(self, source: RecordingFile) -> None:
        self.decoder = Decoder()  # its counters include skipped bytes
        self.skipped: list[str] = []
        self._source = source
        self._prescanning = True
        self._search_aborted: int | None = None

    @property
    def share(self) -> float:
        """Return the read progress, 0..1, including the search for the clock."""
        share = PRESCAN_SHARE * self._source.share
        return share if self._prescanning else PRESCAN_SHARE + (1 - PRESCAN_SHARE) * self._source.share

    def batches(self) -> Iterator[Frames]:
        """Return the frames at the boot time of one aircraft, non-decreasing."""
        clock = self._find_clock()
        self._prescanning = False
        newest = shift = np.nan
        for frames in self._frames(self.decoder):
            own = boot_times(frames)
            own[frames.headers[:, s.SYSTEM] != clock.system] = np.nan
            if np.isnan(newest):
                known = own[np.isfinite(own)]
                if not len(known):
                    continue  # nothing before the first clock can be timed
                newest, shift = float(known[0]), 0.0
            arrival, newest, shift = _continued(own, newest, shift)
            yield frames._replace(arrival=arrival + clock.offset_s)
        if np.isnan(newest):
            self.skipped.append("found no boot time in the stream, expected ATTITUDE or positions; nothing was read")
        elif clock.dated:
            self.skipped.append("no arrival times: boot time of the aircraft is used, dated by SYSTEM_TIME")
        else:
            self.skipped.append("no arrival times and no date: boot time of the aircraft is used, the year is 2000")
        if damaged := int(self.decoder.counts[s.BAD_BYTES]):
            self.skipped.append(f"{damaged} damaged bytes skipped, {int(self.decoder.counts[s.MESSAGES])} frames read")
        if self._search_aborted is not None:
            self.skipped.append(f"too much damage up to byte {self._search_aborted}, the rest was not read; split it")

    def _frames(self, decoder: Decoder) -> Iterator[Frames]:
        counts, rest, place = decoder.counts, b"", 0
        with self._source.open() as stream:
            while True:
                chunk = stream.read(CHUNK) or b""
                data = rest + chunk
                buf, parts = np.frombuffer(data, np.uint8), np.array([[0, len(data), 0]])
                headers, _, _ = find_frames(buf, parts, counts)
                done = int(parts[0, 0])
                place += done
                if len(headers):
                    yield Frames(buf, headers, np.zeros(len(headers)), np.zeros(len(headers), int))
                if not chunk:
                    counts[s.BAD_BYTES] += len(data) - done
                    return
                if counts[s.BAD_BYTES] > MAX_DAMAGE + MAX_DAMAGE_RATIO * (place - counts[s.BAD_BYTES]):
                    self._search_aborted = place
                    return
                rest = data[done:]

    def _find_clock(self) -> "_Clock":
        """Return the aircraft with the most boot times, and the date of its boot."""
        counts: Counter[int] = Counter()
        dates: dict[int, list[float]] = {}
        for frames in self._frames(Decoder()):
            systems = frames.headers[:, s.SYSTEM]
            counts.update(systems[np.isfinite(boot_times(frames))].tolist())
            for system, offset_s in _dates(frames):
                dates.setdefault(system, []).append(offset_s)
        system = counts.most_common(1)[0][0] if counts else 0
        offsets = dates.get(system, [])
        return _Clock(system, float(np.median(offsets)) if offsets else DEFAULT_EPOCH_S, bool(offsets))


class _Clock:
    """Clock of a stream: its aircraft, and fleet time minus boot time [s]."""

    def __init__(self, system: int, offset_s: float, dated: bool) -> None:
        self.system, self.offset_s, self.dated = system, offset_s, dated


def _continued(own: np.ndarray, newest: float, shift: float) -> tuple[np.ndarray, float, float]:
    """Return times that continue from `newest`: none decreases, and a restart of the clock continues without a gap."""
    out = np.empty(len(own))
    for k, t in enumerate(own.tolist()):
        if t == t:
            if not -BACK_S < t + shift - newest < _MAX_STEP_S:
                shift = newest - t
            newest = max(newest, t + shift)
        out[k] = newest
    return out, newest, shift


def _dates(frames: Frames) -> list[tuple[int, float]]:
    """Return the system and the time since 1970 minus boot time [s] of every plausible SYSTEM_TIME."""
    numbers = np.flatnonzero((frames.headers[:, s.ID] == _SYSTEM_TIME) & (frames.headers[:, s.SIZE] >= 9))
    if not len(numbers):
        return []
    headers = frames.headers[numbers]
    payloads = collect_payloads(frames.buf, headers[:, s.PAYLOAD], headers[:, s.SIZE], 12)
    unix_s = payloads[:, :8].copy().view("<u8")[:, 0] * 1e-6
    boot_s = payloads[:, 8:12].copy().view("<u4")[:, 0] * 1e-3
    valid = (unix_s > _MIN_UNIX_S) & (unix_s < _MAX_UNIX_S)
    return list(zip(headers[valid, s.SYSTEM].tolist(), (unix_s - boot_s)[valid].tolist(), strict=True))
