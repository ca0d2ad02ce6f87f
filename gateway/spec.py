"""The `--link` argument, read."""

import contextlib
from typing import NamedTuple
from urllib.parse import parse_qsl

LOOPBACK = "127.0.0.1"


class Spec(NamedTuple):
    """A `--link` argument, read."""

    text: str
    kind: str  # udpin or replay
    where: str  # host or path
    port: int
    speed: float  # recorded seconds per second; inf: as fast as it can be read
    offset: int  # UAV id = MAVLink system id + offset


def read_spec(text: str, offset: int = 0) -> Spec:
    """Read `udpin:HOST:PORT` or `replay:PATH?speed=N`, each with an optional `#offset=-1`.

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
            if path and not asked:
                return Spec(text, kind, path, 0, speed, offset)
    raise ValueError(
        f"--link: found {text!r}, expected udpin:HOST:PORT or replay:FILE?speed=4, "
        "both with #offset=-1 if wanted; write one of these"
    )


def read_speed(text: str) -> float:
    """Read a replay speed: a number of times real time, or `max`.

    Raises:
        ValueError: when it is neither.
    """
    try:
        speed = float("inf") if text == "max" else float(text)
    except ValueError:
        speed = 0.0
    if not speed > 0:
        raise ValueError(f"speed: found {text!r}, expected a number above 0 or max; write e.g. 4")
    return speed
