"""Export buttons of the page."""

from collections.abc import Callable
from html import escape
from typing import Any

import viser

from viewer.export.film import Film
from viewer.export.picture import picture
from viewer.export.table import table
from viewer.store.received.datatime import stamp
from viewer.store.store import Feed
from viewer.theme.palette import Palette
from viewer.timeline.recordings import Tapes


class Export:
    """Three buttons on one page; each creates a file and sends it to the browser."""

    def __init__(
        self, client: Any, feed: Feed, tapes: Tapes, palette: Palette, chosen: Callable[[], int | None]
    ) -> None:
        self._client, self._feed, self._tapes, self._palette, self._chosen = client, feed, tapes, palette, chosen
        gui = client.gui
        for label, icon, make in (
            ("View as PNG", viser.Icon.CAMERA, self._picture),
            ("Flight as HTML", viser.Icon.MOVIE, self._film),
            ("Selected UAV as CSV", viser.Icon.TABLE, self._table),
        ):
            gui.add_button(label, icon=icon).on_click(lambda _, make=make: self._hand(make))
        self._said = gui.add_html("")

    def _hand(self, make: Callable[[], tuple[str, bytes]]) -> None:
        """Create a file and send it; show errors on the page."""
        self._say("exporting …")
        try:
            name, data = make()
        except (ValueError, OSError) as error:
            return self._say(str(error))
        self._client.send_file_download(name, data, save_immediately=True)
        self._say(f"{name}, {len(data) / 1e6:.1f} MB")

    def _say(self, text: str) -> None:
        self._said.content = f'<div class="uav soft">{escape(text)}</div>'

    def _uav(self) -> int:
        if (uav := self._chosen()) is None:
            raise ValueError("export: found no selection, expected a UAV; click a row or an aircraft")
        return uav

    def _picture(self) -> tuple[str, bytes]:
        return f"{self._name('view')}.png", picture(self._client, self._palette)

    def _film(self) -> tuple[str, bytes]:
        uav = self._uav()
        film = Film(self._feed, self._tapes, self._palette)
        text = film.html(uav, lambda share: self._say(f"exporting: {share:.0%}"))
        return f"{self._name(f'uav-{uav}')}.html", text.encode()

    def _table(self) -> tuple[str, bytes]:
        uav, place = self._uav(), self._tapes.place
        tape = self._tapes.of.get(uav)
        if tape is None or place is None or not len(tape):
            raise ValueError(f"export: found no recording of uav-{uav}, expected a flight; wait for its samples")
        return f"{self._name(f'uav-{uav}')}.csv", table(tape, place).encode()

    def _name(self, what: str) -> str:
        """Return a file name with its content and the newest data time."""
        newest = max((tape.t[-1] for tape in list(self._tapes.of.values()) if len(tape)), default=0.0)
        return f"parauav-{what}-{stamp(float(newest))}".replace(":", "").replace(" ", "-").replace("+", "")
