"""HTTP server of the page (access checks, headers, loading page, patches of viser), and the state of each browser."""

import asyncio
import contextlib
import gzip
import http
import io
import json
import logging
import threading
import time
import warnings
import zipfile
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import viser
import websockets.asyncio.server as sockets
from viser import Icon, _icons, _messages
from websockets.datastructures import Headers
from websockets.exceptions import InvalidMessage
from websockets.http11 import Request, Response

from viewer.text.missed_events import Absence
from viewer.theme.palette import DARK, LIGHT, Palette

LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")  # loopback names
POLICY = (  # no external resources, no framing by other sites
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' ws: wss: data: blob:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
ICONS = (  # icons of tabs, buttons and commands
    Icon.ADJUSTMENTS,
    Icon.ALERT_TRIANGLE,
    Icon.CAMERA,
    Icon.CLOCK_PLAY,
    Icon.DOWNLOAD,
    Icon.DRONE,
    Icon.FOCUS_2,
    Icon.MOVIE,
    Icon.RULER_MEASURE,
    Icon.TABLE,
)
DEFAULT_PORTS = {"http": "80", "https": "443"}  # default ports, omitted by browsers
REFUSED = (  # messages that this page never sends
    _messages.FileTransferStartUpload,
    _messages.FileTransferPart,
    _messages.ShareUrlRequest,
    _messages.ShareUrlDisconnect,
)
STOP_TIMEOUT_S = 30.0  # for the server thread to end [s]
BLOCK_MESSAGES = 10_000  # most messages of one block, `atomic()`, and of blocks waiting behind each other
VIOLATION = 1008  # close code for a policy violation (RFC 6455, 7.4.1)
RequestHandler = Callable[[Any, Request], Response | None]
SocketHandler = Callable[[Any], Awaitable[None]]

_log = logging.getLogger(__name__)


def serve(host: str, port: int, name: str = "") -> viser.ViserServer:
    """Open the web server on exactly this port, without the public share tunnel.

    Args:
        host: address to bind
        port: TCP port; 0 selects a free one
        name: host name of the page behind a reverse proxy; empty: no proxy
    Raises:
        OSError: when the port is in use; viser alone would use the next one without notice.
    """
    # A page may close while it is drawn: its queued messages are discarded without a warning.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    sockets_log = logging.getLogger("websockets.server")
    sockets_log.setLevel(logging.WARNING)  # it logs page requests as rejected connections
    sockets_log.addFilter(_shorten_rejection)
    _read_icons()
    names = {*LOCAL_NAMES, host.strip("[]").lower(), *filter(None, [name.lower()])}
    any_host = host in ("", "0.0.0.0", "::", "[::]")  # every interface: the host name is unknown
    with without_stdout(), _guarded_sockets(names, any_host=any_host):
        server = viser.ViserServer(host=host, port=port, verbose=False)
    for kind in REFUSED:
        server._websock_server.unregister_handler(kind)
    if port and server.get_port() != port:
        stop_server(server)
        raise OSError(
            f"--port: found {port} in use by another program, expected a free port; stop it or choose another"
        )
    return server


def _shorten_rejection(record: logging.LogRecord) -> bool:
    """Drop the log record of a connection without an HTTP request (a port check); shorten others to one line."""
    error = record.exc_info[1] if record.exc_info else None
    if isinstance(error, InvalidMessage | EOFError | ConnectionError):
        return False
    if error is not None:
        record.msg, record.args = "page: found a connection without a valid request (%s: %s); it is closed", ()
        record.args, record.exc_info = (type(error).__name__, error), None
    return True


def _read_icons() -> None:
    """Read all icons from the archive of viser at once; viser reopens it for each icon (25 ms)."""
    with zipfile.ZipFile(_icons.ICONS_DIR / "tabler-icons.zip") as archive:
        stub = SimpleNamespace(ZipFile=lambda _: contextlib.nullcontext(archive))
        original, _icons.zipfile = _icons.zipfile, stub  # type: ignore[assignment]
        try:
            for icon in ICONS:
                _icons.svg_from_icon(icon)
        finally:
            _icons.zipfile = original  # type: ignore[assignment]


def stop_server(server: viser.ViserServer) -> None:
    """Stop the server and wait until its thread has ended.

    viser waits 1 s; on a busy machine its thread ends later and prints "Server stopped" then.
    """
    thread = server._websock_server._server_thread
    with without_stdout():
        server.stop()
        if thread is not None:
            thread.join(STOP_TIMEOUT_S)


def without_stdout() -> contextlib.redirect_stdout:
    """Suppress the banner that viser prints."""
    return contextlib.redirect_stdout(io.StringIO())


@contextlib.contextmanager
def _guarded_sockets(names: set[str], *, any_host: bool) -> Iterator[None]:
    """Install the request filter and message checks while viser opens its server."""
    original = sockets.serve

    def serve_guarded(handler: SocketHandler, *args: Any, process_request: RequestHandler, **options: Any) -> Any:
        filtered = request_filter(process_request, names, any_host=any_host)
        return original(check_messages(handler), *args, process_request=filtered, **options)

    sockets.serve = serve_guarded  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        sockets.serve = original  # type: ignore[misc]


def request_filter(inner: RequestHandler, names: set[str], *, any_host: bool) -> RequestHandler:
    """Return a request handler that refuses foreign requests and adds security headers and the loading page.

    A page of another site in the operator's browser cannot open the websocket (scheme, host and port of its `Origin`
    must equal those of the requested page) and cannot use DNS rebinding (`Host` must be in `names`). The scheme is
    `X-Forwarded-Proto` of a reverse proxy, which page scripts cannot set; without it http, and with `--name`
    also https.

    Args:
        inner: request handler of viser
        names: accepted host names
        any_host: accept any host name, as when bound to every interface
    """
    page = _page()

    def filter_request(connection: Any, request: Request) -> Response | None:
        host = _host_name(request.headers.get("Host", ""))
        origin = request.headers.get("Origin")
        if not any_host and host not in names:
            return _refusal(f"viewer: found host {host[:80]!r}, expected {sorted(names)}; start the viewer with --name")
        if origin is not None and not _is_own(origin, request, proxied=host in names and host not in LOCAL_NAMES):
            return _refusal(
                "viewer: found a request of another site, expected one of this page; open the page directly"
            )
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return inner(connection, request)
        if request.path.partition("?")[0] in ("/", "/index.html"):
            return _response(http.HTTPStatus.OK, page, {"Content-Type": "text/html", "Content-Encoding": "gzip"})
        return inner(connection, request)

    return filter_request


def _is_own(origin: str, request: Request, *, proxied: bool) -> bool:
    """Return whether an origin equals that of the requested page.

    Args:
        origin: scheme://host[:port] of the requesting page
        request: the request
        proxied: whether a reverse proxy without `X-Forwarded-Proto` may serve the page
    """
    scheme, _, address = origin.lower().partition("://")
    host = request.headers.get("Host", "").lower()
    forwarded = request.headers.get("X-Forwarded-Proto", "").lower()
    schemes = {forwarded} if forwarded else {"http", "https"} if proxied else {"http"}
    return scheme in schemes & DEFAULT_PORTS.keys() and _with_port(address, scheme) == _with_port(host, scheme)


def _with_port(address: str, scheme: str) -> tuple[str, str]:
    """Return host and port; without a port the default of the scheme."""
    rest = address.rpartition("]")[2]  # IPv6 address in brackets
    return _host_name(address), rest.partition(":")[2] or DEFAULT_PORTS[scheme]


def check_messages(handler: SocketHandler) -> SocketHandler:
    """Return a websocket handler that closes the connection on a malformed or refused message and logs it."""

    async def serve_checked(connection: Any) -> None:
        asyncio.get_running_loop().set_exception_handler(_log_defect)
        receive = connection.recv

        async def receive_checked(*args: Any, **options: Any) -> Any:
            payload = await receive(*args, **options)
            if fault := _message_fault(payload):
                _log.warning("page: found %s, expected a message of this page; connection closed", fault)
                await connection.close(VIOLATION, "viewer: message refused")
                return await receive(*args, **options)  # raises: connection closed
            return payload

        connection.recv = receive_checked
        await handler(connection)

    return serve_checked


def _message_fault(payload: object) -> str:
    """Describe the fault of a message; empty when it is valid."""
    if not isinstance(payload, bytes):
        return "text"
    try:
        message = _messages.Message.deserialize(payload)
    except Exception as error:  # untrusted input: any exception of the library
        return f"{len(payload)} malformed bytes ({type(error).__name__})"
    return f"a {type(message).__name__}" if isinstance(message, REFUSED) else ""


def _log_defect(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log an exception of a viser task in one line, as it may contain untrusted values."""
    del loop
    error = context.get("exception")
    _log.warning("page: %s", f"a message failed ({type(error).__name__}: {error})" if error else context["message"])


def _host_name(address: str) -> str:
    """Return the host of `name:port` or `[::1]:port`."""
    if address.startswith("["):
        return address[1:].partition("]")[0].lower()
    return address.partition(":")[0].lower()


def _page() -> bytes:
    """Return the page of viser, gzipped, with title and a text for browsers without WebGL."""
    source = Path(viser.__file__).with_name("client") / "build" / "index.html"
    text = source.read_text(encoding="utf-8")
    first = Path(__file__).with_name("first.html").read_text(encoding="utf-8")
    at = text.index(">", text.index("<body")) + 1
    return gzip.compress((text[:at] + first + text[at:]).encode())


def _refusal(sentence: str) -> Response:
    return _response(http.HTTPStatus.FORBIDDEN, f"{sentence}\n".encode(), {"Content-Type": "text/plain"})


def _response(status: http.HTTPStatus, body: bytes, more: dict[str, str]) -> Response:
    rules = {"Content-Security-Policy": POLICY, "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer"}
    headers = Headers({"Content-Length": str(len(body)), "Cache-Control": "no-cache", **rules, **more})
    return Response(status.value, status.phrase, headers, body)


class Layout(NamedTuple):
    """Size of the window and the parts of its height that panels over the scene cover, in CSS pixels."""

    width: int = 1280
    height: int = 720
    top: int = 40
    bottom: int = 170

    def panel_widths(self) -> tuple[int, int]:
        """Return the widths of the left and the right panel: a fifth of the window each, within bounds."""
        return min(max(self.width // 5, 240), 340), min(max(19 * self.width // 100, 230), 350)


def parse_layout(text: str) -> Layout | None:
    """Parse `1280 720 40 170` as the page sends it; None for any other text."""
    words = text[:40].split()
    if len(words) != len(Layout._fields) or not all(word.isascii() and word.isdecimal() for word in words):
        return None
    layout = Layout(*map(int, words))
    valid = 0 < layout.width < 1e5 and 0 < layout.height < 1e5 and layout.top + layout.bottom < layout.height
    return layout if valid else None


PREFERENCES_KEY, SEEN_KEY = "parauav-page", "parauav-seen"  # in the local storage of the browser
LOAD_TIMEOUT_S = 60.0  # a busy browser answers late, and unread preferences would be overwritten
MIN_ABSENCE_S = 5.0  # a shorter interruption is ignored [s]
MAX_ABSENCE_S = 12 * 3600.0  # a longer absence lists nothing [s]


class Browser:
    """State of a page that survives a redraw and, in part, a reload; text from the browser is untrusted."""

    def __init__(self, client: Any, palette: Palette, wake: Callable[[], None]) -> None:
        self.client, self._default_palette, self._wake = client, palette, wake
        self._storage = client.local_storage
        # viser sends at most 128 messages at once: a longer block would be shown in parts
        client._websock_connection.get_message_buffer().max_window_size = BLOCK_MESSAGES
        self.absence: Absence | None = None  # until its events are marked as read
        self.uav: int | None = None  # stored selection, until a UAV is selected
        self.light: bool | None = None  # light theme; None: not chosen
        self.aviation = False  # speeds in knots and heights in feet
        self.layout = Layout()
        self._saved, self._loaded = "", False
        self._selected: int | None = None  # UAV stored last
        for load in (self._load_absence, self._load_preferences):
            threading.Thread(target=load, name="viewer-browser", daemon=True).start()

    def _load_absence(self) -> None:
        """Compute the absence from the time of the last visit."""
        with contextlib.suppress(RuntimeError, TimeoutError, ValueError):
            stored, now = self._storage.get_item(SEEN_KEY, timeout=10.0), time.time()
            left = float(stored) if stored is not None else now
            self.absence = Absence(left, now) if MIN_ABSENCE_S < now - left < MAX_ABSENCE_S else None

    def mark_present(self) -> None:
        """Store the current time in the browser."""
        self._storage.set_item(SEEN_KEY, f"{time.time():.1f}")

    def _load_preferences(self) -> None:
        with contextlib.suppress(RuntimeError, TimeoutError):
            self._parse(self._storage.get_item(PREFERENCES_KEY, timeout=LOAD_TIMEOUT_S) or "")
        self._loaded = True
        self._wake()

    def _parse(self, text: str) -> None:
        """Parse stored preferences; ignore invalid text."""
        with contextlib.suppress(ValueError, RecursionError):
            values = json.loads(text[:200])
            if isinstance(values, dict):
                uav, light = values.get("uav"), values.get("light")
                self.aviation = values.get("aviation") is True
                self.uav = uav if isinstance(uav, int) and not isinstance(uav, bool) else None
                self.light = light if isinstance(light, bool) else None

    @property
    def palette(self) -> Palette:
        """Return the theme chosen in this browser, else the default theme."""
        return self._default_palette if self.light is None else LIGHT if self.light else DARK

    def set_theme(self, *, light: bool) -> None:
        """Select a theme and store it at once: a page reloaded before its next redraw has it."""
        self.light = light
        self.save(self._selected)
        self._wake()

    def set_units(self, *, aviation: bool) -> None:
        """Select the units and store them."""
        self.aviation = aviation
        self.save(self._selected)
        self._wake()

    def save(self, uav: int | None) -> None:
        """Store selection, theme and units in the browser when they changed and were loaded before."""
        self._selected = uav
        stored = {"uav": uav if self.uav is None else self.uav, "light": self.light}
        text = json.dumps(stored | ({"aviation": True} if self.aviation else {}))
        if self._loaded and text != self._saved:
            self._saved = text
            self._storage.set_item(PREFERENCES_KEY, text)
