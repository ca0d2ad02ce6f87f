"""Give a recording that was filled from a backlog the times its frames were made, not the times they arrived.

A radio that catches up writes minutes of flight into seconds of file. Boot time tells: when arrival - boot
falls by more than radios ever delay, every frame is stamped with the newest boot time plus the final offset.
"""

from collections.abc import Iterable, Iterator

from fleet.telemetry.decode import V1

BACKLOG_S = 5.0  # more than this is a backlog, not a delay [s]
_BOOT_FIRST = {30, 32, 33}  # ATTITUDE, LOCAL_POSITION_NED, GLOBAL_POSITION_INT: time_boot_ms leads the payload

Record = tuple[float, bytes]


def boot_s(frame: bytes) -> float | None:
    """Read `time_boot_ms` straight from the bytes of a frame that starts with it [s]; None for any other frame."""
    head = 6 if frame[0] == V1 else 10
    if len(frame) < head + 6 or frame[1] < 4:
        return None
    message = frame[5] if head == 6 else int.from_bytes(frame[7:10], "little")
    return int.from_bytes(frame[head : head + 4], "little") * 1e-3 if message in _BOOT_FIRST else None


def _system(frame: bytes) -> int:
    return frame[3] if frame[0] == V1 else frame[5]


def backlog_offset(records: Iterable[Record]) -> float | None:
    """Give fleet time minus boot time of a recording that holds a backlog [s]; None where arrival can be trusted.

    Only for a single aircraft whose clock never goes back: otherwise nothing can be concluded.
    """
    least, most, newest = float("inf"), float("-inf"), float("-inf")
    systems = set()
    for t, frame in records:
        own = boot_s(frame)
        if own is None:
            continue
        systems.add(_system(frame))
        if len(systems) > 1 or own < newest - 1.0:
            return None
        newest = max(newest, own)
        least, most = min(least, t - own), max(most, t - own)
    return least if most - least > BACKLOG_S else None


def restamped(records: Iterable[Record], offset_s: float) -> Iterator[Record]:
    """Stamp every frame with the newest boot time at that point, plus `offset_s`."""
    waiting: list[bytes] = []
    t: float | None = None
    for _, frame in records:
        own = boot_s(frame)
        if own is not None:
            t = max(own + offset_s, t or 0.0)
        if t is None:
            waiting.append(frame)
            continue
        yield from ((t, early) for early in waiting)
        waiting.clear()
        yield t, frame
