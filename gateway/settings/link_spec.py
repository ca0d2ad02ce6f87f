"""Parser of the `--link` and `--forward` arguments."""

import contextlib
from typing import NamedTuple
from urllib.parse import parse_qsl, unquote

from fleet.telemetry.recording.pace import read_speed
from gateway.settings.message_filter import SETTINGS, Sieve, read_sieve

LOOPBACK = "127.0.0.1"
MOST_COPIES = 10_000
NETWORK = ("udpin", "udpout", "udpbcast", "tcpin", "tcp")
KINDS = (*NETWORK, "serial", "replay")
BAUD = 57_600  # default, of a telemetry radio
_HIGHEST_BAUD = 4_000_000
LISTENING = ("udpin", "tcpin")  # the host is optional: loopback
SIGN = ("accept", "require")


class Spec(NamedTuple):
    """Specification of a link."""

    text: str
    kind: str  # one of KINDS
    where: str  # host or path
    port: int  # or baud
    speed: float = 1.0  # recorded seconds per second; inf: as fast as possible
    offset: int = 0  # UAV id = MAVLink system id + offset
    copies: int = 1  # aircraft in place of each recorded one, itself included
    results: bool = False  # also replay recorded results of workers
    sieve: Sieve = Sieve()
    sign: str = ""  # one of SIGN; empty: signatures are not checked
    key: str = ""  # name of a key; empty: the only one


def read_spec(text: str, offset: int = 0) -> Spec:
    """Parse a link, e.g. `udpin:HOST:PORT`, `serial:PATH:BAUD` or `replay:PATH?speed=N`, each with settings after a #.

    In PATH, `%3F` stands for ?, `%23` for # and `%25` for %.

    Raises:
        ValueError: when it is not a link, or a value is out of range.
    """
    body, _, fragment = text.partition("#")
    kind, _, rest = body.partition(":")
    settings = dict(parse_qsl(fragment, keep_blank_values=True))
    found = None
    with contextlib.suppress(ValueError):
        offset = int(settings.pop("offset", str(offset)))
        found = _bare(text, kind, rest)
    if found is not None and kind != "replay":
        found = found._replace(sieve=read_sieve(settings), sign=settings.pop("sign", ""), key=settings.pop("key", ""))
    if found is None or settings or found.sign not in ("", *SIGN) or (found.key and not found.sign):
        raise ValueError(
            f"--link: found {text!r}, expected udpin:HOST:PORT, udpout, udpbcast, tcpin or tcp with HOST:PORT, "
            "serial:PATH:BAUD or replay:FILE?speed=4&copies=10&results=1, optionally #offset=-1 and, except for "
            f"recordings, {', '.join(SETTINGS)}, sign={'|'.join(SIGN)}, key=NAME, joined by &; write one of these"
        )
    return found._replace(offset=offset)


def read_forward(text: str) -> Spec:
    """Parse a link to another ground station.

    Raises:
        ValueError: when it is not a link, or has settings that only links to aircraft have.
    """
    found = read_spec(text)
    if found.kind == "replay" or found.offset:
        raise ValueError(f"--forward: found {text!r}, expected a link to a ground station without offset; change it")
    return found


def _bare(text: str, kind: str, rest: str) -> Spec | None:
    """Parse a link without its settings; None if it is invalid."""
    if kind in NETWORK:
        host, _, port = rest.rpartition(":")
        if port.isdecimal() and 0 < int(port) < 65536 and (host or kind in LISTENING):
            return Spec(text, kind, host.strip("[]") or LOOPBACK, int(port))
    elif kind == "serial":
        path, _, baud = rest.rpartition(":")
        path, baud = (path, baud) if baud.isdecimal() else (rest, str(BAUD))  # device names may contain colons
        if path and 0 < int(baud) <= _HIGHEST_BAUD:
            return Spec(text, kind, unquote(path), int(baud))
    elif kind == "replay":
        path, _, query = rest.partition("?")
        asked = dict(parse_qsl(query))
        speed = read_speed(asked.pop("speed", "1"))
        copies, results = int(asked.pop("copies", "1")), asked.pop("results", "0")
        fits = 1 <= copies <= MOST_COPIES and (results == "0" or (results == "1" and copies == 1))
        if path and not asked and fits:
            return Spec(text, kind, unquote(path), 0, speed, copies=copies, results=results == "1")
    return None
