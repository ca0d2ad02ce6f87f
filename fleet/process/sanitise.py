"""What strangers wrote, made harmless: a terminal obeys characters that nobody sees; and numbers below a limit."""

from math import floor


def plain(text: str) -> str:
    """Keep what can be printed: what an aircraft says must not steer the terminal."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def below(found: float, needed: float) -> str:
    """Write a number below a limit with as many digits as it takes to see that it is below: 39.96 of 40, not 40."""
    for digits in range(4):
        text = f"{found:.{digits}f}"
        if float(text) < needed:
            return text
    return f"{floor(found * 1e3) / 1e3:.3f}"
