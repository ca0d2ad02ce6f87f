"""Websocket clients that receive as a browser does, and count."""

import contextlib
import threading
import time

import msgspec
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (300.0, -300.0, 300.0),
    "fov": 0.87,
    "near": 0.1,
    "far": 5000.0,
    "image_height": 720,
    "image_width": 1280,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}


class Watcher:
    """One client; what it received is counted and thrown away."""

    def __init__(self, port: int) -> None:
        self.received = self.frames = 0  # bytes, and messages of the socket
        self.first_s = float("nan")  # until the first frame came [s]
        protocol = f"viser-v{viser.__version__}"
        self._began = time.monotonic()
        self._socket = connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None, compression=None)
        self._socket.send(msgspec.msgpack.encode(CAMERA))
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()

    def _receive(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            self._count()

    def _count(self) -> None:
        for frame in self._socket:
            if not self.frames:
                self.first_s = time.monotonic() - self._began
            self.received += len(frame)
            self.frames += 1

    def close(self) -> None:
        """Leave."""
        self._socket.close()
        self._thread.join(timeout=5)
