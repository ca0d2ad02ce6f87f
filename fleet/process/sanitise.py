"""Escape control characters in untrusted text, and format numbers below a limit."""

from math import floor


def printable(text: str) -> str:
    """Replace non-printable characters by `?`, because a terminal executes control characters in untrusted text."""
    return "".join(char if char.isprintable() else "?" for char in text)


def format_below(value: float, limit: float) -> str:
    """Format a number below a limit with enough digits to show that it is below: 39.96 for a limit of 40, not 40."""
    for digits in range(4):
        text = f"{value:.{digits}f}"
        if float(text) < limit:
            return text
    return f"{floor(value * 1e3) / 1e3:.3f}"
