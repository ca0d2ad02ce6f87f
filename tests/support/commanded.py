"""An aircraft that answers commands as ArduPlane or PX4 does, without physics, over a radio that loses frames."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.bus.codec import digest_of
from fleet.contract import Approval, Array, Change, Execution, Item, Option, Proposal, ProposedPath
from fleet.frames import Origin, to_geodetic
from fleet.simulator.flight.mavlink import ItemRequest, MavlinkEndpoint, ModeRequest, SpeedRequest
from fleet.simulator.flight.mavlink_messages import ARDUPLANE_MODES, DIALECTS, PX4_AUTO, PX4_MODES
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from gateway.commands.audit import AuditLog
from gateway.commands.executor import CommandExecutor
from gateway.onboard import COMPONENT, SYSTEM
from tests.support.memory_bus import MemoryBus

HOME = Origin(474_000_000, 85_000_000, 450_000)
SPEED = 20.0  # northwards [m/s]
HEIGHT = 80.0  # above home [m]
PARAMS = {"AIRSPEED_MIN": 12.0, "AIRSPEED_MAX": 25.0, "AIRSPEED_CRUISE": SPEED, "FW_AIRSPD_TRIM": SPEED}


def mission(n: int = 10, frame: int = 3, height: float = HEIGHT) -> tuple[Item, ...]:
    """Waypoints northwards, the first at home."""
    north = np.column_stack([900.0 * np.arange(n), np.zeros(n), np.full(n, -height)])
    places = to_geodetic(HOME, north).tolist()
    return tuple(
        Item(seq=k, command=16, frame=frame, lat_e7=lat, lon_e7=lon, alt_m=height)
        for k, (lat, lon, _) in enumerate(places)
    )


def raised(items: tuple[Item, ...], by: float = 30.0) -> tuple[Item, ...]:
    """The same mission higher."""
    return tuple(msgspec.structs.replace(item, alt_m=item.alt_m + by) if item.seq else item for item in items)


class CommandedAircraft:
    """Fly north at constant speed; `tick` exchanges frames with the ground."""

    def __init__(self, autopilot: str = "ardupilot", *, loss: float = 0.0, seed: int = 0, n: int = 10) -> None:
        self.endpoint = MavlinkEndpoint(1, mission(n), PARAMS, DIALECTS[autopilot])
        self.is_px4 = autopilot == "px4"
        self.mode, self.seq, self.speed = "MISSION" if self.is_px4 else "AUTO", 2, SPEED
        self.armed = True
        self.offset = np.zeros(3)  # of the flight from its line, NED [m]
        self.received: list[Any] = []  # what arrived from the ground
        self.uplink_bytes = 0  # sent to it, lost or not
        self._rng, self._loss = np.random.default_rng(seed), loss
        self._out = mav.MAVLink(None, srcSystem=1, srcComponent=1)
        self._ear = mav.MAVLink(None)
        self._ticks = 0

    @property
    def items(self) -> tuple[Item, ...]:
        """The mission on board."""
        return self.endpoint.missions.items

    def ned(self, t: float) -> np.ndarray:
        """The position at `t` since the start [s]."""
        return np.array([SPEED * t, 0.0, -HEIGHT]) + self.offset

    def tick(self, t: float, uplink: list[bytes]) -> list[bytes]:
        """Exchange frames at `t` since the start, every 0.1 s: what the ground sent, and what it receives."""
        replies: list[bytes] = []
        for frame in uplink:
            self.uplink_bytes += len(frame)
            if not self._is_lost():
                self.received += self._ear.parse_buffer(frame) or []
                replies += self.endpoint.receive(frame, t)
        self._execute()
        replies += self.endpoint.poll(t) + self._telemetry(t)
        self._ticks += 1
        return [frame for frame in replies if not self._is_lost()]

    def _execute(self) -> None:
        requests = self.endpoint.requests
        while requests:
            request = requests.popleft()
            if isinstance(request, ModeRequest):
                self.mode = request.mode
            elif isinstance(request, SpeedRequest):
                self.speed = request.speed or SPEED
            elif isinstance(request, ItemRequest):
                self.seq = request.seq
            elif self.is_px4:
                self.seq = request.seq or 0

    def _telemetry(self, t: float) -> list[bytes]:
        lat, lon, alt = to_geodetic(HOME, self.ned(t)).tolist()
        v = (round(SPEED * 100), 0, 0)
        position = mav.MAVLink_global_position_int_message(
            round(60e3 + t * 1e3), lat, lon, alt, alt - HOME.alt_mm, *v, 0
        )
        frames = [bytes(self._pack(position))]
        if self._ticks % 10 == 0:
            custom = PX4_MODES[self.mode] << 24 | PX4_AUTO << 16 if self.is_px4 else ARDUPLANE_MODES[self.mode]
            autopilot = mav.MAV_AUTOPILOT_PX4 if self.is_px4 else mav.MAV_AUTOPILOT_ARDUPILOTMEGA
            base = mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (mav.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0)
            heartbeat = mav.MAVLink_heartbeat_message(mav.MAV_TYPE_FIXED_WING, autopilot, base, custom, 4, 3)
            current = mav.MAVLink_mission_current_message(self.seq, len(self.items), 0, 0)
            frames += [bytes(self._pack(heartbeat)), bytes(self._pack(current))]
        return frames

    def _pack(self, message: Any) -> bytes:
        packed = bytes(message.pack(self._out))
        self._out.seq = (self._out.seq + 1) % 256
        return packed

    def _is_lost(self) -> bool:
        return bool(self._rng.random() < self._loss)


class StepDriver:
    """Run steps against one aircraft in virtual time."""

    def __init__(self, aircraft: CommandedAircraft) -> None:
        self.aircraft, self.t = aircraft, 0.0
        self._mav, self._ear = mav.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT), mav.MAVLink(None)
        self._ear.robust_parsing = True

    def run(self, step: Any, limit_s: float = 600.0, cut_s: float = float("inf")) -> Any:
        """Run a step to its result; the link is cut for ever `cut_s` after its start."""
        start = self.t
        while step.result is None and self.t - start < limit_s:
            cut = self.t - start >= cut_s
            uplink = [bytes(message.pack(self._mav)) for message in step.messages(self.t)]
            frames = self.aircraft.tick(self.t, [] if cut else uplink)
            for message in self._heard([] if cut else frames):
                step.receive(message, self.t)
            self.t = round(self.t + 0.1, 1)
        assert step.result is not None, "the step did not end"
        return step.result

    def _heard(self, frames: list[bytes]) -> Iterator[Any]:
        for frame in frames:
            yield from self._ear.parse_buffer(frame) or []


T0 = 1_700_000_000.0  # fleet time at the start [s since 1970]


class CommandSite:
    """A gateway that executes approved proposals, its bus and one aircraft, in virtual time."""

    def __init__(self, folder: Path, aircraft: CommandedAircraft, *, allowed: range = range(9), dry: bool = False):
        self.bus, self.aircraft, self.t = MemoryBus(), aircraft, 0.0
        self.lines: list[str] = []  # of a dry run
        self.executions: list[Execution] = []
        self.bus.subscribe(Execution, lambda message, _: self.executions.append(message))
        self.audit = AuditLog(folder / "commands.jsonl")
        self.receiver = MavlinkReceiver()
        by_uav = self.receiver._id_owners
        report = self.lines.append if dry else None
        self.executor = CommandExecutor(self.bus, by_uav, allowed.__contains__, self.audit, report)
        self._mav = mav.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
        self._uplink: list[bytes] = []
        self.run(1.0)
        self.download()
        self.run(1.0)
        known = self.receiver.aircraft[1]
        for name, value in PARAMS.items():
            known.params.set_value(name, value)
        assert known.mission.complete

    @property
    def now(self) -> float:
        """Fleet time [s since 1970]."""
        return T0 + self.t

    def download(self) -> None:
        """Let the gateway know the mission on board; nothing of it is counted."""
        requests = [mav.MAVLink_mission_request_list_message(1, 1)]
        requests += [mav.MAVLink_mission_request_int_message(1, 1, k) for k in range(len(self.aircraft.items))]
        for request in requests:
            for frame in self.aircraft.endpoint.receive(bytes(request.pack(self._mav)), self.t):
                self.receiver.receive(self.now, frame, "radio")

    def run(self, seconds: float) -> list[Execution]:
        """Run for a while; return what was published about executions meanwhile."""
        before = len(self.executions)
        for _ in range(round(seconds * 10)):
            self.t = round(self.t + 0.1, 1)
            for frame in self.aircraft.tick(self.t, self._uplink):
                self.receiver.receive(self.now, frame, "radio")
            self.executor.observe(self.receiver.flush_packed(self.now))
            self._uplink = [bytes(message.pack(self._mav)) for _, message in self.executor.tick(self.now)]
        return self.executions[before:]

    def option(self, **changes: Any) -> Option:
        """An option of the aircraft, with the path that it flies."""
        ahead = np.arange(0.0, 121.0, 2.0)
        path = np.column_stack([SPEED * ahead, np.zeros(len(ahead)), np.zeros(len(ahead))]) + self.aircraft.ned(self.t)
        half_axes = np.column_stack([8.0 + 0.5 * ahead, 8.0 + 0.2 * ahead, 6.0 + 0.1 * ahead])
        arrays = {"ahead": Array.of(ahead), "path": Array.of(path), "prediction_region_half_axes": Array.of(half_axes)}
        proposed = ProposedPath(uav=1, origin=(HOME.lat_e7, HOME.lon_e7, HOME.alt_mm), **arrays)
        paths, change = (proposed,), Change(uav=1, **changes)
        return Option(sentence="", changes=(change,), paths=paths, probability=0.01, clearance_m=90.0)

    def propose(
        self, *options: Option, name: str = "p1", valid_s: float = 15.0, present: tuple[ProposedPath, ...] = ()
    ) -> Proposal:
        """Publish a proposal as a worker does; the positions of its aircraft are observed from then on."""
        valid_until = self.now + valid_s
        proposal = Proposal(uav=1, t=self.now, id=name, options=options, present=present, valid_until=valid_until)
        self.bus.publish(proposal)
        self.run(0.2)
        return proposal

    def approval(self, shown: Proposal, **fields: Any) -> Approval:
        """The approval of the first option of a proposal; fields replace its own."""
        digest = digest_of(shown.options[0])
        own = {"uav": 1, "t": self.now, "proposal": shown.id, "digest": digest, "who": "kim"}
        return Approval(**(own | fields))

    def entries(self) -> list[dict[str, Any]]:
        """The lines of the audit."""
        return [json.loads(line) for line in self.audit.path.read_text().splitlines()]

    def events(self) -> list[str]:
        """The events of the audit."""
        return [entry["event"] for entry in self.entries()]
