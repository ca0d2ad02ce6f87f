"""Nothing is compiled once a worker holds aircraft: where one compiles for seconds, nobody is predicted meanwhile."""

import subprocess
import sys
from pathlib import Path

from conftest import ROOT

FLY = """
import sys
from pathlib import Path

from twin_worker.service import worker
from twin_worker.service.warm_up import warm_up

sys.path.insert(0, "tests")
import flights

folder = Path(sys.argv[1])
heard = flights.pretend(folder)  # who simulates and reads recordings has kernels of its own
warm_up()

from numba.core.dispatcher import Dispatcher

from fleet.bus.codec import encode
from fleet.contract import History, Sample
from twin_worker.ownership.handover import Snapshot, decode_snapshot, encode_snapshot
from twin_worker.ownership.history_decoder import decode_history
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
