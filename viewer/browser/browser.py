"""The browser of one page: its connection, what it remembers, and in which colours it is to be drawn."""

from collections.abc import Callable
from typing import Any

from viewer.browser.remembered import Remembered
from viewer.text.missed_events import Presence
from viewer.theme.palette import DARK, LIGHT, Palette


class Browser:
    """What stays of a page when it is drawn anew."""

    def __init__(self, client: Any, palette: Palette, wake: Callable[[], None]) -> None:
        self.client, self._usual, self._wake = client, palette, wake
        self.presence, self.remembered = Presence(client), Remembered(client, wake)

    @property
    def palette(self) -> Palette:
        """Return the colours to draw in: those this browser chose, else those the viewer was started with."""
        light = self.remembered.light
        return self._usual if light is None else LIGHT if light else DARK

    def paint(self, *, light: bool) -> None:
        """Draw in light colours from now on, or in dark ones."""
        self.remembered.light = light
        self._wake()
