"""A MAVLink voice for tests: packs messages as one system; and ears for what the intake makes of them."""

import math

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.contract import COLUMNS, Item, Mission, Params, Sample
from fleet.simulator.flight.mavlink import MavlinkEndpoint
from fleet.telemetry.mavlink.parsing.decode import Decoder
from fleet.telemetry.mavlink.parsing.received import ReceivedBytes

T0 = 1_700_000_000.0  # fleet time at which the tests begin [s since 1970]
PLANE, ARDU = mav.MAV_TYPE_FIXED_WING, mav.MAV_AUTOPILOT_ARDUPILOTMEGA
AUTO = 10
ITEMS = tuple(Item(seq=i, command=16, lat_e7=470_000_000 + i, lon_e7=80_000_000, alt_m=50.0 + i) for i in range(12))


class Talker:
    """Pack messages as one MAVLink system, sequence numbers running."""

    def __init__(self, system: int = 7, component: int = 1) -> None:
        self._mav = mav.MAVLink(None, srcSystem=system, srcComponent=component)

    def pack(self, *messages, v1: bool = False) -> bytes:
        out = b""
        for message in messages:
            out += bytes(message.pack(self._mav, force_mavlink1=v1))
            self._mav.seq = (self._mav.seq + 1) % 256
        return out

    def heartbeat(self, kind: int = PLANE, autopilot: int = ARDU, base: int = 0x81, custom: int = AUTO) -> bytes:
        return self.pack(mav.MAVLink_heartbeat_message(kind, autopilot, base, custom, 4, 3))

    def attitude(self, boot_s: float, phi: float = 0.1) -> bytes:
        return self.pack(mav.MAVLink_attitude_message(round(boot_s * 1e3) % 2**32, phi, 0.2, 0.3, 0.01, 0.02, 0.03))

    def count(self, n: int) -> bytes:
        return self.pack(mav.MAVLink_mission_count_message(255, 190, n))

    def item(
        self, seq: int, command: int = 16, *, x: int = 470000000, y: int = 80000000, z: float = 50.0, p1: float = 0
    ):
        return self.pack(mav.MAVLink_mission_item_int_message(255, 190, seq, 3, command, 0, 1, p1, 0, 0, 0, x, y, z))

    def mission(self, *items) -> bytes:
        return self.count(len(items)) + b"".join(items)

    def param(self, name: str, value: float, index: int = 65535, count: int = 0, kind: int = 9) -> bytes:
        return self.pack(mav.MAVLink_param_value_message(name.encode(), value, kind, count, index))


class Ears:
    """Hear whole messages in whatever bytes come."""

    def __init__(self):
        self.decoder = Decoder()

    def feed(self, data: bytes) -> list:
        frames = self.decoder.decode(ReceivedBytes.from_pieces([(T0, None, data)]))
        return frames.messages(np.arange(len(frames.headers)))


def of(kind, messages, uav=None) -> list:
    """Pick messages of one class, and of one aircraft where it is named."""
    return [m for m in messages if isinstance(m, kind) and uav in (None, m.uav)]


def assert_finite(news):
    assert math.isfinite(news.t)
    if isinstance(news, Sample):
        for field in COLUMNS:
            rows = getattr(news, field)
            if rows is not None:
                assert np.isfinite(rows.t.numpy()).all()
                assert np.isfinite(rows.x.numpy()).all()
                assert (np.diff(rows.t.numpy()) > 0).all()
    elif isinstance(news, Params):
        assert all(map(math.isfinite, news.values.values()))
    elif isinstance(news, Mission):
        for i in news.items:
            assert all(map(math.isfinite, (i.param1, i.param2, i.param3, i.param4, i.alt_m)))


class Aircraft:
    """A pretend aircraft's voice on a radio that loses a share of everything, both ways."""

    def __init__(self, loss, silent=(), system=7):
        self.voice = MavlinkEndpoint(system, ITEMS, {f"P{i:03d}": float(i) for i in range(300)})
        self.talker = Talker(system)
        self._loss, self._silent = loss, silent
        self._rng = np.random.default_rng(4)
        self.asked: list = []
        self._ears = Ears()

    def hear(self, data: bytes, t: float) -> list[bytes]:
        if self._rng.random() < self._loss:
            return []
        (question,) = self._ears.feed(data)
        self.asked.append((t, question))
        if question.get_type() in self._silent:
            return []
        return self._lossy(self.voice.receive(data, t))

    def stream(self) -> list[bytes]:
        return self._lossy(self.voice.stream_parameters(20))

    def _lossy(self, frames: list[bytes]) -> list[bytes]:
        return [frame for frame in frames if self._rng.random() >= self._loss]

    def names(self) -> list[str]:
        return [question.get_type() for _, question in self.asked]
