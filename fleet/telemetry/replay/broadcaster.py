"""Send a `.tlog` as MAVLink datagrams on this machine: its aircraft and copies of them."""

import ipaddress
import socket
import threading
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fleet.frames import Origin
from fleet.telemetry.mavlink.heartbeat import is_aircraft
from fleet.telemetry.mavlink.parsing.decode import IDS, Frames
from fleet.telemetry.mavlink.parsing.scan import ID, SYSTEM
from fleet.telemetry.recording.ids import Ids
from fleet.telemetry.recording.opening import Source
from fleet.telemetry.recording.pace import Pace
from fleet.telemetry.recording.recordings import Recording
from fleet.telemetry.recording.tlog import Tlog
from fleet.telemetry.replay.offset import Aside
from fleet.telemetry.replay.offset_copies import GROUPS
from fleet.telemetry.replay.rewrite_frames import Cut, cut, recast
from fleet.telemetry.replay.send_batch import Volley

Said = tuple[np.ndarray, Cut]
"""Frames of one aircraft rewritten for each copy, (n, b) uint8, and their positions; each frame is a datagram."""
STEP_S = 0.05  # recorded time between two batches of datagrams [s]
MOST_ON_A_LINK = 250  # system ids 1 to 250; higher ones are for ground stations


def shared(copies: int, places: int) -> list[range]:
    """Distribute copies over destinations: the copy numbers of each."""
    return [range(place, copies, places) for place in range(places)]


def address(text: str) -> tuple[str, int]:
    """Parse HOST:PORT of this machine, with optional prefix `udpout:`.

    Raises:
        ValueError: if it is invalid, or another machine: recorded aircraft must not reach real ground stations.
    """
    host, _, port = text.removeprefix("udpout:").rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65_536:
        raise ValueError(f"--to: found {text!r}, expected HOST:PORT such as 127.0.0.1:14550; correct it")
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_DGRAM)[0][4]
    except OSError as error:
        raise ValueError(f"--to: found {host!r}, expected a resolvable host ({error}); use 127.0.0.1") from None
    if not ipaddress.ip_address(str(found[0]).partition("%")[0]).is_loopback:
        raise ValueError(
            f"--to: found {text!r} on another machine, expected a loopback address such as 127.0.0.1:{port}; "
            "copies of aircraft must stay on this machine"
        )
    return str(found[0]), int(port)


class Airing:
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

    def __init__(self, path: Path, speed: float, numbers: range, total: int, ids: Ids) -> None:
        recording = Recording(path)
        if recording.suffix != ".tlog":
            raise ValueError(f"{path.name}: found a {recording.kind}, expected a telemetry log for --to; omit --to")
        self.name = path.name
        self.pace = Pace(speed)
        self.sent = 0  # datagrams
        self.trouble = ""
        self._source = Source(path)
        self._tlog = Tlog(self._source)
        self._numbers, self._total, self._ids = np.array(numbers), total, ids
        self._systems: dict[int, np.ndarray] = {}  # system ids of the copies, by recorded system id, (copies,)
        self._asides: list[Aside] | None = None

    @property
    def share(self) -> float:
        """Return the read progress, 0..1."""
        return self._tlog.share

    def words(self) -> str:
        """Return progress and send rate as text."""
        aircraft, took = len(self._systems) * len(self._numbers), self.pace.took_s
        rate = f", {self.sent / took:,.0f} a second" if took > 0 else ""
        return f"{self.pace.words()}, {aircraft} aircraft, {self.sent:,} datagrams{rate}"

    def send(self, to: tuple[str, int], stop: threading.Event) -> None:
        """Send the log until its end or until `stop` is set; errors are stored in `problem`."""
        self._source.stop = stop
        family = socket.AF_INET6 if ":" in to[0] else socket.AF_INET
        try:
            with socket.socket(family, socket.SOCK_DGRAM) as out:
                out.connect(to)
                volley = Volley(out)
                for now, said in self._rounds():
                    if self.pace.wait(now, stop):
                        return
                    for told, one in said:
                        at = np.arange(len(told))[:, None] * told.shape[1] + one.start
                        length = np.broadcast_to(one.payload - one.start + one.size + 2, at.shape)
                        self.sent += volley.send(told.ravel(), at.ravel(), length.ravel())
        except (ValueError, OSError) as error:
            self.trouble = str(error)
        if not self._systems and not self.trouble and not stop.is_set():
            self.trouble = f"{self.name}: found no aircraft in it, expected at least one heartbeat; check the file"

    def _rounds(self) -> Iterator[tuple[float, list[Said]]]:
        """Return the batches: (recorded time [s since 1970], frames to send)."""
        past: deque[list[Cut]] = deque(maxlen=GROUPS)  # newest first
        sources: deque[list[int]] = deque(maxlen=GROUPS)
        first, now = np.nan, 0.0
        for frames in self._tlog.batches():
            self._meet(frames)
            first = float(frames.arrival[0]) if np.isnan(first) else first
            number = np.floor((frames.arrival - first) / STEP_S)
            for part in np.split(np.arange(len(number)), np.flatnonzero(np.diff(number)) + 1):
                now = first + float(number[part[0]]) * STEP_S
                systems = [int(n) for n in np.unique(frames.at[part, SYSTEM]) if int(n) in self._systems]
                past.appendleft([cut(frames, part[frames.at[part, SYSTEM] == n]) for n in systems])
                sources.appendleft(systems)
                yield now, list(self._said(past, sources))
        for lag in range(1, GROUPS):  # delayed copies after the end of the log
            past.appendleft([])
            sources.appendleft([])
            yield now + lag * STEP_S, list(self._said(past, sources))

    def _said(self, past: deque[list[Cut]], sources: deque[list[int]]) -> Iterator[Said]:
        """Return the frames of the originals, and delayed frames of the copies."""
        for lag, (cuts, systems) in enumerate(zip(past, sources, strict=True)):
            for one, system in zip(cuts, systems, strict=True):
                cast = self._systems[system][lag::GROUPS]
                if len(cast):
                    aside = self._asides[lag] if self._asides is not None else None
                    yield recast(one, cast, aside), one

    def _meet(self, frames: Frames) -> None:
        """Register new aircraft, and allocate system ids for them and their copies."""
        new: set[int] = set()
        for heartbeat in frames.messages(np.flatnonzero(frames.at[:, ID] == IDS["HEARTBEAT"])):
            system = heartbeat.get_srcSystem()
            if system not in self._systems and system and is_aircraft(heartbeat):
                new.add(system)
        cast = {system: [self._ids.give((self, system, 0), system)] for system in sorted(new)}
        for copy in range(1, len(self._numbers)):
            for system, mine in cast.items():
                mine.append(self._ids.give((self, system, copy), mine[0]))
        self._systems.update((system, np.array(mine, np.uint8)) for system, mine in cast.items())
        if self._asides is None and self._total > 1:
            self._find_place(frames)

    def _find_place(self, frames: Frames) -> None:
        which = np.flatnonzero(frames.at[:, ID] == IDS["GLOBAL_POSITION_INT"])
        fields = frames.fields(which, "GLOBAL_POSITION_INT")
        known = np.flatnonzero((fields.lat != 0) | (fields.lon != 0)) if len(which) else which
        if len(known):
            at = known[0]
            origin = Origin(int(fields.lat[at]), int(fields.lon[at]), int(fields.alt[at]))
            self._asides = [Aside(self._numbers[lag::GROUPS], self._total, origin) for lag in range(GROUPS)]
