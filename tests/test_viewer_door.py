"""Who may come in: this page alone, under our names; what it carries; no tunnel, no other port."""

import gzip
import http.client
import re
import socket
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from conftest import ROOT, unused_port
from viser import _messages
from websockets.datastructures import Headers
from websockets.http11 import Request

from fleet.memory_bus import MemoryBus
from viewer.app import App
from viewer.door import POLICY, doorman, quiet, serve

PASSED = "the library's own answer"


def answer(path: str = "/", *, anyone: bool = False, **headers: str):
    ask = doorman(
        lambda connection, request: PASSED, {"localhost", "127.0.0.1", "::1", "twin.example.org"}, anyone=anyone
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
    assert answer(anyone=True, **SOCKET, host="gcs.lan:8080", origin="http://evil.example").status_code == 403


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
    with quiet():
        one.stop()


def test_over_the_wire_a_stranger_is_refused(server: SimpleNamespace) -> None:
    for host, status in (("127.0.0.1", 200), ("evil.example", 403)):
        line = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
        line.request("GET", "/", headers={"Host": host})
        got = line.getresponse()
        assert got.status == status and "frame-ancestors 'none'" in got.headers["Content-Security-Policy"]
        line.close()


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


def test_a_taken_port_is_refused_and_not_replaced(server: SimpleNamespace) -> None:
    with pytest.raises(OSError, match=rf"--port: found {server.port} taken"):
        serve("127.0.0.1", server.port)


# --- behind a reverse proxy, and what the viewer may do on the bus ---


def test_the_recipe_for_a_reverse_proxy_hands_on_what_the_door_asks_for() -> None:
    recipe = (ROOT / "deploy" / "nginx.conf").read_text()
    assert recipe.count("{") == recipe.count("}") and "auth_basic_user_file" in recipe
    name = re.search(r"viewer --name (\S+)", recipe)[1]
    assert f"server_name {name};" in recipe and "proxy_pass         http://127.0.0.1:8080;" in recipe
    sent = dict(re.findall(r"proxy_set_header\s+(\w+)\s+(\S+);", recipe))
    assert sent["Host"] == "$host" and sent["Upgrade"] == "$http_upgrade" and "Origin" not in sent
    assert answer(**SOCKET, host=name, origin=f"https://{name}") == PASSED


class Mute(MemoryBus):
    """A bus on which one may only listen and ask."""

    def put(self, *_: object) -> None:
        raise AssertionError("the viewer published")

    publish = answer = present = put


def test_to_hear_and_to_ask_is_all_it_needs_of_the_bus(server: SimpleNamespace) -> None:
    app = App(Mute(), server.viser)
    for tick in range(12):
        app.tick(tick)
    app.feed.catch_up()
