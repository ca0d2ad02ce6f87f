"""Encoding of clicks on the page: UAV id and optional data time."""

from viewer.theme.events import LATEST


def encode_click(uav: int, t: float) -> str:
    """Encode a UAV id and a data time [s since 1970]: `7@1700000000.500`; omit an invalid time."""
    return f"{uav}@{t:.3f}" if 0 <= t < LATEST else f"{uav}"


def parse_click(text: str) -> tuple[int, float | None] | None:
    """Parse `7` or `7@1700000000.500`; return None for any other text."""
    uav, _, t = text[:40].partition("@")
    if not (uav.isascii() and uav.isdecimal() and len(uav) <= 6):
        return None
    if not t:
        return int(uav), None
    valid = t.isascii() and t.replace(".", "", 1).isdecimal() and float(t) < LATEST
    return (int(uav), float(t)) if valid else None
