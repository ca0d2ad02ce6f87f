"""Parser of the `--link` and `--forward` arguments, and of their message filters."""

import contextlib
from typing import NamedTuple
from urllib.parse import parse_qsl, unquote

import numpy as np

from fleet.cli import LISTENING, NETWORK_LINKS, check_link
from fleet.telemetry.mavlink.parsing.decode import IDS
from fleet.telemetry.mavlink.parsing.scan import COMPONENT, ID, SYSTEM
from fleet.telemetry.recording.opening import read_speed
from fleet.telemetry.recording.options import NO_OPTIONS, RecordingOptions

COLUMNS = {"messages": ID, "systems": SYSTEM, "components": COMPONENT}
"""Setting of a link -> column of a frame that it tests; the prefix `no-` inverts it."""
EXCLUDE = "no-"
SETTINGS = (*COLUMNS, *(EXCLUDE + name for name in COLUMNS))
_MAX_NUMBER = {"messages": 0xFF_FFFF, "systems": 255, "components": 255}


class MessageFilter(NamedTuple):
    """Filter of frames: a frame must satisfy every rule."""

    rules: tuple[tuple[int, bool, tuple[int, ...]], ...] = ()  # column, include (True) or exclude, numbers

    def passes(self, frames: np.ndarray) -> np.ndarray:
        """Return whether each frame passes, (n,) bool; `frames` is `Frames.at`, (n, 8)."""
        passed = np.ones(len(frames), bool)
        for column, include, numbers in self.rules:
            passed &= np.isin(frames[:, column], numbers) == include
        return passed


def read_filter(settings: dict[str, str]) -> MessageFilter:
    """Parse and remove filter rules from the settings of a link, e.g. `no-messages=STATUSTEXT,30&systems=1-50`.

    Raises:
        ValueError: when a name or a number is invalid.
    """
    rules = []
    for name in SETTINGS:
        if name in settings:
            setting = name.removeprefix(EXCLUDE)
            rules.append((COLUMNS[setting], setting == name, _read_numbers(setting, settings.pop(name))))
    return MessageFilter(tuple(rules))


def _read_numbers(name: str, text: str) -> tuple[int, ...]:
    numbers: set[int] = set()
    for part in text.split(","):
        low, _, high = part.partition("-")
        if name == "messages" and part.upper() in IDS:
            numbers.add(IDS[part.upper()])
        elif low.isdecimal() and (high or low).isdecimal() and int(low) <= int(high or low) <= _MAX_NUMBER[name]:
            numbers.update(range(int(low), int(high or low) + 1))
        else:
            names = "names or " if name == "messages" else ""
            raise ValueError(
                f"{name}: found {part!r}, expected {names}numbers up to {_MAX_NUMBER[name]} with commas; "
                "correct the link"
            )
    return tuple(sorted(numbers))


LOOPBACK = "127.0.0.1"
MAX_COPIES = 10_000
BAUD = 57_600  # default, of a telemetry radio
_MAX_BAUD = 4_000_000
SIGN = ("accept", "require")


class LinkSpec(NamedTuple):
    """Specification of a link."""

    text: str
    kind: str  # one of LINK_KINDS
    address: str  # host or path
    port: int  # or baud
    speed: float = 1.0  # recorded seconds per second; inf: as fast as possible
    offset: int = 0  # UAV id = MAVLink system id + offset
    copies: int = 1  # aircraft in place of each recorded one, itself included
    results: bool = False  # also replay recorded results of workers
    options: RecordingOptions = NO_OPTIONS  # mission, parameters and column map of a recording
    message_filter: MessageFilter = MessageFilter()
    sign: str = ""  # one of SIGN; empty: signatures are not checked
    key: str = ""  # name of a key; empty: the only one


def read_spec(text: str, offset: int = 0) -> LinkSpec:
    """Parse a link, e.g. `udpin:HOST:PORT`, `serial:PATH:BAUD` or `replay:PATH?speed=N`, each with settings after a #.

    In PATH, `%3F` stands for ?, `%23` for # and `%25` for %.

    Raises:
        ValueError: when it is not a link, or a value is out of range.
    """
    body, _, fragment = text.partition("#")
    kind, _, rest = body.partition(":")
    settings = dict(parse_qsl(fragment, keep_blank_values=True))
    spec = None
    with contextlib.suppress(ValueError):
        offset = int(settings.pop("offset", str(offset)))
        spec = _read_endpoint(text, kind, rest)
    if spec is not None and kind != "replay":
        spec = spec._replace(
            message_filter=read_filter(settings), sign=settings.pop("sign", ""), key=settings.pop("key", "")
        )
    if spec is None:
        check_link("--link", text)
    if spec is None and kind == "serial":
        raise ValueError(f"--link: found {text!r}, expected serial:PATH:BAUD; write e.g. serial:/dev/ttyUSB0:57600")
    if spec is None or settings or spec.sign not in ("", *SIGN) or (spec.key and not spec.sign):
        raise ValueError(
            f"--link: found {text!r}, expected udpin:HOST:PORT, udpout, udpbcast, tcpin or tcp with HOST:PORT, "
            "serial:PATH:BAUD or replay:FILE?speed=4&copies=10&results=1, optionally #offset=-1 and, except for "
            f"recordings, {', '.join(SETTINGS)}, sign={'|'.join(SIGN)}, key=NAME, joined by &; write one of these"
        )
    return spec._replace(offset=offset)


def read_forward(text: str) -> LinkSpec:
    """Parse a link to another ground station.

    Raises:
        ValueError: when it is not a link, or has settings that only links to aircraft have.
    """
    spec = read_spec(text)
    if spec.kind == "replay" or spec.offset:
        raise ValueError(f"--forward: found {text!r}, expected a link to a ground station without offset; change it")
    return spec


def _read_endpoint(text: str, kind: str, rest: str) -> LinkSpec | None:
    """Parse a link without its settings; None if it is invalid."""
    if kind in NETWORK_LINKS:
        host, _, port = rest.rpartition(":")
        if port.isdecimal() and 0 < int(port) < 65536 and (host or kind in LISTENING):
            return LinkSpec(text, kind, host.strip("[]") or LOOPBACK, int(port))
    elif kind == "serial":
        path, _, baud = rest.rpartition(":")
        path, baud = (path, baud) if baud.isdecimal() else (rest, str(BAUD))  # device names may contain colons
        if path and 0 < int(baud) <= _MAX_BAUD:
            return LinkSpec(text, kind, unquote(path), int(baud))
    elif kind == "replay":
        path, _, query = rest.partition("?")
        settings = dict(parse_qsl(query))
        speed = read_speed(settings.pop("speed", "1"))
        copies, results = int(settings.pop("copies", "1")), settings.pop("results", "0")
        options = RecordingOptions(*(settings.pop(name, "") for name in ("mission", "params", "columns")))
        valid = 1 <= copies <= MAX_COPIES and (results == "0" or (results == "1" and copies == 1))
        if path and not settings and valid:
            return LinkSpec(text, kind, unquote(path), 0, speed, copies=copies, results=results == "1", options=options)
    return None
