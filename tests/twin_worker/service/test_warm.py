"""Nothing is compiled once a worker holds aircraft: where one compiles for seconds, nobody is predicted meanwhile."""

import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

FLY = """
import sys
from pathlib import Path

import pytest

from twin_worker.service import worker
from twin_worker.service.warm_up import warm_up

from tests.support import flights

folder = Path(sys.argv[1])
heard = flights.pretend(folder)  # who simulates and reads recordings has kernels of its own
warm_up()

from numba.core.dispatcher import Dispatcher

from fleet.bus.codec import encode
from fleet.contract import History, Sample
from twin_worker.ownership.handover import Snapshot, decode_snapshot, encode_snapshot
from twin_worker.ownership.cold_start import decode_history
from twin_worker.twin.state.state import ingest

ours = [name for name in sys.modules if name.startswith(("twin_worker", "fleet"))]
kernels = {f"{name}.{key}": one for name in ours for key, one in vars(sys.modules[name]).items()
           if isinstance(one, Dispatcher)}
before = {name: len(one.signatures) for name, one in kernels.items()}
twin, _ = flights.learnt(folder)
twin = decode_snapshot(encode_snapshot(Snapshot(twin)), twin.config.uav).twin
past = tuple(one for one in heard if isinstance(one, Sample))[-100:]
ingest(twin, decode_history(encode(History(uav=twin.config.uav, t=past[-1].t, samples=past))))
print(len(kernels), *(name for name, one in kernels.items() if len(one.signatures) != before[name]))
"""


def test_a_flight_and_a_takeover_compile_nothing(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", FLY, str(tmp_path)], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    kernels, *compiled = done.stdout.split()
    assert int(kernels) > 100 and compiled == []


RECEIVE = """
import socket, sys

from fleet.telemetry.mavlink import warm
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from gateway.links.receive import BatchReceiver

from numba.core.dispatcher import Dispatcher

from tests.support.talker import Talker

inlet, air = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
inlet.bind(("127.0.0.1", 0))
warm.warm_up()
source, intake, t = BatchReceiver(inlet), MavlinkReceiver(), 0.0
kernels = {f"{name}.{key}": one for name in sys.modules if name.startswith(("fleet", "gateway"))
           for key, one in vars(sys.modules[name]).items() if isinstance(one, Dispatcher)}
before = {name: len(one.signatures) for name, one in kernels.items()}
talker = Talker(7)
for data in (talker.heartbeat(), talker.attitude(1.0) * 3, b"\\xfd\\x09junk" * 40, talker.attitude(1.1)[:15],
             talker.heartbeat() + talker.param("P1", 1.0, 0, 1) + talker.attitude(1.2)[:-1]):
    for number in range(3):
        air.sendto(data, inlet.getsockname())
    while (received := source.receive()) is not None:
        t += 0.1
        intake.receive_batch(received)
        intake.flush_packed(float(received.arrival[-1]) + 1.0)
compiled = [name for name, one in kernels.items() if len(one.signatures) != before[name]]
print(len(kernels), len(intake.aircraft), *compiled)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="recvmmsg exists on Linux only")
def test_sound_and_damaged_datagrams_compile_nothing() -> None:
    done = subprocess.run([sys.executable, "-c", RECEIVE], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    kernels, aircraft, *compiled = done.stdout.split()
    assert int(kernels) > 10 and int(aircraft) == 1 and compiled == []
