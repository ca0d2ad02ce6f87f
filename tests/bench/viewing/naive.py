"""A node for every aircraft, its trail and its predicted path: what the viewer is compared with, on the same feed.

python -m tests.bench.viewing.naive --port 8090 --router tcp/127.0.0.1:17447
"""

import argparse
import sys
import threading
import time

import numpy as np
import viser

from fleet.bus.session import connect
from viewer.browser.http_server import without_stdout
from viewer.scene.strokes import chain
from viewer.store.place import scene_quat
from viewer.store.store import FleetStore
from viewer.store.vehicle import Vehicle
from viewer.theme.shapes import aircraft

TICK_S = 0.1


class Nodes:
    """Three nodes of each aircraft, moved ten times a second, its lines redrawn once."""

    def __init__(self, server: viser.ViserServer, vehicle: Vehicle) -> None:
        name = f"/uav/{vehicle.uav}"
        self.mesh = server.scene.add_mesh_simple(f"{name}/mesh", *aircraft(), color=(62, 150, 220), cast_shadow=False)
        none = np.zeros((1, 2, 3), np.float32)
        self.trail = server.scene.add_line_segments(f"{name}/trail", none, (62, 150, 220))
        self.told = server.scene.add_line_segments(f"{name}/predicted", none, (230, 237, 245))

    def move(self, vehicle: Vehicle) -> None:
        if vehicle.at is not None:
            self.mesh.position = tuple(vehicle.at)
            self.mesh.wxyz = tuple(scene_quat(*(np.array([x]) for x in vehicle.attitude))[0])

    def draw(self, vehicle: Vehicle, feed: FleetStore) -> None:
        rows = feed.track(vehicle)[-120:, 1:]
        if len(rows) > 1:
            self.trail.points = chain(rows).astype(np.float32)
        if vehicle.forecast is not None:
            self.told.points = chain(
                vehicle.forecast.position_at(np.linspace(0, vehicle.forecast.horizon_s, 30))
            ).astype(np.float32)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--router", required=True)
    args = parser.parse_args()
    stop = threading.Event()
    with connect(args.router) as bus, without_stdout():
        feed, server, nodes = FleetStore(bus), viser.ViserServer(host="127.0.0.1", port=args.port, verbose=False), {}
        print("ready", file=sys.__stdout__, flush=True)
        tick, due = 0, time.monotonic()
        while True:
            feed.poll()
            feed.poses(tuple(nodes))  # of a crowd `all` reads a part at a time; here every place is drawn every time
            with server.atomic():
                for vehicle in feed.all():
                    if vehicle.uav not in nodes:
                        nodes[vehicle.uav] = Nodes(server, vehicle)
                    nodes[vehicle.uav].move(vehicle)
                    if (tick + vehicle.uav) % 10 == 0:
                        nodes[vehicle.uav].draw(vehicle, feed)
            tick, due = tick + 1, max(due + TICK_S, time.monotonic() - TICK_S)
            stop.wait(max(due - time.monotonic(), 0.0))


if __name__ == "__main__":
    sys.exit(main())
