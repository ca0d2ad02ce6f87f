"""Link to one peer over a stream, reopened after every failure: `tcp` and `serial`."""

import logging
import queue
import selectors
import threading
from collections.abc import Hashable, Sequence

from gateway.links.backoff import BackOff
from gateway.links.link import POLL_S, Batch, BatchWriter
from gateway.links.stream import Stream, enqueue, open_stream
from gateway.settings.link_spec import LinkSpec

_log = logging.getLogger(__name__)


class StreamClient:
    """TCP client or serial line; messages sent while it is down are counted, not stored."""

    def __init__(self, spec: LinkSpec) -> None:
        self.spec = spec
        self.dropped = self.unsent = 0
        self.known_peers: Sequence[Hashable] = (spec.text,)  # the peer; the same after every reconnection
        self._stream: Stream | None = None
        self._thread: threading.Thread | None = None

    def start(self, number: int, out: "queue.Queue[Batch]", stop: threading.Event) -> None:
        """Connect and receive in a thread."""
        outlet = BatchWriter(number, out, self)
        self._thread = threading.Thread(target=self._run, args=(outlet, stop), name=self.spec.text)
        self._thread.start()

    def _run(self, outlet: BatchWriter, stop: threading.Event) -> None:
        back_off, logged = BackOff(), ""
        while not stop.is_set():
            try:
                stream = self._stream = open_stream(self.spec.kind, self.spec.address, self.spec.port)
                try:
                    _log.info("link %s: open", self.spec.text)
                    logged = ""
                    self._receive(stream, outlet, back_off, stop)
                finally:
                    self._stream = None
                    stream.close()
                    self.unsent += stream.send_queue.close()
            except OSError as error:
                reason = error.strerror or str(error)
                if reason != logged:
                    _log.warning("link %s: %s; trying again", self.spec.text, reason)
                    logged = reason
                back_off.wait(stop)

    def _receive(self, stream: Stream, outlet: BatchWriter, back_off: BackOff, stop: threading.Event) -> None:
        """Receive until `stop` is set or the peer disconnects, which raises an OSError."""
        read, both = selectors.EVENT_READ, selectors.EVENT_READ | selectors.EVENT_WRITE
        with selectors.DefaultSelector() as ready:
            ready.register(stream, read)
            while not stop.is_set():
                ready.modify(stream, both if stream.send_queue.has_data() else read)
                for _, events in ready.select(POLL_S):
                    if events & selectors.EVENT_WRITE:
                        stream.send_queue.flush()
                    if events & selectors.EVENT_READ and (data := stream.read()):
                        back_off.reset()
                        outlet.piece(self.spec.text, data)

    def send(self, where: Hashable, data: bytes, messages: int = 1) -> None:
        """Send to the peer, if it is connected and the send queue has space."""
        self.unsent += enqueue(self._stream, data, messages)

    def close(self) -> None:
        """Wait for the thread, which closes the stream."""
        if self._thread is not None:
            self._thread.join()
