"""Who may come in: this page alone, under our names; what it carries; no tunnel, no other port."""

import contextlib
import gc
import gzip
import http.client
import logging
import re
import socket
import threading
from collections.abc import Iterator
from types import SimpleNamespace

import msgspec
import pytest
import viser
from conftest import ROOT, unused_port
from viser import _messages
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.http11 import Request
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from tests.support.fake_link import PATIENCE_S, until
from tests.support.memory_bus import MemoryBus
from viewer.__main__ import main
from viewer.browser.http_server import (
    POLICY,
    REFUSED,
    VIOLATION,
    _shorten_rejection,
    request_filter,
    serve,
    stop_server,
)
from viewer.server.app import App

PASSED = "the library's own answer"


def answer(path: str = "/", *, anyone: bool = False, **headers: str):
    ask = request_filter(
        lambda connection, request: PASSED, {"localhost", "127.0.0.1", "::1", "twin.example.org"}, any_host=anyone
    )
    return ask(None, Request(path, Headers({name.capitalize(): value for name, value in headers.items()})))


SOCKET = {"upgrade": "websocket"}


@pytest.mark.parametrize(
    ("headers", "let_in"),
    [
        ({"host": "127.0.0.1:8080", "origin": "http://127.0.0.1:8080"}, True),
        ({"host": "localhost:8080", "origin": "http://localhost:8080"}, True),
        ({"host": "[::1]:8080", "origin": "http://[::1]:8080"}, True),
        ({"host": "twin.example.org", "origin": "https://twin.example.org"}, True),
        ({"host": "127.0.0.1:8080"}, True),  # no browser: a script of this machine
        ({"host": "127.0.0.1:8080", "origin": "https://evil.example"}, False),
        ({"host": "127.0.0.1:8080", "origin": "http://127.0.0.1:9999"}, False),  # another program of this machine
        ({"host": "127.0.0.1:8080", "origin": "http://127.0.0.1"}, False),
        ({"host": "127.0.0.1:8080", "origin": "https://127.0.0.1:8080"}, False),
        ({"host": "127.0.0.1", "origin": "http://127.0.0.1:80"}, True),
        ({"host": "[::1]:8080", "origin": "http://[::1]:9999"}, False),
        ({"host": "twin.example.org", "origin": "http://twin.example.org:9999"}, False),
        ({"host": "twin.example.org:8443", "origin": "https://twin.example.org:8443"}, True),
        ({"host": "twin.example.org", "origin": "http://twin.example.org", "x-forwarded-proto": "https"}, False),
        ({"host": "127.0.0.1:8443", "origin": "https://127.0.0.1:8443", "x-forwarded-proto": "https"}, True),
        ({"host": "127.0.0.1:8080", "origin": "file://127.0.0.1:8080"}, False),
        ({"host": "127.0.0.1:8080", "origin": "null"}, False),
        ({"host": "evil.example:8080", "origin": "http://evil.example:8080"}, False),  # a name bound to our address
        ({"host": "127.0.0.1.evil.example", "origin": "http://127.0.0.1.evil.example"}, False),
        ({"host": "", "origin": "http://127.0.0.1:8080"}, False),
    ],
)
def test_only_our_own_page_opens_the_socket(headers: dict, let_in: bool) -> None:
    found = answer(**SOCKET, **headers)
    assert (found == PASSED) == let_in
    if not let_in:
        assert found.status_code == 403 and b"viewer: found" in found.body


def test_bound_to_every_interface_any_name_is_ours_but_no_other_site() -> None:
    assert answer(anyone=True, **SOCKET, host="gcs.lan:8080", origin="http://gcs.lan:8080") == PASSED
    for origin in ("http://evil.example", "http://gcs.lan:9999", "https://gcs.lan:8080"):
        assert answer(anyone=True, **SOCKET, host="gcs.lan:8080", origin=origin).status_code == 403
    assert answer(anyone=True, **SOCKET, host="gcs", origin="https://gcs", **{"x-forwarded-proto": "https"}) == PASSED


def test_the_page_carries_its_rules_and_words_for_who_cannot_draw() -> None:
    page = answer("/?fixedDpr=0.5", host="localhost")
    text = gzip.decompress(page.body).decode()
    assert page.status_code == 200 and page.headers["Content-Security-Policy"] == POLICY
    assert "No WebGL" in text and text.index('id="first"') > text.index("<body") and "<noscript>" in text
    assert answer("/assets/x.js", host="localhost") == PASSED


@pytest.fixture(scope="module")
def server() -> Iterator[SimpleNamespace]:
    port = unused_port()
    one = serve("127.0.0.1", port)
    yield SimpleNamespace(viser=one, port=port)
    stop_server(one)


def test_over_the_wire_a_stranger_is_refused(server: SimpleNamespace) -> None:
    for host, status in (("127.0.0.1", 200), ("evil.example", 403)):
        line = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
        line.request("GET", "/", headers={"Host": host})
        got = line.getresponse()
        assert got.status == status and "frame-ancestors 'none'" in got.headers["Content-Security-Policy"]
        line.close()


def test_a_server_that_ends_late_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    one = serve("127.0.0.1", unused_port())
    thread = one._websock_server._server_thread
    one._websock_server._background_event_loop.call_soon_threadsafe(threading.Event().wait, 1.5)  # viser waits 1 s
    stop_server(one)
    assert not thread.is_alive() and capfd.readouterr().out == ""


def test_only_this_machine_can_reach_it(server: SimpleNamespace) -> None:
    sockets = {bound.getsockname() for bound in _listening(server)}
    assert sockets == {("127.0.0.1", server.port)}


def _listening(server: SimpleNamespace) -> list[socket.socket]:
    """Read off the system who listens on the port."""
    found = []
    with open("/proc/net/tcp") as table:
        for line in table.readlines()[1:]:
            address, state = line.split()[1], line.split()[3]
            host, _, port = address.partition(":")
            if state == "0A" and int(port, 16) == server.port:
                name = socket.inet_ntoa(bytes.fromhex(host)[::-1])
                found.append(SimpleNamespace(getsockname=lambda name=name: (name, server.port)))
    return found


def test_nobody_can_open_a_tunnel(server: SimpleNamespace) -> None:
    handlers = server.viser._websock_server._incoming_handlers
    assert handlers  # the table is still where we think it is
    for share in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
        assert not handlers.get(share)


@contextlib.contextmanager
def page(server: SimpleNamespace, origin: str = "") -> Iterator[ClientConnection]:
    """Open the websocket as the page does."""
    with connect(
        f"ws://127.0.0.1:{server.port}",
        origin=Origin(origin or f"http://127.0.0.1:{server.port}"),
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
        max_size=None,
        compression=None,
    ) as one:
        yield one


def close_code(one: ClientConnection) -> int:
    """Read until the far end closes; give its code."""
    with pytest.raises(ConnectionClosed) as closed:
        while True:
            one.recv(timeout=PATIENCE_S)
    assert closed.value.rcvd is not None
    return closed.value.rcvd.code


def packed(kind: type, **fields: object) -> bytes:
    return msgspec.msgpack.encode({"type": kind.__name__, **fields})


UPLOAD = {"source_component_uuid": "x", "transfer_uuid": "y", "filename": "f", "mime_type": "m"}
BAD = {
    "no msgpack": b"\xc1\xff\x00",
    "no map": msgspec.msgpack.encode([1, 2]),
    "no such message": msgspec.msgpack.encode({"type": "NoSuch"}),
    "fields of another": packed(_messages.GuiUpdateMessage, nothing=1),
    "empty": b"",
    "text": "text",
    "an upload": packed(_messages.FileTransferStartUpload, **UPLOAD, part_count=1, size_bytes=1),
    "a part": packed(
        _messages.FileTransferPart, source_component_uuid="x", transfer_uuid="y", part_index=0, content=b"1"
    ),
    "a tunnel": packed(_messages.ShareUrlRequest),
}


@pytest.mark.parametrize("bad", BAD.values(), ids=BAD.keys())
def test_a_malformed_or_refused_message_closes_its_page_with_one_line(server, bad, caplog, capfd) -> None:
    with page(server) as other, page(server) as one:
        one.send(bad)
        assert close_code(one) == VIOLATION
        other.send(packed(_messages.GuiUpdateMessage, uuid="gone", updates={}))  # the others go on
        other.ping().wait(PATIENCE_S)
    (line,) = [record for record in caplog.records if record.name == "viewer.browser.http_server"]
    assert line.getMessage().startswith("page: found ") and line.exc_info is None
    assert "Traceback" not in caplog.text + "".join(capfd.readouterr())


def test_a_message_that_fails_in_the_library_is_one_line(server, caplog, capfd) -> None:
    handle = server.viser.gui.add_slider("s", 0, 1, 0.1, 0.5)
    with page(server) as one:
        one.send(packed(_messages.GuiUpdateMessage, uuid=handle._impl.uuid, updates={"nothing": 1}))
        one.ping().wait(PATIENCE_S)
        until(lambda: gc.collect() is None or "a message failed" in caplog.text)
    handle.remove()
    assert "Traceback" not in caplog.text + "".join(capfd.readouterr())


@pytest.mark.parametrize("sent", [b"", b"\x16\x03\x01 no request\r\n\r\n", b"GET"], ids=["port check", "TLS", "cut"])
def test_a_connection_without_a_request_is_not_reported(server: SimpleNamespace, sent: bytes, caplog, capfd) -> None:
    """A port check, as `fleet doctor` and port scanners make."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE_S) as probe:
        probe.sendall(sent)
        probe.shutdown(socket.SHUT_WR)
        with contextlib.suppress(ConnectionResetError):
            while probe.recv(1_000):  # until the server has answered and closed it
                pass
    assert [record for record in caplog.records if record.name.startswith("websockets")] == []
    assert "".join(capfd.readouterr()) == ""


def test_a_request_that_fails_in_the_library_is_one_line(caplog) -> None:
    record = logging.LogRecord("websockets.server", logging.ERROR, "", 0, "opening handshake failed", (), None)
    assert _shorten_rejection(record) and record.getMessage() == "opening handshake failed"
    record.exc_info = (KeyError, KeyError("x"), None)
    assert _shorten_rejection(record) and record.exc_info is None and "(KeyError: 'x')" in record.getMessage()


def test_nobody_can_upload(server: SimpleNamespace) -> None:
    handlers = server.viser._websock_server._incoming_handlers
    assert not any(handlers.get(kind) for kind in REFUSED)


def test_the_page_of_another_port_opens_no_websocket(server: SimpleNamespace) -> None:
    with page(server) as own:
        assert own.recv(timeout=PATIENCE_S)
    with pytest.raises(InvalidStatus, match="403"), page(server, "http://127.0.0.1:9999"):
        pass


def test_a_taken_port_is_refused_and_not_replaced(server: SimpleNamespace) -> None:
    with pytest.raises(OSError, match=rf"--port: found {server.port} in use"):
        serve("127.0.0.1", server.port)


# --- behind a reverse proxy, and what the viewer may do on the bus ---


def test_the_recipe_for_a_reverse_proxy_hands_on_what_the_door_asks_for() -> None:
    recipe = (ROOT / "deploy" / "nginx.conf").read_text()
    assert recipe.count("{") == recipe.count("}") and "auth_basic_user_file" in recipe
    name = re.search(r"viewer --name (\S+)", recipe)[1]
    assert f"server_name {name};" in recipe and "proxy_pass         http://127.0.0.1:8080;" in recipe
    sent = dict(re.findall(r"proxy_set_header\s+([\w-]+)\s+(\S+);", recipe))
    assert (sent["Host"], sent["X-Forwarded-Proto"]) == ("$http_host", "$scheme")
    assert sent["Upgrade"] == "$http_upgrade" and "Origin" not in sent
    assert answer(**SOCKET, host=name, origin=f"https://{name}", **{"x-forwarded-proto": "https"}) == PASSED


class Mute(MemoryBus):
    """A bus on which one may only listen and ask."""

    def put(self, *_: object) -> None:
        raise AssertionError("the viewer published")

    publish = answer = present = put


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--allow", "approvals", "--host", "0.0.0.0"), "has no password"),
        (("--allow", "approvals", "--router", "tcp/192.0.2.1:7447"), "without certificates or passwords"),
        (("--who", "kim"), "without --allow approvals"),
    ],
)
def test_approvals_are_allowed_only_to_an_operator_on_this_machine(
    options: tuple[str, ...], expected: str, capsys
) -> None:
    assert main(["--port", str(unused_port()), *options]) == 2
    assert expected in capsys.readouterr().err


def test_to_hear_and_to_ask_is_all_it_needs_of_the_bus(server: SimpleNamespace) -> None:
    app = App(Mute(), server.viser)
    for tick in range(12):
        app.tick(tick)
    app.store.request_latest()
