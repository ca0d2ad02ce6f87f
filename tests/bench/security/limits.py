"""Attempts to fill, lock out or upset gateway and page, each beside a rightful use of the same thing."""

import contextlib
import resource
import socket
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import Empty, Queue

import msgspec
import viser
from viser import _messages
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from fleet.telemetry.mavlink.intake import SILENCE_LIMIT_S, MavlinkReceiver
from gateway.link_spec import read_spec
from gateway.links.link import Batch
from gateway.links.tcp_listener import MOST, TcpListener
from gateway.record.tape import RETRY_S, DiskBudget, TlogWriter
from tests.support.talker import T0, Talker
from viewer.browser.http_server import VIOLATION, serve, stop_server

from . import hostile
from .site import PATIENCE_S, free_port
from .trying import Admitted, until

HELLO = Talker().heartbeat()


def silent_callers() -> str:
    """Take every place of a TCP port and say nothing; a rightful caller comes after them."""
    out, stop = Queue[Batch](), threading.Event()
    port = free_port()
    link = TcpListener(read_spec(f"tcpin:127.0.0.1:{port}"))
    with contextlib.ExitStack() as held:
        held.callback(link.close)
        held.callback(stop.set)
        link.start(0, out, stop)
        for _ in range(MOST):
            held.enter_context(socket.create_connection(("127.0.0.1", port), PATIENCE_S))
        if not until(lambda: len(link.known_peers) == MOST):
            raise Admitted("not all silent callers were let in, so nothing was tried")
        air = held.enter_context(socket.create_connection(("127.0.0.1", port), PATIENCE_S))
        with contextlib.suppress(OSError):
            air.sendall(HELLO)
        if not until(lambda: _heard(out, air)):
            raise Admitted("the rightful caller was locked out")
    return f"{MOST} silent callers, the rightful one was heard"


def _heard(out: "Queue[Batch]", air: socket.socket) -> bool:
    with contextlib.suppress(Empty):
        batch = out.get(timeout=0.05)
        return batch.received is not None and air.getsockname() in batch.received.senders
    return False


def ghosts() -> str:
    """Take the place of every aircraft with ghosts; a rightful one comes after them, another was there before."""
    intake, before, after = MavlinkReceiver(max_uavs=100), Talker(250), Talker(251)
    for k in range(round(SILENCE_LIMIT_S) + 5):
        intake.receive(T0 + k, before.heartbeat(), "air")
        if k == 1:
            intake.receive(T0 + k, b"".join(Talker(system).heartbeat() for system in range(1, 200)), "foe")
        intake.flush(T0 + k)
        intake.remove_silent(T0 + k)
    intake.receive(T0 + SILENCE_LIMIT_S + 6, after.heartbeat(), "air")
    intake.flush(T0 + SILENCE_LIMIT_S + 6)
    if sorted(intake.aircraft) != [250, 251]:
        raise Admitted(f"found aircraft {sorted(intake.aircraft)[:5]} …, expected the two rightful ones")
    return "99 ghosts forgotten, the two rightful aircraft are there"


def full_disk() -> str:
    """Record on a disk that takes nothing, and then on one that does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    with tempfile.TemporaryDirectory() as name, TlogWriter("udpin", DiskBudget(Path(name), 1 << 20)) as tape:
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
        try:
            for k in range(20):
                tape.write(bytes(100), k * 2 * RETRY_S)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        if found := list(Path(name).iterdir()):
            raise Admitted(f"{len(found)} empty recordings")
        if tape.write(bytes(100), 100 * RETRY_S):
            raise Admitted("nothing was recorded when there was room again")
    return "no empty recording in 20 tries, then one of 100 bytes"


@contextlib.contextmanager
def _served() -> Iterator[int]:
    """Serve the page; gives its port."""
    port = free_port()
    server = serve("127.0.0.1", port)
    try:
        yield port
    finally:
        stop_server(server)


def _opened(port: int, origin: str = "") -> ClientConnection:
    return connect(
        f"ws://127.0.0.1:{port}",
        origin=Origin(origin or f"http://127.0.0.1:{port}"),
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
        max_size=None,
        compression=None,
    )


def other_origins() -> str:
    """Open the page's websocket from pages of another port, scheme and host."""
    with _served() as port:
        for origin in (f"http://127.0.0.1:{port + 1}", f"https://127.0.0.1:{port}", f"http://evil.example:{port}"):
            with contextlib.suppress(InvalidStatus), _opened(port, origin):
                raise Admitted(f"a page of {origin} opened it")
        with _opened(port) as own:
            own.recv(timeout=PATIENCE_S)
    return "3 origins refused, the page's own opens it"


def bad_messages() -> str:
    """Send the page what is no message, and uploads, beside a page that goes on."""
    upload = {"source_component_uuid": "x", "transfer_uuid": "y", "filename": "f", "mime_type": "m"}
    start = {"type": "FileTransferStartUpload", **upload, "part_count": 1, "size_bytes": 1}
    bad = [b"\xc1", b"", msgspec.msgpack.encode({"type": "NoSuch"}), msgspec.msgpack.encode(start), "text"]
    with _served() as port, _opened(port) as other:
        for message in bad:
            with _opened(port) as one:
                one.send(message)
                if (code := _closed_with(one)) != VIOLATION:
                    raise Admitted(f"{message!r} ended with {code}, expected {VIOLATION}")
        other.send(msgspec.msgpack.encode({"type": _messages.GuiUpdateMessage.__name__, "uuid": "x", "updates": {}}))
        if not other.ping().wait(PATIENCE_S):
            raise Admitted("the rightful page ended too")
    return f"{len(bad)} messages refused, the other page goes on"


def _closed_with(one: ClientConnection) -> int | None:
    try:
        while True:
            one.recv(timeout=PATIENCE_S)
    except ConnectionClosed as closed:
        return closed.rcvd.code if closed.rcvd is not None else None
    except TimeoutError:
        return None


def hostile_session() -> str:
    """Hold the hostile session of `hostile`, beside a live link."""
    found = hostile.session()
    growth, left = found.peak_mb - found.before_mb, found.after_mb - found.before_mb
    words = f"{growth:.0f} MB more at most, {left:.0f} MB after {hostile.GIVEN_BACK_S:.0f} s, gap {found.gap_s:.2f} s"
    if growth > hostile.MOST_MB or left > hostile.AFTER_MB:
        raise Admitted(words)
    if found.gap_s > hostile.GAP_S or not found.called or found.late_uavs > 2:
        raise Admitted(f"{words}; caller heard: {found.called}, aircraft at the end: {found.late_uavs}")
    return f"{words}, {found.heard} samples of the live link"


BY_LIMIT: tuple[Callable[[], str], ...] = (
    silent_callers,
    ghosts,
    full_disk,
    other_origins,
    bad_messages,
    hostile_session,
)
