"""Sizes with unit prefixes: 500M, 10G."""

import re

_UNITS = {"": 1, "k": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}


def read_size(text: str, option: str) -> int:
    """Parse a size such as `500M` or `10G` [bytes], the value of a command line `option`.

    Raises:
        ValueError: when it is not a size.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([kMGT]?)B?", text.strip())
    if match is None or float(match[1]) <= 0:
        raise ValueError(f"{option}: found {text!r}, expected a size such as 500M or 10G; correct it")
    return round(float(match[1]) * _UNITS[match[2]])


def format_size(size: float) -> str:
    """Format a size [bytes] with at most four digits."""
    for unit in ("", "k", "M", "G"):
        if size < 1000:
            return f"{size:.0f} {unit}B" if size >= 100 or not unit else f"{size:.1f} {unit}B"
        size /= 1000
    return f"{size:.1f} TB"
