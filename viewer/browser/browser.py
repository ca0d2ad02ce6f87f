"""Browser of one page: connection, stored preferences and theme."""

from collections.abc import Callable
from typing import Any

from viewer.browser.remembered import PagePreferences
from viewer.text.missed_events import Presence
from viewer.theme.palette import DARK, LIGHT, Palette


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
