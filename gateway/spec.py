"""The `--link` argument, read."""

import contextlib
from typing import NamedTuple
from urllib.parse import parse_qsl, unquote

from fleet.telemetry.pace import read_speed

LOOPBACK = "127.0.0.1"
MOST_COPIES = 10_000


class Spec(NamedTuple):
    """A `--link` argument, read."""

    text: str
    kind: str  # udpin or replay
    where: str  # host or path
    port: int
    speed: float  # recorded seconds per second; inf: as fast as it can be read
    offset: int  # UAV id = MAVLink system id + offset
    copies: int = 1  # aircraft in place of each recorded one, itself included
    results: bool = False  # play also what workers said, where it was recorded


def read_spec(text: str, offset: int = 0) -> Spec:
    """Read `udpin:HOST:PORT` or `replay:PATH?speed=N&copies=N&results=1`, each with an optional `#offset=-1`.

    In PATH, `%3F` stands for ?, `%23` for # and `%25` for %.

    Raises:
        ValueError: when it is neither, or a value does not fit.
    """
    body, _, fragment = text.partition("#")
    kind, _, rest = body.partition(":")
    settings = dict(parse_qsl(fragment))
    with contextlib.suppress(ValueError):
        offset = int(settings.pop("offset", str(offset)))
        if not settings and kind == "udpin":
            host, _, port = rest.rpartition(":")
            if port.isdecimal() and 0 < int(port) < 65536:
                return Spec(text, kind, host or LOOPBACK, int(port), 1.0, offset)
        if not settings and kind == "replay":
            path, _, query = rest.partition("?")
            asked = dict(parse_qsl(query))
            speed = read_speed(asked.pop("speed", "1"))
            copies, results = int(asked.pop("copies", "1")), asked.pop("results", "0")
            fits = 1 <= copies <= MOST_COPIES and (results == "0" or (results == "1" and copies == 1))
            if path and not asked and fits:
                return Spec(text, kind, unquote(path), 0, speed, offset, copies, results == "1")
    raise ValueError(
        f"--link: found {text!r}, expected udpin:HOST:PORT or replay:FILE?speed=4&copies=10&results=1, "
        "both with #offset=-1 if wanted; write one of these"
    )
