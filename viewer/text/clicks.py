"""What a click on the page says: whom it means and, where it means a time, when."""

from viewer.theme.events import LATEST


def click(uav: int, t: float) -> str:
    """Write down a UAV and a time of its own, data time [s since 1970]: `7@1700000000.500`; noise is no time."""
    return f"{uav}@{t:.3f}" if 0 <= t < LATEST else f"{uav}"


def clicked(text: str) -> tuple[int, float | None] | None:
    """Read `7` or `7@1700000000.500`; None for anything else, which is somebody's mischief."""
    uav, _, t = text[:40].partition("@")
    if not (uav.isascii() and uav.isdecimal() and len(uav) <= 6):
        return None
    if not t:
        return int(uav), None
    sound = t.isascii() and t.replace(".", "", 1).isdecimal() and float(t) < LATEST
    return (int(uav), float(t)) if sound else None
