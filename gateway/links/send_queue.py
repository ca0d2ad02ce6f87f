"""Send queue of a stream: complete messages or none, without waiting."""

import threading
from collections import deque
from collections.abc import Callable

MAX_BYTES = 65_536  # capacity in bytes; eleven seconds at 57,600 baud


class SendQueue:
    """Send queue of one stream.

    Args:
        write: writes bytes without waiting and returns how many were written
    """

    def __init__(self, write: Callable[[bytes], int]) -> None:
        self._write = write
        self._lock = threading.Lock()  # written to by the main thread and the link's thread
        self._waiting: deque[tuple[bytes, int]] = deque()
        self._size = 0
        self._closed = False

    def put(self, data: bytes, messages: int) -> bool:
        """Queue complete messages and write as much as possible; return False if they do not fit.

        Raises:
            OSError: when the peer is disconnected.
        """
        with self._lock:
            if self._closed or self._size + len(data) > MAX_BYTES:
                return False
            self._waiting.append((data, messages))
            self._size += len(data)
            self._flush()
            return True

    def flush(self) -> None:
        """Write as much as possible.

        Raises:
            OSError: when the peer is disconnected.
        """
        with self._lock:
            self._flush()

    def _flush(self) -> None:
        while self._waiting:
            data, messages = self._waiting[0]
            written = self._write(data)
            self._size -= written
            if written < len(data):
                self._waiting[0] = data[written:], messages
                return
            self._waiting.popleft()

    def has_data(self) -> bool:
        """Return whether the queue has data."""
        return bool(self._waiting)

    def close(self) -> int:
        """Close and clear the queue; return the number of messages lost, a partly written one included."""
        with self._lock:
            self._closed = True
            count = sum(messages for _, messages in self._waiting)
            self._waiting.clear()
            return count
