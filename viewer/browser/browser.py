"""Browser of one page: connection, stored preferences and theme."""

import contextlib
import json
import threading
from collections.abc import Callable
from typing import Any

from viewer.text.missed_events import Presence
from viewer.theme.palette import DARK, LIGHT, Palette

KEY = "parauav-page"  # in the local storage of the browser
LOAD_TIMEOUT_S = 60.0  # a busy browser answers late, and unread preferences would be overwritten


class PagePreferences:
    """Preferences of one page; text from the browser is untrusted."""

    def __init__(self, client: Any, on_loaded: Callable[[], None]) -> None:
        self._client, self._on_loaded = client, on_loaded
        self.uav: int | None = None  # stored selection, until a UAV is selected
        self.light: bool | None = None  # light theme; None: not chosen
        self._saved, self._loaded = "", False
        self._selected: int | None = None  # UAV stored last
        threading.Thread(target=self._load, name="viewer-remembered", daemon=True).start()

    def _load(self) -> None:
        with contextlib.suppress(RuntimeError, TimeoutError):
            self.parse(self._client.local_storage.get_item(KEY, timeout=LOAD_TIMEOUT_S) or "")
        self._loaded = True
        self._on_loaded()

    def parse(self, text: str) -> None:
        """Parse stored preferences; ignore invalid text."""
        with contextlib.suppress(ValueError, RecursionError):
            values = json.loads(text[:200])
            if isinstance(values, dict):
                uav, light = values.get("uav"), values.get("light")
                self.uav = uav if isinstance(uav, int) and not isinstance(uav, bool) else None
                self.light = light if isinstance(light, bool) else None

    def set_theme(self, *, light: bool) -> None:
        """Select a theme and store it at once: a page reloaded before its next redraw has it."""
        self.light = light
        self.save(self._selected)

    def save(self, uav: int | None) -> None:
        """Store selection and theme in the browser when they changed and were loaded before."""
        self._selected = uav
        text = json.dumps({"uav": uav if self.uav is None else self.uav, "light": self.light})
        if self._loaded and text != self._saved:
            self._saved = text
            self._client.local_storage.set_item(KEY, text)


class Browser:
    """State of a page that survives a redraw."""

    def __init__(self, client: Any, palette: Palette, wake: Callable[[], None]) -> None:
        self.client, self._default_palette, self._wake = client, palette, wake
        self.presence, self.preferences = Presence(client), PagePreferences(client, wake)

    @property
    def palette(self) -> Palette:
        """Return the theme chosen in this browser, else the default theme."""
        light = self.preferences.light
        return self._default_palette if light is None else LIGHT if light else DARK

    def set_theme(self, *, light: bool) -> None:
        """Select the light or the dark theme."""
        self.preferences.set_theme(light=light)
        self._wake()
