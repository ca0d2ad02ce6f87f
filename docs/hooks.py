"""Hooks of mkdocs: replace the one remote script of the theme with the local one, so that search works offline."""

from pathlib import Path
from typing import Any

REMOTE = "https://unpkg.com/iframe-worker/shim"
LOCAL = "javascripts/file-worker.js"


def on_post_build(config: Any) -> None:
    """Rewrite the address of the script in every page, relative to that page."""
    site = Path(config["site_dir"])
    for path in site.rglob("*.html"):
        up = "../" * (len(path.relative_to(site).parts) - 1)
        path.write_text(path.read_text().replace(REMOTE, up + LOCAL))
