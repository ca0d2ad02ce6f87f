"""Send many datagrams in one call: `sendmmsg` on Linux, individually on other systems.

Source: sendmmsg(2); structures as in <sys/socket.h> of 64-bit Linux.
"""

import ctypes
import socket
import sys

import numpy as np

MAX_BATCH = 1024  # datagrams per call, the system's limit
_VECTOR = np.dtype([("base", "u8"), ("size", "u8")])
_MESSAGE = np.dtype(
    {
        "names": ["vector", "vectors", "sent"],
        "formats": ["u8", "u8", "u4"],
        "offsets": [16, 24, 56],
        "itemsize": 64,
    }
)


class DatagramSender:
    """Sender of datagrams on one connected socket."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._call = getattr(ctypes.CDLL(None), "sendmmsg", None) if sys.platform.startswith("linux") else None
        if self._call is not None:
            self._call.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int)

    def send(self, data: np.ndarray, start: np.ndarray, length: np.ndarray) -> int:
        """Send datagrams; return the number accepted by the system.

        Args:
            data: bytes of all datagrams, (b,) uint8
            start, length: start and length of each datagram in them, (n,)
        """
        if self._call is None:
            return sum(
                self._send_single(data[begin : begin + size].tobytes())
                for begin, size in zip(start.tolist(), length.tolist(), strict=True)
            )
        vectors, messages = np.zeros(len(start), _VECTOR), np.zeros(len(start), _MESSAGE)
        vectors["base"], vectors["size"] = data.ctypes.data + start, length
        messages["vector"], messages["vectors"] = vectors.ctypes.data + np.arange(len(start)) * _VECTOR.itemsize, 1
        at = sent = 0
        while at < len(start):
            batch_address = messages.ctypes.data + at * _MESSAGE.itemsize
            accepted = self._call(self._socket.fileno(), batch_address, min(MAX_BATCH, len(start) - at), 0)
            # without receiver or buffer space the datagram is lost
            at, sent = at + max(accepted, 1), sent + max(accepted, 0)
        return sent

    def _send_single(self, datagram: bytes) -> int:
        try:
            self._socket.send(datagram)
        except OSError:
            return 0
        return 1
