"""Read a `.tlog` as timed frames in batches, tolerant of truncation, damage and backlogs.

A .tlog repeats: 8 bytes big-endian microseconds since 1970, one MAVLink frame.
"""

from collections.abc import Iterator

import numpy as np

from fleet.telemetry.mavlink.parsing import scan as s
from fleet.telemetry.mavlink.parsing.decode import IDS, Decoder, Frames, find_frames
from fleet.telemetry.mavlink.parsing.received import collect_payloads
from fleet.telemetry.recording.opening import RecordingFile

CHUNK = 1 << 20
MAX_DAMAGE = 1 << 25  # damaged bytes, beyond `MAX_DAMAGE_RATIO` times the good ones, that end reading
MAX_DAMAGE_RATIO = 4
PRESCAN_SHARE = 0.1  # fraction of the work before the first frame is returned
BACK_S = 1.0  # a larger step back is a clock adjustment and is removed [s]
BACKLOG_S = 5.0  # a larger variation of arrival minus boot time is a backlog [s]
_BOOT_TIME_IDS = [IDS[name] for name in ("ATTITUDE", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT")]


class Tlog:
    """One opened telemetry log.

    Args:
        source: the file
    """

    def __init__(self, source: RecordingFile) -> None:
        self.decoder = Decoder()  # its counters include skipped bytes
        self.skipped: list[str] = []
        self._source = source
        self._prescanning = True
        self.search_aborted: int | None = None  # file offset at which reading ended

    @property
    def share(self) -> float:
        """Return the read progress, 0..1, including the search for a backlog."""
        share = self._source.share
        return PRESCAN_SHARE * share if self._prescanning else PRESCAN_SHARE + (1 - PRESCAN_SHARE) * share

    def batches(self) -> Iterator[Frames]:
        """Return the frames in flight time; boot time replaces the arrival of a backlog."""
        offset_s = backlog_offset(self._batches(Decoder()))
        batches = self._batches(self.decoder)
        yield from batches if offset_s is None else restamped(batches, offset_s)
        if damaged := int(self.decoder.counts[s.BAD_BYTES]):
            frame_count = int(self.decoder.counts[s.MESSAGES])
            where = f", the first near byte {self._first_bad}" if self._first_bad is not None else ""
            self.skipped.append(f"{damaged} damaged bytes skipped{where}, {frame_count} frames read")
        if self.search_aborted is not None:
            self.skipped.append(f"too much damage up to byte {self.search_aborted}, the rest was not read; split it")

    def _batches(self, decoder: Decoder) -> Iterator[Frames]:
        """Return the frames with the arrival in the file, corrected to be non-decreasing."""
        counts, self._first_bad = decoder.counts, None
        rest, last_t, place, corrector = b"", np.nan, 0, StampCorrector()
        with self._source.open() as stream:
            self._prescanning = decoder is not self.decoder
            while True:
                chunk = stream.read(CHUNK) or b""
                data, damaged_before = rest + chunk, int(counts[s.BAD_BYTES])
                buf, parts = np.frombuffer(data, np.uint8), np.array([[0, len(data), 0]])
                headers, stamps, last_t = find_frames(buf, parts, counts, s.STAMP_SIZE, last_t)
                done = int(parts[0, 0])
                if chunk and len(headers) > 1:  # hold back the last frame: its successor is needed to check its stamp
                    done, last_t = int(headers[-1, s.START]) - s.STAMP_SIZE, stamps[-2]
                    headers, stamps = headers[:-1], stamps[:-1]
                    counts[s.MESSAGES] -= 1
                if counts[s.BAD_BYTES] > damaged_before and self._first_bad is None:
                    self._first_bad = place
                place += done
                if len(headers):
                    yield Frames(buf, headers, corrector.correct(stamps * 1e-6), np.zeros(len(headers), int))
                if not chunk:
                    counts[s.BAD_BYTES] += len(data) - done
                    return
                if counts[s.BAD_BYTES] > MAX_DAMAGE + MAX_DAMAGE_RATIO * (place - counts[s.BAD_BYTES]):
                    self.search_aborted = place
                    return
                rest = data[done:]


class StampCorrector:
    """Correct the recorder's clock: remove single wrong stamps and steps back."""

    def __init__(self) -> None:
        self._raw: float | None = None  # newest stamp in the file [s]
        self._latest = -np.inf  # newest time returned [s]
        self._shift = 0.0  # offset added to the stamps [s]

    def correct(self, t: np.ndarray) -> np.ndarray:
        """Return non-decreasing times for the stamps in the file, (n,) [s]."""
        raw = remove_spikes(np.concatenate([[t[0] if self._raw is None else self._raw], t]))
        steps = np.diff(raw)
        shifts = self._shift + np.cumsum(np.where(steps < -BACK_S, -steps, 0.0))
        out = np.maximum.accumulate(np.maximum(raw[1:] + shifts, self._latest))
        self._raw, self._latest, self._shift = float(raw[-1]), float(out[-1]), float(shifts[-1])
        return out


def remove_spikes(t: np.ndarray) -> np.ndarray:
    """Replace single stamps that differ from both neighbours by more than `BACK_S`, (n,) [s]."""
    t = t.copy()
    previous, following = t[:-2], t[2:]
    high = (t[1:-1] > following + BACK_S) & (t[1:-1] > previous + BACK_S) & (following >= previous - BACK_S)
    low = (t[1:-1] < previous - BACK_S) & (t[1:-1] < following - BACK_S) & (following >= previous - BACK_S)
    t[1:-1] = np.where(high | low, previous, t[1:-1])
    return t


def boot_times(frames: Frames) -> np.ndarray:
    """Return `time_boot_ms` of the messages that begin with it [s]; nan for all others, (n,)."""
    boot_t = np.full(len(frames.headers), np.nan)
    for number in _BOOT_TIME_IDS:
        frame_numbers = np.flatnonzero((frames.headers[:, s.ID] == number) & (frames.headers[:, s.SIZE] >= 4))
        starts, sizes = frames.headers[frame_numbers, s.PAYLOAD], frames.headers[frame_numbers, s.SIZE]
        boot_t[frame_numbers] = collect_payloads(frames.buf, starts, sizes, 4).view("<u4")[:, 0] * 1e-3
    return boot_t


def backlog_offset(batches: Iterator[Frames]) -> float | None:
    """Return fleet time minus boot time of a recording with a backlog [s]; None if arrival times are valid.

    A radio that transmits a backlog compresses minutes of flight to seconds of arrival: arrival - boot falls by more
    than a radio delay. Applies only to a single aircraft whose clock never steps back.
    """
    min_delay, max_delay, newest = np.inf, -np.inf, -np.inf
    systems: set[int] = set()
    for frames in batches:
        boot_t = boot_times(frames)
        has_boot_time = np.isfinite(boot_t)
        if not has_boot_time.any():
            continue
        systems.update(np.unique(frames.headers[has_boot_time, s.SYSTEM]).tolist())
        times = np.concatenate([[newest], boot_t[has_boot_time]])
        if len(systems) > 1 or (times[1:] < np.maximum.accumulate(times)[:-1] - BACK_S).any():
            return None
        newest = times.max()
        delay = frames.arrival[has_boot_time] - boot_t[has_boot_time]
        min_delay, max_delay = min(min_delay, delay.min()), max(max_delay, delay.max())
    return float(min_delay) if max_delay - min_delay > BACKLOG_S else None


def restamped(batches: Iterator[Frames], offset_s: float) -> Iterator[Frames]:
    """Set the arrival of every frame to the newest boot time before it plus `offset_s`."""
    newest = np.nan
    for frames in batches:
        boot_t = boot_times(frames)
        if np.isnan(newest) and np.isfinite(boot_t).any():
            newest = boot_t[np.isfinite(boot_t)][0]
        if np.isfinite(newest):
            boot_t = np.fmax.accumulate(np.concatenate([[newest], boot_t]))[1:]
            newest = boot_t[-1]
            yield frames._replace(arrival=boot_t + offset_s)
        else:
            yield frames._replace(arrival=np.full(len(boot_t), frames.arrival[0]))
