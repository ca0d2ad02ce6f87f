"""What the browser of a page remembers for it: who was selected, and in which colours. A page that reloads asks."""

import contextlib
import json
import threading
from collections.abc import Callable
from typing import Any

KEY = "parauav-page"  # in the browser's own store


class Remembered:
    """Knows what one page showed when it was last open; what the browser says is a stranger's text."""

    def __init__(self, client: Any, told: Callable[[], None]) -> None:
        self._client, self._told = client, told
        self.uav: int | None = None  # who was selected, until somebody is selected anew
        self.light: bool | None = None  # in light colours; None: never chosen
        self._kept, self._ready = "", False
        threading.Thread(target=self._ask, name="viewer-remembered", daemon=True).start()

    def _ask(self) -> None:
        with contextlib.suppress(RuntimeError, TimeoutError):
            self.read(self._client.local_storage.get_item(KEY, timeout=10.0) or "")
        self._ready = True
        self._told()

    def read(self, text: str) -> None:
        """Take over what was written down; anything else is nothing."""
        with contextlib.suppress(ValueError, RecursionError):
            said = json.loads(text[:200])
            if isinstance(said, dict):
                uav, light = said.get("uav"), said.get("light")
                self.uav = uav if isinstance(uav, int) and not isinstance(uav, bool) else None
                self.light = light if isinstance(light, bool) else None

    def keep(self, uav: int | None) -> None:
        """Let the browser write down who is selected, and in which colours, where that is news and it was asked."""
        text = json.dumps({"uav": uav if self.uav is None else self.uav, "light": self.light})
        if self._ready and text != self._kept:
            self._kept = text
            self._client.local_storage.set_item(KEY, text)
