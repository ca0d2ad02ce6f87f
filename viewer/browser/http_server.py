"""The door of the page: who may come in, and what they are given first. All that bends the page library is here."""

import asyncio
import contextlib
import gzip
import http
import io
import logging
import warnings
import zipfile
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import viser
import websockets.asyncio.server as sockets
from viser import Icon, _icons, _messages
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

HOME = ("localhost", "127.0.0.1", "::1")  # names of this machine, for itself
POLICY = (  # nothing is fetched from anywhere else, and nobody may frame the page
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' ws: wss: data: blob:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
ICONS = (  # of the page's tabs, buttons and commands
    Icon.ADJUSTMENTS,
    Icon.ALERT_TRIANGLE,
    Icon.CAMERA,
    Icon.CLOCK_PLAY,
    Icon.DOWNLOAD,
    Icon.DRONE,
    Icon.FOCUS_2,
    Icon.MOVIE,
    Icon.TABLE,
)
PORTS = {"http": "80", "https": "443"}  # a browser leaves these out
REFUSED = (  # messages that no page of ours sends
    _messages.FileTransferStartUpload,
    _messages.FileTransferPart,
    _messages.ShareUrlRequest,
    _messages.ShareUrlDisconnect,
)
VIOLATION = 1008  # close code of a connection that broke a rule (RFC 6455, 7.4.1)
Answering = Callable[[Any, Request], Response | None]
Handling = Callable[[Any], Awaitable[None]]

_log = logging.getLogger(__name__)


def serve(host: str, port: int, name: str = "") -> viser.ViserServer:
    """Open the web server on exactly this port, without the public share tunnel.

    Args:
        host: address to bind
        port: TCP port; 0 takes any free one
        name: host name that a reverse proxy shows the page under; empty: none does
    Raises:
        OSError: when the port is taken; viser itself would silently take the next one.
    """
    # A page may close while it is drawn: what was on its way to it then goes nowhere, which is no news.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    logging.getLogger("websockets.server").setLevel(logging.WARNING)  # to it each page fetched is a connection rejected
    _read_icons()
    with quiet(), _guarded({*HOME, host.strip("[]").lower(), *filter(None, [name.lower()])}, anyone=_is_any(host)):
        server = viser.ViserServer(host=host, port=port, verbose=False)
    for kind in REFUSED:
        server._websock_server.unregister_handler(kind)
    if port and server.get_port() != port:
        with quiet():
            server.stop()
        raise OSError(f"--port: found {port} taken by another program, expected a free one; stop it or name another")
    return server


def _read_icons() -> None:
    """Read our icons out of the library's archive of thousands at once: it opens it anew for each, 25 ms a time."""
    with zipfile.ZipFile(_icons.ICONS_DIR / "tabler-icons.zip") as archive:
        once = SimpleNamespace(ZipFile=lambda _: contextlib.nullcontext(archive))
        original, _icons.zipfile = _icons.zipfile, once  # type: ignore[assignment]
        try:
            for icon in ICONS:
                _icons.svg_from_icon(icon)
        finally:
            _icons.zipfile = original  # type: ignore[assignment]


def quiet() -> contextlib.redirect_stdout:
    """Keep the library's own banner off our output."""
    return contextlib.redirect_stdout(io.StringIO())


def _is_any(host: str) -> bool:
    """Return whether an address means every interface: then we cannot know by what name we are called."""
    return host in ("", "0.0.0.0", "::", "[::]")


@contextlib.contextmanager
def _guarded(names: set[str], *, anyone: bool) -> Iterator[None]:
    """Put our own doorman before the library's, while it opens its server."""
    original = sockets.serve

    def guarded(handler: Handling, *args: Any, process_request: Answering, **options: Any) -> Any:
        answer = doorman(process_request, names, anyone=anyone)
        return original(checked(handler), *args, process_request=answer, **options)

    sockets.serve = guarded  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        sockets.serve = original  # type: ignore[misc]


def doorman(inner: Answering, names: set[str], *, anyone: bool) -> Answering:
    """Wrap what answers a request: strangers are refused, the page carries its rules and its first words.

    A page of another site that runs in the operator's browser may neither open our socket (scheme, host and port of its
    `Origin` are not those of the page asked for) nor reach us under a name of its own (its `Host` is none of ours).
    The scheme is the one a reverse proxy names in `X-Forwarded-Proto`, which no script of a page can set; without it,
    http, and under `--name` https as well.

    Args:
        inner: the library's own answer
        names: host names we are known by
        anyone: take any host name, as when bound to every interface
    """
    page = _page()

    def answer(connection: Any, request: Request) -> Response | None:
        host = _name(request.headers.get("Host", ""))
        origin = request.headers.get("Origin")
        if not anyone and host not in names:
            return _refusal(f"viewer: found host {host[:80]!r}, expected {sorted(names)}; start it with --name")
        if origin is not None and not _is_own(origin, request, proxied=host in names and host not in HOME):
            return _refusal("viewer: found a request of another site, expected this page's own; open the page itself")
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return inner(connection, request)
        if request.path.partition("?")[0] in ("/", "/index.html"):
            return _response(http.HTTPStatus.OK, page, {"Content-Type": "text/html", "Content-Encoding": "gzip"})
        return inner(connection, request)

    return answer


def _is_own(origin: str, request: Request, *, proxied: bool) -> bool:
    """Return whether an origin is that of the page asked for.

    Args:
        origin: scheme://host[:port] of the page that asks
        request: what it asks
        proxied: whether the page may be shown by a reverse proxy that does not name its scheme
    """
    scheme, _, address = origin.lower().partition("://")
    host = request.headers.get("Host", "").lower()
    forwarded = request.headers.get("X-Forwarded-Proto", "").lower()
    schemes = {forwarded} if forwarded else {"http", "https"} if proxied else {"http"}
    return scheme in schemes & PORTS.keys() and _with_port(address, scheme) == _with_port(host, scheme)


def _with_port(address: str, scheme: str) -> tuple[str, str]:
    """Return host and port; the port of the scheme where there is none."""
    rest = address.rpartition("]")[2]  # of an IPv6 address in brackets
    return _name(address), rest.partition(":")[2] or PORTS[scheme]


def checked(handler: Handling) -> Handling:
    """Wrap what serves a websocket: a message that is malformed or refused ends its connection, with one log line."""

    async def serve_one(connection: Any) -> None:
        asyncio.get_running_loop().set_exception_handler(_log_defect)
        receive = connection.recv

        async def receive_checked(*args: Any, **options: Any) -> Any:
            raw = await receive(*args, **options)
            if fault := _fault(raw):
                _log.warning("page: found %s, expected a message of this page; connection closed", fault)
                await connection.close(VIOLATION, "viewer: message refused")
                return await receive(*args, **options)  # raises: it is closed
            return raw

        connection.recv = receive_checked
        await handler(connection)

    return serve_one


def _fault(raw: object) -> str:
    """Say what is wrong with a message; nothing: an empty string."""
    if not isinstance(raw, bytes):
        return "text"
    try:
        message = _messages.Message.deserialize(raw)
    except Exception as error:  # made by a stranger: whatever the library meets in it
        return f"{len(raw)} bytes that are no message ({type(error).__name__})"
    return f"a {type(message).__name__}" if isinstance(message, REFUSED) else ""


def _log_defect(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log in one line what a task of the library met: the values in a message may be a stranger's."""
    del loop
    error = context.get("exception")
    _log.warning("page: %s", f"a message failed ({type(error).__name__}: {error})" if error else context["message"])


def _name(address: str) -> str:
    """Take the port off `name:port` or `[::1]:port`."""
    if address.startswith("["):
        return address[1:].partition("]")[0].lower()
    return address.partition(":")[0].lower()


def _page() -> bytes:
    """Return the library's page, gzipped, with our title and with words for a browser that cannot draw."""
    source = Path(viser.__file__).with_name("client") / "build" / "index.html"
    text, first = source.read_text(encoding="utf-8"), Path(__file__).with_name("first.html").read_text(encoding="utf-8")
    at = text.index("<body")
    at = text.index(">", at) + 1
    return gzip.compress((text[:at] + first + text[at:]).encode())


def _refusal(sentence: str) -> Response:
    return _response(http.HTTPStatus.FORBIDDEN, f"{sentence}\n".encode(), {"Content-Type": "text/plain"})


def _response(status: http.HTTPStatus, body: bytes, more: dict[str, str]) -> Response:
    rules = {"Content-Security-Policy": POLICY, "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer"}
    headers = Headers({"Content-Length": str(len(body)), "Cache-Control": "no-cache", **rules, **more})
    return Response(status.value, status.phrase, headers, body)
