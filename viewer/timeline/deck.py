"""Timeline of one page: player, panel, and the fleet at the time shown."""

import threading
from collections.abc import Callable
from math import isfinite
from typing import Any

import numpy as np

from viewer.scene.fleet_arrays import Flock
from viewer.store.received.datatime import stamp
from viewer.store.store import Feed
from viewer.store.vehicle import Vehicle
from viewer.theme.events import Event
from viewer.theme.palette import Palette
from viewer.timeline import strip
from viewer.timeline.after import After
from viewer.timeline.panel import Panel
from viewer.timeline.past import Past, as_it_was, remember
from viewer.timeline.player import Player, Span, last_before, next_after
from viewer.timeline.recordings import Tapes

SNAP = 0.008  # share of the bar within which a press snaps to an event
OTHERS = 40  # newest events used of each other UAV


class Timeline:
    """State of one page in time: live, or at a past time."""

    def __init__(self, client: Any, feed: Feed, tapes: Tapes, palette: Palette, changed: Callable[[], None]) -> None:
        self.player = Player()
        self._feed, self._tapes, self._palette, self._changed = feed, tapes, palette, changed
        self._lock = threading.Lock()
        self._span, self._shift = Span(0.0, 0.0), dict[int, float]()
        self._lead: int | None = None
        self._measured = -np.inf  # fleet update for which the range was computed
        self._then, self._drawn_at = Flock(), (-np.inf, -np.inf)  # past fleet; wall and data time of it
        self._panel = Panel(client.gui, palette, self.asked)
        self._after = After(client.scene, palette)

    # --- what is shown ---

    def flock(self, flock: Flock, selected: int | None, now: float) -> Flock:
        """Return the fleet to draw: the given live one, or the fleet at the time shown."""
        passed = now - self._drawn_at[0]
        with self._lock:
            if flock.now != self._measured or not self.player.live:
                self._measured = flock.now
                self._measure(flock.fleet, selected)
            self.player.advance(passed if isfinite(passed) else 0.0, self._span)
            t = self.player.t
        before, self._drawn_at = self._drawn_at, (now, t or -np.inf)
        if t is None:
            return flock
        if self._drawn_at != before:
            self._remember(flock.fleet, t, now)
        return self._then

    def one(self, uav: int) -> Vehicle | None:
        """Return one UAV at the time shown; None when there is none."""
        vehicle, t = self._feed.one(uav), self.player.t
        if vehicle is None or t is None or uav not in self._tapes.of:
            return vehicle if t is None else None
        return self._past(vehicle, t)

    def _past(self, vehicle: Vehicle, t: float) -> Past | None:
        then = t + self._shift.get(vehicle.uav, 0.0)
        return as_it_was(vehicle, self._tapes.of[vehicle.uav], then, self.player.rate)

    def _remember(self, fleet: list[Vehicle], t: float, now: float) -> None:
        """Update the fleet of a past time."""
        found = [past for one in fleet if one.uav in self._tapes.of and (past := self._past(one, t)) is not None]
        remember(self._then, found, now)

    def _measure(self, fleet: list[Vehicle], selected: int | None) -> None:
        """Update the available time range, on the clock of the selected UAV."""
        taped = {one.uav: one for one in fleet if len(self._tapes.of.get(one.uav, ()))}
        if not taped:
            self._span, self._shift, self._lead = Span(0.0, 0.0), {}, None
            return self.player.go_live()
        self._lead = selected if selected in taped else max(taped, key=lambda uav: taped[uav].heard)
        self._span, self._shift = self._tapes.measure(taped[self._lead], list(taped.values()))

    # --- commands ---

    def tab(self, label: str, icon: Any) -> Any:
        """Add a tab beside the timeline; use it in a `with` statement."""
        return self._panel.window.add_tab(label, icon)

    def sender(self) -> str:
        """Return page code that seeks to the time inserted at `{}`."""
        return self._panel.sender("at:")

    def asked(self, what: str) -> None:
        """Execute a command of the page; ignore unknown ones."""
        with self._lock:
            if self._lead is None:
                return
            if what == "Pause":
                self.player.pause(self._span)
            elif what in ("1×", "4×"):
                self.player.play(float(what[0]), self._span)
            elif what == "● Live":
                self.player.go_live()
            elif "▸" in what or "◂" in what:
                self._step(what.strip("◂▸ "), 1 if "▸" in what else -1)
            else:
                self._seek(*what.partition(":")[::2])
        self._changed()

    def show(self, fleet: list[Vehicle], uav: int, t: float) -> None:
        """Show a data time of one UAV [s since 1970]; do nothing without a recording of it."""
        with self._lock:
            if not len(self._tapes.of.get(uav, ())):
                return
            self._measure(fleet, uav)
            self.player.seek(t, self._span)
            self.player.rate = 0.0
        self._changed()

    def _seek(self, how: str, text: str) -> None:
        try:
            value = float(text[:20])
        except ValueError:
            return
        if not isfinite(value) or how not in ("share", "at"):
            return
        span = self._span
        if how == "share":
            value = span.begin + min(max(value, 0.0), 1.0) * (span.end - span.begin)
            near = min((e.t for e in self._events()), key=lambda t: abs(t - value), default=value)
            value = near if abs(near - value) < SNAP * (span.end - span.begin) else value
        self.player.seek(value, span)
        self.player.rate = 0.0

    def _step(self, what: str, way: int) -> None:
        self.player.pause(self._span)
        t = self.player.t or 0.0
        if what == "1 s":
            found: float | None = t + way
        else:
            rows = self._tapes.of[self._lead or 0].t.tolist()
            times = [event.t for event in self._events()] if what == "event" else rows
            found = next_after(t, times) if way > 0 else last_before(t, times)
        if found is not None:
            self.player.seek(found, self._span)

    def _events(self) -> list[Event]:
        tape = self._tapes.of.get(-1 if self._lead is None else self._lead)
        return list(tape.events) if tape is not None else []

    # --- the panel ---

    def draw(self, selected: int | None) -> None:
        """Draw the panel and the path after the time shown; call it about once per second and on changes."""
        one = self.one(selected) if selected is not None and not self.player.live else None
        past = one if isinstance(one, Past) else None
        misses = self._after.draw(past)
        t, span = self.player.t, self._span
        if self._lead is None:
            return self._panel.draw("", '<span class="soft">no recording yet</span>', "", "")
        tapes = [tape for uav, tape in list(self._tapes.of.items()) if uav != self._lead]
        others = [e for tape in tapes for e in tape.events[-OTHERS:] if span.begin <= e.t <= span.end]
        bar = strip.strip(self._events(), others, span, t, self._palette)
        words = ""
        if past is not None:
            told = past.forecast
            reach = told.t + told.until - past.then if told is not None else 0.0
            words = strip.compared(misses, told.t if told is not None else None, past.then, self._palette, reach)
        self._panel.draw(bar, self._head(t, span), words, self._banner(t, span))

    def _head(self, t: float | None, span: Span) -> str:
        behind = "live" if t is None else f"{strip.length(span.end - t)} ago"
        pace = "" if t is None else " · paused" if not self.player.rate else f" · playing {self.player.rate:g}×"
        lasts, n = strip.length(span.end - span.begin), len(self._tapes.of)
        kept = f"{lasts} of {n} UAVs recorded, {strip.size(self._tapes.nbytes())}"
        apart = f"one prediction per UAV every {self._tapes.apart_s:.0f} s"
        return (
            f'<div class="head"><b class="now">{stamp(span.end if t is None else t)}</b>'
            f'<span class="soft" title="{apart}">{behind}{pace} · {kept}</span></div>'
        )

    def _banner(self, t: float | None, span: Span) -> str:
        if t is None:
            return ""
        return f"Not live: showing {stamp(t)}, {strip.length(span.end - t)} before the newest. Press ● Live to return."
