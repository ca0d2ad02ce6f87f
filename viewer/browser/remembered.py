"""Page preferences in the local storage of the browser: selected UAV and theme."""

import contextlib
import json
import threading
from collections.abc import Callable
from typing import Any

KEY = "parauav-page"  # in the local storage of the browser


class Remembered:
    """Preferences of one page; text from the browser is untrusted."""

    def __init__(self, client: Any, told: Callable[[], None]) -> None:
        self._client, self._told = client, told
        self.uav: int | None = None  # stored selection, until a UAV is selected
        self.light: bool | None = None  # light theme; None: not chosen
        self._kept, self._ready = "", False
        threading.Thread(target=self._ask, name="viewer-remembered", daemon=True).start()

    def _ask(self) -> None:
        with contextlib.suppress(RuntimeError, TimeoutError):
            self.read(self._client.local_storage.get_item(KEY, timeout=10.0) or "")
        self._ready = True
        self._told()

    def read(self, text: str) -> None:
        """Parse stored preferences; ignore invalid text."""
        with contextlib.suppress(ValueError, RecursionError):
            said = json.loads(text[:200])
            if isinstance(said, dict):
                uav, light = said.get("uav"), said.get("light")
                self.uav = uav if isinstance(uav, int) and not isinstance(uav, bool) else None
                self.light = light if isinstance(light, bool) else None

    def keep(self, uav: int | None) -> None:
        """Store selection and theme in the browser when they changed and were loaded before."""
        text = json.dumps({"uav": uav if self.uav is None else self.uav, "light": self.light})
        if self._ready and text != self._kept:
            self._kept = text
            self._client.local_storage.set_item(KEY, text)
