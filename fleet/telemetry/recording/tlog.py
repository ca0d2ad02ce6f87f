"""Read a `.tlog` as timed frames in batches, tolerant of truncation, damage and backlogs.

A .tlog repeats: 8 bytes big-endian microseconds since 1970, one MAVLink frame.
"""

from collections.abc import Iterator

import numpy as np

from fleet.telemetry.mavlink.parsing import scan as s
from fleet.telemetry.mavlink.parsing.decode import IDS, Decoder, Frames, frames_of
from fleet.telemetry.mavlink.parsing.payload_gather import gather
from fleet.telemetry.recording.opening import Source

CHUNK = 1 << 20
HOPELESS = 1 << 25  # damaged bytes, beyond `_MAX_DAMAGE_RATIO` times the good ones, that end reading
_WORSE = 4
LOOK = 0.1  # fraction of the work before the first frame is returned
BACK_S = 1.0  # a larger step back is a clock adjustment and is removed [s]
BACKLOG_S = 5.0  # a larger variation of arrival minus boot time is a backlog [s]
_BOOT_FIRST = [IDS[name] for name in ("ATTITUDE", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT")]


class Tlog:
    """One opened telemetry log.

    Args:
        source: the file
    """

    def __init__(self, source: Source) -> None:
        self.decoder = Decoder()  # its counters include skipped bytes
        self.skipped: list[str] = []
        self._source = source
        self._looking = True
        self.tangled: int | None = None  # file offset at which reading ended

    @property
    def share(self) -> float:
        """Return the read progress, 0..1, including the search for a backlog."""
        return LOOK * self._source.share if self._looking else LOOK + (1 - LOOK) * self._source.share

    def batches(self) -> Iterator[Frames]:
        """Return the frames in flight time; boot time replaces the arrival of a backlog."""
        offset_s = backlog_offset(self._batches(Decoder()))
        batches = self._batches(self.decoder)
        yield from batches if offset_s is None else restamped(batches, offset_s)
        if bad := int(self.decoder.counts[s.BAD_BYTES]):
            read = int(self.decoder.counts[s.MESSAGES])
            where = f", the first near byte {self._first_bad}" if self._first_bad is not None else ""
            self.skipped.append(f"{bad} damaged bytes skipped{where}, {read} frames read")
        if self.tangled is not None:
            self.skipped.append(f"too much damage up to byte {self.tangled}, the rest was not read; split it")

    def _batches(self, decoder: Decoder) -> Iterator[Frames]:
        """Return the frames with the arrival in the file, corrected to be non-decreasing."""
        counts, self._first_bad = decoder.counts, None
        rest, last_t, place, line = b"", np.nan, 0, Line()
        with self._source.open() as stream:
            self._looking = decoder is not self.decoder
            while True:
                chunk = stream.read(CHUNK) or b""
                told = rest + chunk
                buf, parts, before = (
                    np.frombuffer(told, np.uint8),
                    np.array([[0, len(told), 0]]),
                    int(counts[s.BAD_BYTES]),
                )
                at, stamps, last_t = frames_of(buf, parts, counts, s.STAMP, last_t)
                done = int(parts[0, 0])
                if chunk and len(at) > 1:  # hold back the last frame: its successor is needed to check its stamp
                    done, last_t = int(at[-1, s.START]) - s.STAMP, stamps[-2]
                    at, stamps = at[:-1], stamps[:-1]
                    counts[s.MESSAGES] -= 1
                if counts[s.BAD_BYTES] > before and self._first_bad is None:
                    self._first_bad = place
                place += done
                if len(at):
                    yield Frames(buf, at, line.straight(stamps * 1e-6), np.zeros(len(at), int))
                if not chunk:
                    counts[s.BAD_BYTES] += len(told) - done
                    return
                if counts[s.BAD_BYTES] > HOPELESS + _WORSE * (place - counts[s.BAD_BYTES]):
                    self.tangled = place
                    return
                rest = told[done:]


class Line:
    """Correct the recorder's clock: remove single wrong stamps and steps back."""

    def __init__(self) -> None:
        self._raw: float | None = None  # newest stamp in the file [s]
        self._latest = -np.inf  # newest time returned [s]
        self._shift = 0.0  # offset added to the stamps [s]

    def straight(self, t: np.ndarray) -> np.ndarray:
        """Return non-decreasing times for the stamps in the file, (n,) [s]."""
        raw = despiked(np.concatenate([[t[0] if self._raw is None else self._raw], t]))
        steps = np.diff(raw)
        shifts = self._shift + np.cumsum(np.where(steps < -BACK_S, -steps, 0.0))
        out = np.maximum.accumulate(np.maximum(raw[1:] + shifts, self._latest))
        self._raw, self._latest, self._shift = float(raw[-1]), float(out[-1]), float(shifts[-1])
        return out


def despiked(t: np.ndarray) -> np.ndarray:
    """Replace single stamps that differ from both neighbours by more than `BACK_S`, (n,) [s]."""
    t = t.copy()
    before, after = t[:-2], t[2:]
    high = (t[1:-1] > after + BACK_S) & (t[1:-1] > before + BACK_S) & (after >= before - BACK_S)
    low = (t[1:-1] < before - BACK_S) & (t[1:-1] < after - BACK_S) & (after >= before - BACK_S)
    t[1:-1] = np.where(high | low, before, t[1:-1])
    return t


def boot_s(frames: Frames) -> np.ndarray:
    """Return `time_boot_ms` of the messages that begin with it [s]; nan for all others, (n,)."""
    own = np.full(len(frames.at), np.nan)
    for number in _BOOT_FIRST:
        which = np.flatnonzero((frames.at[:, s.ID] == number) & (frames.at[:, s.SIZE] >= 4))
        laid = gather(frames.buf, frames.at[which, s.PAYLOAD], frames.at[which, s.SIZE], 4)
        own[which] = laid.view("<u4")[:, 0] * 1e-3
    return own


def backlog_offset(batches: Iterator[Frames]) -> float | None:
    """Return fleet time minus boot time of a recording with a backlog [s]; None if arrival times are valid.

    A radio that transmits a backlog compresses minutes of flight to seconds of arrival: arrival - boot falls by more
    than a radio delay. Applies only to a single aircraft whose clock never steps back.
    """
    least, most, newest = np.inf, -np.inf, -np.inf
    systems: set[int] = set()
    for frames in batches:
        own = boot_s(frames)
        told = np.isfinite(own)
        if not told.any():
            continue
        systems.update(np.unique(frames.at[told, s.SYSTEM]).tolist())
        times = np.concatenate([[newest], own[told]])
        if len(systems) > 1 or (times[1:] < np.maximum.accumulate(times)[:-1] - BACK_S).any():
            return None
        newest = times.max()
        delay = frames.arrival[told] - own[told]
        least, most = min(least, delay.min()), max(most, delay.max())
    return float(least) if most - least > BACKLOG_S else None


def restamped(batches: Iterator[Frames], offset_s: float) -> Iterator[Frames]:
    """Set the arrival of every frame to the newest boot time before it plus `offset_s`."""
    newest = np.nan
    for frames in batches:
        own = boot_s(frames)
        if np.isnan(newest) and np.isfinite(own).any():
            newest = own[np.isfinite(own)][0]
        if np.isfinite(newest):
            own = np.fmax.accumulate(np.concatenate([[newest], own]))[1:]
            newest = own[-1]
            yield frames._replace(arrival=own + offset_s)
        else:
            yield frames._replace(arrival=np.full(len(own), frames.arrival[0]))
