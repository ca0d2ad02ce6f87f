"""What strangers wrote, made harmless: a terminal obeys characters that nobody sees."""


def plain(text: str) -> str:
    """Keep what can be printed: what an aircraft says must not steer the terminal."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)
