"""Self-contained HTML page without scripts and external resources."""

from html import escape
from pathlib import Path

from fleet.process.sanitise import printable
from fleet.report.ink import BAD, GOOD, GRID, INK, LINES, MUTED, ROUTE

_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"  # no external resources, no scripts
_COLOURS = {"ink": INK, "muted": MUTED, "line": GRID, "good": GOOD, "bad": BAD, "doubt": LINES[3], "odd": ROUTE}


def document(title: str, body: str) -> str:
    """Return a page in the project style; `title` is text, `body` is HTML."""
    colours = "".join(f"--{name}:{colour};" for name, colour in _COLOURS.items())
    style = f":root{{{colours}}}\n" + Path(__file__).with_name("page.css").read_text(encoding="utf-8")
    head = (
        f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
    )
    return (
        "<!DOCTYPE html>\n<html "
        f'lang="en"><head>{head}<title>{escape_text(title)}</title>\n<style>{style}</style></head>\n'
        f"<body><main>\n{body}\n</main></body></html>\n"
    )


def escape_text(text: str) -> str:
    """Escape untrusted text, such as a file name."""
    return escape(printable(text))
