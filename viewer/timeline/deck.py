"""Timeline of one page: its controls, the panel, the fleet at the time shown, and what happened after."""

import threading
from collections.abc import Callable
from math import isfinite
from typing import Any

import numpy as np
import viser

from viewer.scene.fleet_arrays import FleetArrays
from viewer.scene.routes import NOTHING
from viewer.scene.strokes import Strokes, chain
from viewer.store.inbox import is_dated, timestamp
from viewer.store.store import FleetStore
from viewer.store.vehicle import Vehicle
from viewer.theme.events import TimelineEvent
from viewer.theme.palette import Palette, mix, rgb
from viewer.timeline import past as compare
from viewer.timeline import strip
from viewer.timeline.past import PastVehicle, update_past_arrays, vehicle_at
from viewer.timeline.recordings import Player, RecordingStore, TimelineRange
from viewer.timeline.strip import drag_attributes

TRANSPORT = ("Pause", "1×", "4×", "● Live")
STEPS = ("◂ event", "◂ 1 s", "◂ frame", "frame ▸", "1 s ▸", "event ▸")
SEND = (
    "var m=window.__viserMutable;m&&m.sendMessage({{type:'GuiUpdateMessage',uuid:'UUID',updates:{{value:'TAG'+{}}}}})"
)


class Panel:
    """Panel handles; `on_command(command)` is called for each press."""

    def __init__(self, gui: Any, palette: Palette, on_command: Callable[[str], None]) -> None:
        self._gui, self._palette = gui, palette
        self._command_input = gui.add_text("asked", "", visible=False)
        self._banner = gui.add_html("")
        self.window = panel = gui.add_panel()
        with panel.add_tab("Timeline", viser.Icon.CLOCK_PLAY):
            self._bar = gui.add_html("")
            gui.add_html(self._buttons())
            self._comparison = gui.add_html("")
        panel.float(x=12, y=-14, width=556)
        self._command_input.on_update(lambda _: on_command(self._command_input.value))
        for label, what in (("pause", "Pause"), ("play at 1×", "1×"), ("play at 4×", "4×"), ("live", "● Live")):
            command = gui.add_command(f"Timeline: {label}", icon=viser.Icon.CLOCK_PLAY)
            command.on_trigger(lambda _, what=what: on_command(what))

    def _buttons(self) -> str:
        """Return all buttons in one row; viser buttons would need two."""
        send = self.send_code("")
        row = (*STEPS[:3], *TRANSPORT, *STEPS[3:])
        buttons = (f'<button onclick="{send.format(repr(what))}">{what}</button>' for what in row)
        return f'<div class="uav time buttons">{"".join(buttons)}</div>'

    def send_code(self, tag: str) -> str:
        """Return page code that sends `tag` and the value inserted at `{}`."""
        return SEND.replace("UUID", str(self._command_input._impl.uuid)).replace("TAG", tag)

    def draw(self, bar: str, head: str, comparison: str, banner: str) -> None:
        """Update the parts that changed."""
        drag = drag_attributes(self.send_code("share:"))
        for node, text in (
            (self._bar, f'<div class="uav time"><div {drag}>{bar}</div>{head}</div>'),
            (self._comparison, f'<div class="uav time soft">{comparison}</div>'),
            (self._banner, f'<div class="then">{banner}</div>' if banner else ""),
        ):
            if node.content != text:
                node.content = text


SHOWN_S = 60.0  # shortest path drawn after the time shown; at least to the prediction horizon [s]
SNAP = 0.008  # share of the bar within which a press snaps to an event
MAX_OTHER_EVENTS = 40  # newest events used of each other UAV


class Timeline:
    """State of one page in time: live, or at a past time."""

    def __init__(
        self, client: Any, store: FleetStore, recordings: RecordingStore, palette: Palette, changed: Callable[[], None]
    ) -> None:
        self.player = Player()
        self._store, self._recordings, self._palette, self._changed = store, recordings, palette, changed
        self._lock = threading.Lock()
        self._span, self._shift = TimelineRange(0.0, 0.0), dict[int, float]()
        self._clock_uav: int | None = None
        self._range_time = -np.inf  # fleet update for which the range was computed
        self._past_arrays, self._drawn_at = FleetArrays(), (-np.inf, -np.inf)  # past fleet; wall and data time of it
        self._panel = Panel(client.gui, palette, self.on_command)
        self._actual_path = Strokes(client.scene, "/timeline/flown", 2.2)  # flown after the time shown
        self._error_lines = Strokes(client.scene, "/timeline/whiskers", 1.6)  # from it to the prediction
        self._path_drawn = False

    def fleet_arrays(self, fleet_arrays: FleetArrays, selected: int | None, now: float) -> FleetArrays:
        """Return the fleet to draw: the given live one, or the fleet at the time shown."""
        elapsed = now - self._drawn_at[0]
        with self._lock:
            if fleet_arrays.now != self._range_time or not self.player.live:
                self._range_time = fleet_arrays.now
                self._update_range(fleet_arrays.fleet, selected)
            self.player.advance(elapsed if isfinite(elapsed) else 0.0, self._span)
            t = self.player.t
        previous, self._drawn_at = self._drawn_at, (now, t or -np.inf)
        if t is None:
            return fleet_arrays
        if self._drawn_at != previous:
            recorded = [vehicle for vehicle in fleet_arrays.fleet if vehicle.uav in self._recordings.by_uav]
            pasts = [past for vehicle in recorded if (past := self._past_vehicle(vehicle, t)) is not None]
            update_past_arrays(self._past_arrays, pasts, now)
        return self._past_arrays

    def vehicle(self, uav: int) -> Vehicle | None:
        """Return one UAV at the time shown; None when there is none."""
        vehicle, t = self._store.get(uav), self.player.t
        if vehicle is None or t is None or uav not in self._recordings.by_uav:
            return vehicle if t is None else None
        return self._past_vehicle(vehicle, t)

    def _past_vehicle(self, vehicle: Vehicle, t: float) -> PastVehicle | None:
        shown_t = t + self._shift.get(vehicle.uav, 0.0)
        return vehicle_at(vehicle, self._recordings.by_uav[vehicle.uav], shown_t, self.player.rate)

    def _update_range(self, fleet: list[Vehicle], selected: int | None) -> None:
        """Update the available time range, on the clock of the selected UAV."""
        recorded = {vehicle.uav: vehicle for vehicle in fleet if len(self._recordings.by_uav.get(vehicle.uav, ()))}
        if not recorded:
            self._span, self._shift, self._clock_uav = TimelineRange(0.0, 0.0), {}, None
            return self.player.go_live()
        if selected not in recorded:
            selected = max(recorded, key=lambda uav: recorded[uav].sample_received)
        self._clock_uav = selected
        self._span, self._shift = self._recordings.playback_range(recorded[self._clock_uav], list(recorded.values()))

    def tab(self, label: str, icon: Any) -> Any:
        """Add a tab beside the timeline; use it in a `with` statement."""
        return self._panel.window.add_tab(label, icon)

    def send_code(self) -> str:
        """Return page code that seeks to the time inserted at `{}`."""
        return self._panel.send_code("at:")

    def on_command(self, command: str) -> None:
        """Execute a command of the page; ignore unknown ones."""
        with self._lock:
            if self._clock_uav is None:
                return
            if command == "Pause":
                self.player.pause(self._span)
            elif command in ("1×", "4×"):
                self.player.play(float(command[0]), self._span)
            elif command == "● Live":
                self.player.go_live()
            elif "▸" in command or "◂" in command:
                self._step(command.strip("◂▸ "), 1 if "▸" in command else -1)
            else:
                self._seek(*command.partition(":")[::2])
        self._changed()

    def show(self, fleet: list[Vehicle], uav: int, t: float) -> None:
        """Show a data time of one UAV [s since 1970]; do nothing without a recording of it."""
        with self._lock:
            if not len(self._recordings.by_uav.get(uav, ())):
                return
            self._update_range(fleet, uav)
            self.player.seek(t, self._span)
            self.player.rate = 0.0
        self._changed()

    def _seek(self, kind: str, text: str) -> None:
        try:
            value = float(text[:20])
        except ValueError:
            return
        if not isfinite(value) or kind not in ("share", "at"):
            return
        span = self._span
        if kind == "share":
            value = span.begin + min(max(value, 0.0), 1.0) * (span.end - span.begin)
            near = min((e.t for e in self._events()), key=lambda t: abs(t - value), default=value)
            value = near if abs(near - value) < SNAP * (span.end - span.begin) else value
        self.player.seek(value, span)
        self.player.rate = 0.0

    def _step(self, unit: str, direction: int) -> None:
        self.player.pause(self._span)
        t = self.player.t or 0.0
        if unit == "1 s":
            return self.player.seek(t + direction, self._span)
        rows = self._recordings.by_uav[self._clock_uav or 0].t.tolist()
        times = [event.t for event in self._events()] if unit == "event" else rows
        if direction > 0:
            target = min((other for other in times if other > t + 1e-3), default=None)
        else:
            target = max((other for other in times if other < t - 1e-3), default=None)
        if target is not None:
            self.player.seek(target, self._span)

    def _events(self) -> list[TimelineEvent]:
        recording = self._recordings.by_uav.get(-1 if self._clock_uav is None else self._clock_uav)
        return list(recording.events) if recording is not None else []

    def draw(self, selected: int | None) -> None:
        """Draw the panel and the path after the time shown; call it about once per second and on changes."""
        vehicle = self.vehicle(selected) if selected is not None and not self.player.live else None
        past = vehicle if isinstance(vehicle, PastVehicle) else None
        lead_errors = self._draw_actual_path(past)
        t, span = self.player.t, self._span
        if self._clock_uav is None:
            return self._panel.draw("", '<span class="soft">no recording yet</span>', "", "")
        recordings = [recording for uav, recording in list(self._recordings.by_uav.items()) if uav != self._clock_uav]
        others = [event for recording in recordings for event in recording.events[-MAX_OTHER_EVENTS:]]
        bar = strip.strip(self._events(), others, span, t, self._palette)
        comparison = ""
        if past is not None:
            issued_t = past.forecast.t if past.forecast is not None else None
            horizon_s = past.forecast.t + past.forecast.horizon_s - past.shown_t if past.forecast is not None else 0.0
            comparison = strip.comparison_html(lead_errors, issued_t, past.shown_t, self._palette, horizon_s)
        self._panel.draw(bar, self._head(t, span), comparison, self._banner(t, span))

    def _draw_actual_path(self, past: PastVehicle | None) -> list[compare.LeadTimeError]:
        """Draw the path flown after the time shown and return the prediction errors; None clears it."""
        if past is None:
            if self._path_drawn:
                self._actual_path.draw(NOTHING.legs)
                self._error_lines.draw(NOTHING.legs)
            self._path_drawn = False
            return []
        forecast, self._path_drawn = past.forecast, True
        horizon_s = max(forecast.t + forecast.horizon_s - past.shown_t, 0.0) if forecast is not None else 0.0
        path = past.recording.path(past.shown_t, past.shown_t + max(horizon_s, SHOWN_S))
        self._actual_path.draw(chain(path[:, 1:]), mix(self._palette.verified, self._palette.ground, 0.9))
        if forecast is None or not len(path):
            self._error_lines.draw(NOTHING.legs)
            return []
        self._error_lines.draw(compare.error_lines(forecast, path, past.shown_t), rgb(self._palette.horizon))
        return compare.lead_time_errors(forecast, path, past.shown_t)

    def _head(self, t: float | None, span: TimelineRange) -> str:
        lag_text = "live" if t is None else f"{strip.duration_text(span.end - t)} ago"
        rate_text = "" if t is None else " · paused" if not self.player.rate else f" · playing {self.player.rate:g}×"
        duration, n = strip.duration_text(span.end - span.begin), len(self._recordings.by_uav)
        storage = f"{duration} of {n} aircraft recorded, {strip.size_text(self._recordings.nbytes())}"
        interval = f"one prediction per UAV every {self._recordings.prediction_step_s:.0f} s"
        shown_t = span.end if t is None else t
        local = f' <span class="soft local" data-t="{shown_t:.0f}"></span>' if is_dated(shown_t) else ""  # first.html
        return (
            f'<div class="head"><span><b class="now">{timestamp(shown_t)}</b>{local}</span>'
            f'<span class="soft" title="{interval}">{lag_text}{rate_text} · {storage}</span></div>'
        )

    def _banner(self, t: float | None, span: TimelineRange) -> str:
        if t is None:
            return ""
        lag = strip.duration_text(span.end - t)
        return f"Not live: showing {timestamp(t)}, {lag} before the newest. Press ● Live to return."
