"""Check that a built site loads nothing from another host: `python -m docs.check_offline site`."""

import re
import sys
from html.parser import HTMLParser
from pathlib import Path

LOADED_ATTRIBUTES = {("script", "src"), ("img", "src"), ("iframe", "src"), ("source", "src"), ("link", "href")}
PASSIVE_LINKS = {
    "canonical",
    "alternate",
    "prev",
    "next",
    "author",
    "license",
    "edit",
}  # links that a browser does not load
REMOTE = re.compile(r"^(?:[a-z]+:)?//", re.I)
REMOTE_IN_CSS = re.compile(r"(?:@import\s+|url\()\s*[\"']?((?:https?:)?//[^\"')\s]+)", re.I)


class Resources(HTMLParser):
    """Collect the remote addresses that a browser loads with a page."""

    def __init__(self) -> None:
        super().__init__()
        self.remote: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect the remote addresses of one element."""
        attributes = dict(attrs)
        if tag == "link" and set((attributes.get("rel") or "").split()) <= PASSIVE_LINKS:
            return
        for name, value in attrs:
            if (tag, name) in LOADED_ATTRIBUTES and REMOTE.match(value or ""):
                self.remote.append(str(value))


def remote_resources(site: Path) -> list[str]:
    """List the remote resources of a site as `FILE: ADDRESS`."""
    resources = []
    for path in sorted(site.rglob("*.html")):
        page = Resources()
        page.feed(path.read_text())
        resources += [f"{path.relative_to(site)}: {address}" for address in page.remote]
    for path in sorted(site.rglob("*.css")):
        resources += [f"{path.relative_to(site)}: {address}" for address in REMOTE_IN_CSS.findall(path.read_text())]
    return resources


def main(argv: list[str]) -> int:
    """Print the remote resources; return 1 if there are any, or if there is no site."""
    site = Path(argv[0])
    problems = remote_resources(site) if (site / "index.html").is_file() else [f"{site}: no site, run `make docs`"]
    print("\n".join(problems), end="\n" if problems else "", file=sys.stderr)
    return bool(problems)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
