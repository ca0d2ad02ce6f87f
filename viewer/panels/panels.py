"""Panels of the page: fleet, alerts and display options on the left, selected UAV on the right."""

from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

import viser

from viewer.browser.browser import Browser
from viewer.panels.charts import Charts
from viewer.panels.commands import Commands
from viewer.panels.detail import about, facts
from viewer.panels.event_list import listing
from viewer.store.states import Router, notices
from viewer.store.store import Feed
from viewer.store.vehicle import Vehicle
from viewer.text.clicks import clicked
from viewer.text.missed_events import since
from viewer.text.words import MAX_ROWS, alerts, empty, legend, severity, summary, table
from viewer.theme.palette import WORD, Palette, triple

STALE = "No data from the viewer: this page is out of date. Restart the viewer; the page reconnects automatically."
NOBODY = "–"  # menu entry without a selection


class Panels:
    """All panels of one page."""

    def __init__(
        self,
        browser: Browser,
        palette: Palette,
        choose: Callable[..., None],
        actions: dict[str, Callable[[], None]],
    ) -> None:
        self._gui, self._palette, self._choose = browser.client.gui, palette, choose
        self._presence, self._browser = browser.presence, browser
        self._commands = Commands(self._gui, choose, actions)
        self._beat = False
        self._router = Router()
        self.ground_said = ""  # error of the terrain files
        self.seek = ""  # page code that seeks to the time of an event
        self._gui.configure_theme(
            dark_mode=palette.dark, show_logo=False, show_share_button=False, brand_color=triple(palette.predicting)
        )
        self._gui.set_panel_label("ParaUAV")
        self._gui.main_panel.dock_left()
        self._gui.main_panel.set_width(340)
        css = Path(__file__).with_name("page.css").read_text(encoding="utf-8")
        self._gui.add_html(f"<style>:root{{--muted:{palette.muted}}}{css}</style>")
        self._banner, self._broken, self._legend = (self._gui.add_html("") for _ in range(3))
        self._build_left()
        self._build_right()

    def _build_left(self) -> None:
        gui, tabs = self._gui, self._gui.add_tab_group()
        with tabs.add_tab("Fleet", viser.Icon.DRONE):
            self._notices = gui.add_html("")
            self._summary = gui.add_html("")
            self._search = gui.add_text("Search", "")
            self._show = gui.add_button_group("Show", ("All", "Alerts", "Selected"))
            self._filter = "All"
            self._table = gui.add_html("")
            self._menu = gui.add_dropdown("Select", (NOBODY,))
            self._picked = gui.add_text("picked", "", visible=False)
        with tabs.add_tab("Alerts", viser.Icon.ALERT_TRIANGLE):
            self._since = gui.add_html("")
            self._read = gui.add_button("Mark as read", visible=False)
            self._alerts = gui.add_html("")
        with tabs.add_tab("Display", viser.Icon.ADJUSTMENTS):
            self.predicted = gui.add_checkbox("Predicted paths", True)
            self.trails = gui.add_checkbox("Flown trails", True)
            self.stems = gui.add_checkbox("Altitude stems", True)
            self.tube = gui.add_checkbox("Tube of selected", True)
            self.routes = gui.add_checkbox("Routes of all", False)
            self.follow: Any = gui.add_checkbox("Follow selected", False)
            light = gui.add_checkbox("Light colours", not self._palette.dark)
            self.glyph = gui.add_slider("Aircraft size", min=0.5, max=4.0, step=0.1, initial_value=1.0)
        self._read.on_click(lambda _: self._presence.seen())
        self._menu.on_update(lambda _: self._pick(self._menu.value.removeprefix("UAV-")))
        self._picked.on_update(lambda _: self._pick(self._picked.value))
        light.on_update(lambda _: self._browser.paint(light=light.value))
        self._show.on_click(lambda _: setattr(self, "_filter", self._show.value))

    def _build_right(self) -> None:
        panel = self._gui.add_panel()
        with panel.add_tab("Selected", viser.Icon.FOCUS_2):
            self._about = self._gui.add_html("")
            self._charts = Charts(self._gui, self._palette)
            self._events = self._gui.add_html("")
            self._facts = self._gui.add_html("")
        panel.dock_right()
        panel.set_width(350)

    def _pick(self, text: str) -> None:
        """Select the UAV that a click wrote into the hidden input."""
        if (found := clicked(text)) is not None:
            self._choose(*found)

    def say_broken(self, sentence: str) -> None:
        """Show a drawing error; an empty sentence removes it."""
        said = (
            f'<div class="uav"><div class="say" style="border-color:{self._palette.mismatch}">{escape(sentence)}</div>'
        )
        said = f"{said}</div>" if sentence else ""
        if self._broken.content != said:
            self._broken.content = said

    def draw(self, fleet: list[Vehicle], feed: Feed, now: float, selected: int | None) -> None:
        """Update all panels; call it about once per second and when the selection changes."""
        self._beat, palette, pick = not self._beat, self._palette, self._handler()
        chosen = next((vehicle for vehicle in fleet if vehicle.uav == selected), None)
        kept = [vehicle for vehicle in fleet if self._passes(vehicle, now, selected)]
        kept = sorted(kept, key=lambda vehicle: severity(vehicle, now))[:MAX_ROWS]
        self._presence.here()
        missed = since(fleet, self._presence.away, palette, pick)
        said = (
            (self._banner, f'<div class="stale {"a" if self._beat else "b"}">{STALE}</div>'),
            (self._notices, notices(feed, self._router.say(feed.router, now), self.ground_said, palette)),
            (self._summary, summary(fleet, feed, palette, now) if fleet else empty(feed, now)),
            (self._table, table(kept, palette, now, total=len(fleet), pick=pick, selected=selected) if fleet else ""),
            (self._legend, legend(fleet, palette)),
            (self._since, missed),
            (self._alerts, alerts(fleet, feed, palette, pick)),
            (self._facts, facts(chosen, now) if chosen is not None else ""),
        )
        with self._browser.client.atomic():  # contents first: the block delays all other messages
            for html, text in said:
                html.content = text
            self._list(kept)
            self._read.visible = bool(missed)
            self.show(chosen, now)
            told = listing(chosen.events, palette, self.seek) if chosen is not None else ""
            if told != self._events.content:  # an unchanged list keeps its scroll position
                self._events.content = told
        self._charts.draw(chosen, feed, now)
        self._commands.offer(fleet)

    def show(self, chosen: Vehicle | None, now: float) -> None:
        """Show the status of the selected UAV."""
        nobody = '<div class="uav soft">No UAV selected: click a row or an aircraft, or press Ctrl+K.</div>'
        said = about(chosen, self._palette, now) if chosen is not None else nobody
        if said != self._about.content:
            self._about.content = said

    def _passes(self, vehicle: Vehicle, now: float, selected: int | None) -> bool:
        if self._filter == "Alerts" and not vehicle.alerts:
            return False
        if self._filter == "Selected" and vehicle.uav != selected:
            return False
        if not (wanted := self._search.value.lower().split()):
            return True
        mode = vehicle.status.mode if vehicle.status is not None else ""
        text = f"{vehicle.name} {vehicle.uav} {WORD[vehicle.state(now)]} {mode}".lower()
        return all(word in text for word in wanted)

    def _handler(self) -> str:
        """Return the click handler of a table row: it writes the id into the hidden input."""
        message = f"{{{{type:'GuiUpdateMessage',uuid:'{self._picked._impl.uuid}',updates:{{{{value:'{{}}'}}}}}}}}"
        return f"var m=window.__viserMutable;m&&m.sendMessage({message})"

    def _list(self, kept: list[Vehicle]) -> None:
        """List the rows of the table in the menu."""
        names = NOBODY, *(vehicle.name for vehicle in kept)
        if self._menu.options != names:
            self._menu.options = names
