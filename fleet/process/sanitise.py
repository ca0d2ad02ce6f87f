"""Escape control characters in untrusted text, and format numbers below a limit."""

from math import floor


def plain(text: str) -> str:
    """Replace non-printable characters by `?`, because a terminal executes control characters in untrusted text."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def below(found: float, needed: float) -> str:
    """Format a number below a limit with enough digits to show that it is below: 39.96 for a limit of 40, not 40."""
    for digits in range(4):
        text = f"{found:.{digits}f}"
        if float(text) < needed:
            return text
    return f"{floor(found * 1e3) / 1e3:.3f}"
