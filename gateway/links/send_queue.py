"""Messages on their way into a stream that may be slow: whole ones or none, and never waiting."""

import threading
from collections import deque
from collections.abc import Callable

MOST = 65_536  # bytes that may wait; at 57,600 baud that is eleven seconds


class Outbox:
    """What one stream has still to be given.

    Args:
        write: takes bytes without waiting and tells how many it took
    """

    def __init__(self, write: Callable[[bytes], int]) -> None:
        self._write = write
        self._lock = threading.Lock()  # filled by the working thread, emptied by the link's as well
        self._waiting: deque[tuple[bytes, int]] = deque()
        self._size = 0
        self._closed = False

    def put(self, data: bytes, messages: int) -> bool:
        """Queue whole messages and write what is taken; False where they found no room.

        Raises:
            OSError: when the far end is gone.
        """
        with self._lock:
            if self._closed or self._size + len(data) > MOST:
                return False
            self._waiting.append((data, messages))
            self._size += len(data)
            self._flush()
            return True

    def flush(self) -> None:
        """Write as much as is taken.

        Raises:
            OSError: when the far end is gone.
        """
        with self._lock:
            self._flush()

    def _flush(self) -> None:
        while self._waiting:
            data, messages = self._waiting[0]
            taken = self._write(data)
            self._size -= taken
            if taken < len(data):
                self._waiting[0] = data[taken:], messages
                return
            self._waiting.popleft()

    def waits(self) -> bool:
        """Return whether something waits."""
        return bool(self._waiting)

    def close(self) -> int:
        """Take no more; count the messages that still wait, the one half written included, and forget them."""
        with self._lock:
            self._closed = True
            count = sum(messages for _, messages in self._waiting)
            self._waiting.clear()
            return count
