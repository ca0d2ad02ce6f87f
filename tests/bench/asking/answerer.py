"""A worker of the bench: our `Worker` as it answers, whose aircraft are predicted anew once a second."""

import sys
import time

import msgspec
import numpy as np

from fleet.bus.session import connect
from fleet.cli import stop_on_signal
from fleet.contract import Array, Controller, Prediction, TwinState
from twin_worker.confidence.tube_and_horizon import AHEAD
from twin_worker.ownership.twin_store import OwnedTwin
from twin_worker.service.worker import Worker
from twin_worker.twin.step import Twin

_EVERY_S = 1.0  # between predictions of an aircraft [s]
_SAID = "hybrid/arduplane/fixed_wing/known, adapted to 24 own predictions"


def prediction(uav: int) -> Prediction:
    """Make one up, as long as a real one with law and parameters."""
    path = np.column_stack([22.0 * AHEAD, 3.0 * AHEAD, -100.0 - 0.1 * AHEAD])
    known = {f"PARAMETER_{k:03d}": 0.1 * k for k in range(24)}
    return Prediction(
        uav=uav, t=time.time(), state=TwinState.PREDICTING, method="hybrid", origin=(470_000_000, 80_000_000, 500_000),
        ahead=Array.of(AHEAD), path=Array.of(path),
        prediction_region_half_axes=Array.of(0.05 * path), quantile=0.9, horizon_s=42.0,
        calibration=_SAID, sentence="flown with defaults", law="arduplane: L1 + TECS",
        controller=Controller(law="arduplane: L1 + TECS", received=known),
    )  # fmt: skip


def main(router: str, low: int, high: int) -> None:
    """Answer until told to stop."""
    stop = stop_on_signal()
    with connect(router) as bus:
        worker = Worker(bus, range(low, high), omega=0.0)
        for uav in range(low, high):
            twin = Twin.of(uav)
            twin.prediction.latest = prediction(uav)
            worker._owned[uav] = OwnedTwin(twin, worker.ownership.state.acquire(uav, int(time.time() * 1e3)))
        worker.ownership.threaded = True
        worker.connect()
        size = len(msgspec.msgpack.encode(worker._owned[low].twin.prediction.latest))
        print(f"{size} bytes a prediction", flush=True)
        while not stop.wait(_EVERY_S):
            for held in worker.owned_twins():
                held.twin.prediction.latest = msgspec.structs.replace(held.twin.prediction.latest, t=time.time())


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
