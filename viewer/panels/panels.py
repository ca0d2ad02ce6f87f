"""Panels of the page: fleet, alerts and display options on the left, selected UAV on the right."""

import time
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

import viser

from viewer.browser.http_server import Browser, parse_layout
from viewer.panels.approval import ApprovalDialog, execution_html
from viewer.panels.charts import Charts
from viewer.panels.detail import figures_html, status_html
from viewer.panels.proposals import proposals_html
from viewer.store.inbox import date_text, time_of_day, timestamp
from viewer.store.states import notices
from viewer.store.store import FleetStore
from viewer.store.vehicle import Vehicle
from viewer.text.missed_events import missed_events_html, parse_click
from viewer.text.units import AVIATION, METRIC, Units
from viewer.text.words import (
    MAX_ROWS,
    alerts_html,
    empty_html,
    key_value_table,
    legend_html,
    severity,
    state_style,
    summary_html,
    table,
)
from viewer.theme.events import TimelineEvent
from viewer.theme.palette import Palette, triple

MAX_EVENT_ROWS = 40  # events shown; earlier ones are counted


def event_list_html(events: tuple[TimelineEvent, ...], palette: Palette, seek: str = "") -> str:
    """Return the events as HTML, newest first; texts are escaped here.

    `seek` is page code that seeks to the time inserted at `{}`; empty: rows are not clickable.
    """
    if not events:
        return '<div class="uav"><b>Events</b> <span class="soft">none yet</span></div>'
    rows = "".join(_row(event, palette, seek) for event in reversed(events[-MAX_EVENT_ROWS:]))
    earlier = len(events) - MAX_EVENT_ROWS
    more = f'<div class="soft">and {earlier} earlier</div>' if earlier > 0 else ""
    return (
        f'<div class="uav"><b>Events</b> <span class="soft">{len(events)} · {date_text(events[-1].t)}</span>'
        f'<div class="events">{rows}{more}</div></div>'
    )


def _row(event: TimelineEvent, palette: Palette, seek: str) -> str:
    press = f' onpointerdown="{seek.format(event.t)}"' if seek else ""
    return (
        f'<div class="event" data-kind="{event.kind.value}" title="{timestamp(event.t)}"{press}>'
        f'<span class="num soft">{time_of_day(event.t)}</span>'
        f'<b style="color:{palette.event(event.kind)}">{event.kind.glyph}</b><span>{escape(event.text)}</span></div>'
    )


KEYS = {
    "J, K": "next, previous aircraft; in the list also ↓ and ↑",
    "/": "search; Enter selects the id or the first row",
    "T, V, C": "camera from above, from the side, behind the selected aircraft",
    "F, L": "fit all; follow the selected aircraft",
    "N": "next aircraft with an alert",
    "M, X": "measure, or end it; point in the middle of the view",
    "P": "pause, or live again",
    ", and .": "1 s back, forward",
    "[ and ]": "previous, next event",
    "W A S D, arrows": "move the camera",
    "Ctrl+K": "all commands",
}
"""Keys of the page and what each does."""
MAX_OFFERED = 200  # UAVs in the palette; the search field finds the others


STALE = "No data from the viewer: this page is out of date. Restart the viewer; the page reconnects automatically."


class Panels:
    """All panels of one page.

    Args:
        browser: the page
        palette: its colours
        choose: selects a UAV
        actions: commands of the palette, each with its key
        approvals: approves proposals; None: this page has no way to do so
    """

    def __init__(
        self,
        browser: Browser,
        palette: Palette,
        choose: Callable[..., None],
        actions: dict[str, tuple[str, Callable[[], None]]],
        approvals: ApprovalDialog | None = None,
    ) -> None:
        self._gui, self._palette, self._choose = browser.client.gui, palette, choose
        self._browser, self._approvals = browser, approvals
        self._offered: set[int] = set()  # UAVs with a selection command
        self._workers: list[str] = []  # texts of the workers
        for label, (key, act) in actions.items():
            self._gui.add_command(label, hotkey=key).on_trigger(lambda _, act=act: act())  # type: ignore[arg-type]
        self._pulse = False
        self.ground_error = ""  # error of the terrain files
        self.seek = ""  # page code that seeks to the time of an event
        self._gui.configure_theme(
            dark_mode=palette.dark, show_logo=False, show_share_button=False, brand_color=triple(palette.predicting)
        )
        self._gui.set_panel_label("ParaUAV")
        self._gui.main_panel.dock_left()
        css = Path(__file__).with_name("page.css").read_text(encoding="utf-8")
        self._gui.add_html(f"<style>:root{{--muted:{palette.muted}}}{css}</style>")
        self._legend_place, layout_input = self._gui.add_html(""), self._gui.add_text("layout", "", visible=False)
        layout_input.on_update(lambda _: self._set_layout(layout_input.value))
        report = f"window.reportLayout('{layout_input._impl.uuid}')"  # defined in first.html
        self._gui.add_html(f'<img src="data:," alt="" style="display:none" onerror="{report}">')
        self._banner, self._error, self._legend = (self._gui.add_html("") for _ in range(3))
        self._unit_style, self._measure = (self._gui.add_html("") for _ in range(2))
        self._build_left()
        self._build_right()

    def _build_left(self) -> None:
        gui, tabs, browser = self._gui, self._gui.add_tab_group(), self._browser
        with tabs.add_tab("Fleet", viser.Icon.DRONE):
            self._notices = gui.add_html("")
            self._summary = gui.add_html("")
            self._search = gui.add_text("Search", "")
            self._show = gui.add_button_group("Show", ("All", "Alerts", "Selected"))
            self._filter = "All"
            self._table = gui.add_html("")
            self._pick_input = gui.add_text("picked", "", visible=False)
        with tabs.add_tab("Alerts", viser.Icon.ALERT_TRIANGLE):
            self._missed = gui.add_html("")
            self._acknowledge = gui.add_button("Mark as read", visible=False)
            self._alerts = gui.add_html("")
        with tabs.add_tab("Display", viser.Icon.ADJUSTMENTS):
            self.predicted = gui.add_checkbox("Predicted paths", True)
            self.trails = gui.add_checkbox("Flown trails", True)
            self.stems = gui.add_checkbox("Altitude stems", True)
            self.tube = gui.add_checkbox("Tube of selected", True)
            self.routes = gui.add_checkbox("Routes of all", False)
            self.world = gui.add_checkbox("Coast and borders", True)
            self.follow: Any = gui.add_checkbox("Follow selected", False)
            self.measure_button = gui.add_button("Measure distance", icon=viser.Icon.RULER_MEASURE)
            light = gui.add_checkbox("Light colours", not self._palette.dark)
            aviation = gui.add_checkbox("Knots, feet, nautical miles", browser.aviation)
            self.glyph = gui.add_slider("Aircraft size", min=0.5, max=4.0, step=0.1, initial_value=1.0)
            keys = key_value_table((f"<b>{escape(key)}</b>", escape(text)) for key, text in KEYS.items())
            self.region = gui.add_html("")
            gui.add_html(f'<div class="uav keys"><b>Keys</b>{keys}</div>')
        self._acknowledge.on_click(lambda _: setattr(browser, "absence", None))
        self._pick_input.on_update(lambda _: self._pick(self._pick_input.value))
        light.on_update(lambda _: browser.set_theme(light=light.value))
        aviation.on_update(lambda _: browser.set_units(aviation=aviation.value))
        self._show.on_click(lambda _: setattr(self, "_filter", self._show.value))

    def _build_right(self) -> None:
        panel = self._gui.add_panel()
        with panel.add_tab("Selected", viser.Icon.FOCUS_2):
            self._about = self._gui.add_html("")
            self._proposals = self._gui.add_html("")
            self._approval_code = ""  # page code that sends the text of a button
            if self._approvals is not None:
                self._add_approval_input(self._approvals)
            self.charts = Charts(self._gui, self._palette)
            self._events = self._gui.add_html("")
            self._facts = self._gui.add_html("")
        panel.dock_right()
        self._right, self._widths = panel, (0, 0)
        self._fit_panels()

    def _set_layout(self, text: str) -> None:
        """Fit the panels to the window that the page reports."""
        if (layout := parse_layout(text)) is not None:
            self._browser.layout = layout
            self._fit_panels()

    @property
    def units(self) -> Units:
        """Return the units chosen on this page."""
        return AVIATION if self._browser.aviation else METRIC

    def _fit_panels(self) -> None:
        if (widths := self._browser.layout.panel_widths()) != self._widths:
            self._widths = widths
            self._gui.main_panel.set_width(widths[0])
            self._right.set_width(widths[1])
            sides = f"--left:{widths[0] + 4}px;--right:{widths[1] + 4}px"
            self._legend_place.content = f"<style>:root{{{sides}}}</style>"

    def _pick(self, text: str) -> None:
        """Select the UAV that a click wrote into the hidden input."""
        if (click := parse_click(text)) is not None:
            self._choose(*click)

    def _add_approval_input(self, approvals: ApprovalDialog) -> None:
        """Add the hidden input into which the buttons of an approval write."""
        hidden = self._gui.add_text("approval", "", visible=False)

        def on_update(_: object) -> None:
            if text := hidden.value:
                hidden.value = ""  # the same button may be pressed again
                approvals.on_click(text, time.monotonic())

        hidden.on_update(on_update)
        self._approval_code = self._handler(hidden)

    def show_error(self, sentence: str) -> None:
        """Show a drawing error; an empty sentence removes it."""
        card = f'<div class="say" style="border-color:{self._palette.mismatch}">{escape(sentence)}</div>'
        _update(self._error, f'<div class="uav">{card}</div>' if sentence else "")

    def show_measure(self, html: str) -> None:
        """Show the state of the measure tool; empty while it is off."""
        _update(self._measure, html)

    def draw(
        self, fleet: list[Vehicle], store: FleetStore, now: float, selected: int | None, *, scene: Callable[[], None]
    ) -> None:
        """Update all panels; call it about once per second and when the selection changes.

        `scene` draws labels and ring of the same records: the page receives both in one block of messages.
        """
        self._pulse, palette, pick = not self._pulse, self._palette, self._handler(self._pick_input)
        selected_vehicle = next((vehicle for vehicle in fleet if vehicle.uav == selected), None)
        terms = self._search.value.lower().split()
        shown = [vehicle for vehicle in fleet if self._passes(vehicle, now, selected, terms)]
        shown = sorted(shown, key=lambda vehicle: severity(vehicle, now))[:MAX_ROWS]
        self._browser.mark_present()
        self._workers = store.worker_texts()
        missed = missed_events_html(fleet, self._browser.absence, palette, pick)
        contents = (
            (self._unit_style, f"<style>:root{{--aviation:{int(self._browser.aviation)}}}</style>"),
            (self._banner, f'<div class="stale {"a" if self._pulse else "b"}">{STALE}</div>'),
            (self._notices, notices(store, self.ground_error, palette, now)),
            (self._summary, summary_html(fleet, store, palette, now) if fleet else empty_html(store, now)),
            (self._table, table(shown, palette, now, total=len(fleet), pick=pick, selected=selected) if fleet else ""),
            (self._legend, legend_html(fleet, palette)),
            (self._missed, missed),
            (self._alerts, alerts_html(fleet, palette, now, pick)),
            (self._facts, figures_html(selected_vehicle, now, self.units) if selected_vehicle is not None else ""),
        )
        with self._browser.client.atomic():  # contents first: the block delays all other messages
            for html, text in contents:
                html.content = text
            self._acknowledge.visible = bool(missed)
            self.show(selected_vehicle, now)
            events = selected_vehicle.events if selected_vehicle is not None else None
            _update(self._events, "" if events is None else event_list_html(events, palette, self.seek))
            scene()
        self._offer(fleet)

    def _offer(self, fleet: list[Vehicle]) -> None:
        """Add selection commands for the first `MAX_OFFERED` UAVs."""
        for vehicle in fleet[:MAX_OFFERED]:
            if vehicle.uav not in self._offered and len(self._offered) < MAX_OFFERED:
                command = self._gui.add_command(f"Select {vehicle.name}", icon=viser.Icon.DRONE)
                command.on_trigger(lambda _, uav=vehicle.uav: self._choose(uav))
                self._offered.add(vehicle.uav)

    def show(self, vehicle: Vehicle | None, now: float) -> None:
        """Show the status of the selected UAV."""
        units, workers = self.units, self._workers
        placeholder = '<div class="uav soft">No UAV selected: click a row or an aircraft, or press Ctrl+K.</div>'
        _update(
            self._about,
            placeholder if vehicle is None else status_html(vehicle, self._palette, now, units, workers),
        )
        proposals = "" if vehicle is None else self._proposals_html(vehicle, now)
        _update(self._proposals, f'<div class="uav">{proposals}</div>' if proposals else "")

    def _proposals_html(self, vehicle: Vehicle, now: float) -> str:
        """Return confirmation, execution and proposals of the selected UAV."""
        code, palette = self._approval_code, self._palette
        pending = "" if self._approvals is None else self._approvals.html(vehicle, palette, now, code)
        executed = execution_html(vehicle.execution, vehicle.uav, palette, code)
        return pending + executed + proposals_html(vehicle, palette, now, self.units, code)

    def _passes(self, vehicle: Vehicle, now: float, selected: int | None, terms: list[str]) -> bool:
        if self._filter == "Alerts" and not vehicle.alerts:
            return False
        if self._filter == "Selected" and vehicle.uav != selected:
            return False
        if not terms:
            return True
        mode = vehicle.status.mode if vehicle.status is not None else ""
        text = f"{vehicle.name} {vehicle.uav} {state_style(vehicle.record(now))[2]} {mode}".lower()
        return all(term in text for term in terms)

    def _handler(self, hidden: Any) -> str:
        """Return the click handler that writes what is inserted at `{}` into a hidden input."""
        message = f"{{{{type:'GuiUpdateMessage',uuid:'{hidden._impl.uuid}',updates:{{{{value:'{{}}'}}}}}}}}"
        return f"var m=window.__viserMutable;m&&m.sendMessage({message})"


def _update(html: Any, text: str) -> None:
    """Update a text only when it differs: an unchanged list keeps its scroll position."""
    if html.content != text:
        html.content = text
