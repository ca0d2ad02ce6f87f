"""Send a `.tlog` as MAVLink datagrams on this machine: its aircraft and copies of them."""

import contextlib
import ctypes
import ipaddress
import socket
import sys
import threading
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fleet.frames import Origin
from fleet.telemetry.mavlink.heartbeat import is_aircraft
from fleet.telemetry.mavlink.parsing.decode import IDS, Frames
from fleet.telemetry.mavlink.parsing.scan import ID, SYSTEM
from fleet.telemetry.recording.ids import IdAllocator
from fleet.telemetry.recording.opening import RecordingFile, ReplayPace
from fleet.telemetry.recording.recordings import Recording
from fleet.telemetry.recording.tlog import Tlog
from fleet.telemetry.replay.offset_copies import (
    GROUP_COUNT,
    FrameBlock,
    GridOffset,
    extract_frames,
    group_offsets,
    rewrite_frames,
)

MAX_BATCH = 1024  # datagrams per call, the system's limit
_VECTOR = np.dtype([("base", "u8"), ("size", "u8")])
_MESSAGE = np.dtype(
    {"names": ["vector", "vectors", "sent"], "formats": ["u8", "u8", "u4"], "offsets": [16, 24, 56], "itemsize": 64}
)


_SENDMMSG = getattr(ctypes.CDLL(None), "sendmmsg", None) if sys.platform.startswith("linux") else None
if _SENDMMSG is not None:
    _SENDMMSG.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int)


def send_datagrams(connection: socket.socket, data: np.ndarray, start: np.ndarray, length: np.ndarray) -> int:
    """Send datagrams on a connected socket; return the number accepted by the system.

    Args:
        connection: the socket
        data: bytes of all datagrams, (b,) uint8
        start, length: start and length of each datagram in them, (n,)
    """
    sent = 0
    if _SENDMMSG is None:
        for begin, size in zip(start.tolist(), length.tolist(), strict=True):
            with contextlib.suppress(OSError):
                connection.send(data[begin : begin + size].tobytes())
                sent += 1
        return sent
    vectors, messages = np.zeros(len(start), _VECTOR), np.zeros(len(start), _MESSAGE)
    vectors["base"], vectors["size"] = data.ctypes.data + start, length
    messages["vector"], messages["vectors"] = vectors.ctypes.data + np.arange(len(start)) * _VECTOR.itemsize, 1
    at = 0
    while at < len(start):
        batch_address = messages.ctypes.data + at * _MESSAGE.itemsize
        accepted = _SENDMMSG(connection.fileno(), batch_address, min(MAX_BATCH, len(start) - at), 0)
        # without receiver or buffer space the datagram is lost
        at, sent = at + max(accepted, 1), sent + max(accepted, 0)
    return sent


SystemFrames = tuple[np.ndarray, FrameBlock]
"""Frames of one aircraft rewritten for each copy, (n, b) uint8, and their positions; each frame is a datagram."""
STEP_S = 0.05  # recorded time between two batches of datagrams [s]


def share_out(copies: int, places: int) -> list[range]:
    """Distribute copies over destinations: the copy numbers of each."""
    return [range(place, copies, places) for place in range(places)]


def loopback_address(text: str) -> tuple[str, int]:
    """Parse HOST:PORT of this machine, with optional prefix `udpout:`.

    Raises:
        ValueError: if it is invalid, or another machine: recorded aircraft must not reach real ground stations.
    """
    host, _, port = text.removeprefix("udpout:").rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65_536:
        raise ValueError(f"--to: found {text!r}, expected HOST:PORT such as 127.0.0.1:14550; correct it")
    try:
        host_address = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_DGRAM)[0][4]
    except OSError as error:
        raise ValueError(f"--to: found {host!r}, expected a resolvable host ({error}); use 127.0.0.1") from None
    if not ipaddress.ip_address(str(host_address[0]).partition("%")[0]).is_loopback:
        raise ValueError(
            f"--to: found {text!r} on another machine, expected a loopback address such as 127.0.0.1:{port}; "
            "copies of aircraft must stay on this machine"
        )
    return str(host_address[0]), int(port)


class Broadcaster:
    """Send one telemetry log.

    Args:
        path: the recording
        speed: times real time
        numbers: copy numbers sent to this destination; 0 is the recorded aircraft
        total: number of copies at all destinations
        ids: allocator of MAVLink system ids, shared by all logs sent to one destination
    Raises:
        ValueError: if it is not a telemetry log; omit --to.
        OSError: if it cannot be read; check path and permissions.
    """

    def __init__(self, path: Path, speed: float, numbers: range, total: int, ids: IdAllocator) -> None:
        recording = Recording(path)
        if recording.suffix != ".tlog":
            raise ValueError(f"{path.name}: found a {recording.kind}, expected a telemetry log for --to; omit --to")
        self.name = path.name
        self.pace = ReplayPace(speed)
        self.sent = 0  # datagrams
        self.problem = ""
        self._source = RecordingFile(path)
        self._tlog = Tlog(self._source)
        self._numbers, self._total, self._ids = np.array(numbers), total, ids
        self._systems: dict[int, np.ndarray] = {}  # system ids of the copies, by recorded system id, (copies,)
        self._offsets: list[GridOffset] | None = None

    @property
    def share(self) -> float:
        """Return the read progress, 0..1."""
        return self._tlog.share

    def progress_text(self) -> str:
        """Return progress and send rate as text."""
        aircraft, elapsed = len(self._systems) * len(self._numbers), self.pace.elapsed_s
        rate = f", {self.sent / elapsed:,.0f} a second" if elapsed > 0 else ""
        return f"{self.pace.progress_text()}, {aircraft} aircraft, {self.sent:,} datagrams{rate}"

    def send(self, destination: tuple[str, int], stop: threading.Event) -> None:
        """Send the log until its end or until `stop` is set; errors are stored in `problem`."""
        self._source.stop = stop
        family = socket.AF_INET6 if ":" in destination[0] else socket.AF_INET
        try:
            with socket.socket(family, socket.SOCK_DGRAM) as connection:
                connection.connect(destination)
                for now, batches in self._rounds():
                    if self.pace.wait(now, stop):
                        return
                    for data, block in batches:
                        starts = np.arange(len(data))[:, None] * data.shape[1] + block.start
                        length = np.broadcast_to(block.payload - block.start + block.size + 2, starts.shape)
                        self.sent += send_datagrams(connection, data.ravel(), starts.ravel(), length.ravel())
        except (ValueError, OSError) as error:
            self.problem = str(error)
        if not self._systems and not self.problem and not stop.is_set():
            self.problem = f"{self.name}: found no aircraft in it, expected at least one heartbeat; check the file"

    def _rounds(self) -> Iterator[tuple[float, list[SystemFrames]]]:
        """Return the batches: (recorded time [s since 1970], frames to send)."""
        past: deque[list[FrameBlock]] = deque(maxlen=GROUP_COUNT)  # newest first
        sources: deque[list[int]] = deque(maxlen=GROUP_COUNT)
        first, now = np.nan, 0.0
        for frames in self._tlog.batches():
            self._register_systems(frames)
            first = float(frames.arrival[0]) if np.isnan(first) else first
            number = np.floor((frames.arrival - first) / STEP_S)
            for part in np.split(np.arange(len(number)), np.flatnonzero(np.diff(number)) + 1):
                now = first + float(number[part[0]]) * STEP_S
                systems = [int(n) for n in np.unique(frames.headers[part, SYSTEM]) if int(n) in self._systems]
                past.appendleft([extract_frames(frames, part[frames.headers[part, SYSTEM] == n]) for n in systems])
                sources.appendleft(systems)
                yield now, list(self._frames_to_send(past, sources))
        for lag in range(1, GROUP_COUNT):  # delayed copies after the end of the log
            past.appendleft([])
            sources.appendleft([])
            yield now + lag * STEP_S, list(self._frames_to_send(past, sources))

    def _frames_to_send(self, past: deque[list[FrameBlock]], sources: deque[list[int]]) -> Iterator[SystemFrames]:
        """Return the frames of the originals, and delayed frames of the copies."""
        for lag, (cuts, systems) in enumerate(zip(past, sources, strict=True)):
            for block, system in zip(cuts, systems, strict=True):
                copy_systems = self._systems[system][lag::GROUP_COUNT]
                if len(copy_systems):
                    offset = self._offsets[lag] if self._offsets is not None else None
                    yield rewrite_frames(block, copy_systems, offset), block

    def _register_systems(self, frames: Frames) -> None:
        """Register new aircraft, and allocate system ids for them and their copies."""
        new_systems: set[int] = set()
        for heartbeat in frames.messages(np.flatnonzero(frames.headers[:, ID] == IDS["HEARTBEAT"])):
            system = heartbeat.get_srcSystem()
            if system not in self._systems and system and is_aircraft(heartbeat):
                new_systems.add(system)
        system_ids = {system: [self._ids.allocate((self, system, 0), system)] for system in sorted(new_systems)}
        for copy in range(1, len(self._numbers)):
            for system, copy_ids in system_ids.items():
                copy_ids.append(self._ids.allocate((self, system, copy), copy_ids[0]))
        self._systems.update((system, np.array(mine, np.uint8)) for system, mine in system_ids.items())
        if self._offsets is None and self._total > 1:
            self._find_origin(frames)

    def _find_origin(self, frames: Frames) -> None:
        frame_numbers = np.flatnonzero(frames.headers[:, ID] == IDS["GLOBAL_POSITION_INT"])
        fields = frames.fields(frame_numbers, "GLOBAL_POSITION_INT")
        has_position = np.flatnonzero((fields.lat != 0) | (fields.lon != 0)) if len(frame_numbers) else frame_numbers
        if len(has_position):
            first = has_position[0]
            origin = Origin(int(fields.lat[first]), int(fields.lon[first]), int(fields.alt[first]))
            self._offsets = group_offsets(self._numbers, self._total, origin)
