"""Floating panel of the timeline: bar, playback buttons, steps and comparison text."""

from collections.abc import Callable
from typing import Any

import viser

from viewer.theme.palette import Palette
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
        for node, text in (
            (
                self._bar,
                f'<div class="uav time"><div {drag_attributes(self.send_code("share:"))}>{bar}</div>{head}</div>',
            ),
            (self._comparison, f'<div class="uav time soft">{comparison}</div>'),
            (self._banner, f'<div class="then">{banner}</div>' if banner else ""),
        ):
            if node.content != text:
                node.content = text
