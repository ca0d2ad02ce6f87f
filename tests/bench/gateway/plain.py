"""The plain loop to measure against: recvfrom, pymavlink, a dict, msgpack, a put per aircraft every 0.1 s.

python -m tests.bench.gateway.plain PORT ROUTER
"""

import socket
import sys
import time
from collections import defaultdict
from typing import Any

import msgpack
from pymavlink.dialects.v20 import ardupilotmega as mav

from fleet.bus.bus_protocol import key_of
from fleet.bus.codec import encoding
from fleet.bus.session import connect
from fleet.contract import Sample
from fleet.telemetry.tables.mavlink import TABLE

FIELDS = {row.message: mav.mavlink_map[number].fieldnames for row in TABLE for number in mav.mavlink_map
          if mav.mavlink_map[number].msgname == row.message}  # fmt: skip
TICK_S, TELL_S = 0.1, 1.0


def main() -> int:
    ear = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    ear.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
    ear.bind(("127.0.0.1", int(sys.argv[1])))
    ear.settimeout(TICK_S)
    parser = mav.MAVLink(None)
    parser.robust_parsing = True
    rows: dict[int, dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
    heard, tick, tell = 0, time.monotonic(), time.monotonic()
    publishers: dict[int, Any] = {}
    with connect(sys.argv[2]) as bus:
        while True:
            try:
                data = ear.recv(65_535)
            except TimeoutError:
                data = b""
            for message in parser.parse_buffer(data) or ():
                heard += 1
                name = message.get_type()
                if name in FIELDS:
                    told = [getattr(message, field) for field in FIELDS[name]]
                    rows[message.get_srcSystem()][name].append(told)
            now = time.monotonic()
            if now >= tick + TICK_S:
                tick = now
                for uav, mine in rows.items():
                    if uav not in publishers:
                        name = key_of(Sample, uav)
                        publishers[uav] = bus._session.declare_publisher(name, encoding=encoding(Sample))
                    publishers[uav].put(msgpack.packb(mine))
                rows.clear()
            if now >= tell + TELL_S:
                tell = now
                print(heard, flush=True)


if __name__ == "__main__":
    sys.exit(main())
