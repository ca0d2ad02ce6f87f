"""Floating panel of the timeline: bar, playback buttons, steps and comparison text."""

from collections.abc import Callable
from typing import Any

import viser

from viewer.theme.palette import Palette
from viewer.timeline.strip import touched

TRANSPORT = ("Pause", "1×", "4×", "● Live")
STEPS = ("◂ event", "◂ 1 s", "◂ frame", "frame ▸", "1 s ▸", "event ▸")
SEND = (
    "var m=window.__viserMutable;m&&m.sendMessage({{type:'GuiUpdateMessage',uuid:'UUID',updates:{{value:'TAG'+{}}}}})"
)


class Panel:
    """Panel handles; `on_command(command)` is called for each press."""

    def __init__(self, gui: Any, palette: Palette, asked: Callable[[str], None]) -> None:
        self._gui, self._palette = gui, palette
        self._asked = gui.add_text("asked", "", visible=False)
        self._banner = gui.add_html("")
        self.window = panel = gui.add_panel()
        with panel.add_tab("Timeline", viser.Icon.CLOCK_PLAY):
            self._bar = gui.add_html("")
            gui.add_html(self._buttons())
            self._words = gui.add_html("")
        panel.float(x=12, y=-14, width=556)
        self._asked.on_update(lambda _: asked(self._asked.value))
        for label, what in (("pause", "Pause"), ("play at 1×", "1×"), ("play at 4×", "4×"), ("live", "● Live")):
            command = gui.add_command(f"Timeline: {label}", icon=viser.Icon.CLOCK_PLAY)
            command.on_trigger(lambda _, what=what: asked(what))

    def _buttons(self) -> str:
        """Return all buttons in one row; viser buttons would need two."""
        send = self.sender("")
        row = (*STEPS[:3], *TRANSPORT, *STEPS[3:])
        made = (f'<button onclick="{send.format(repr(what))}">{what}</button>' for what in row)
        return f'<div class="uav time buttons">{"".join(made)}</div>'

    def sender(self, tag: str) -> str:
        """Return page code that sends `tag` and the value inserted at `{}`."""
        return SEND.replace("UUID", str(self._asked._impl.uuid)).replace("TAG", tag)

    def draw(self, bar: str, head: str, words: str, banner: str) -> None:
        """Update the parts that changed."""
        for node, text in (
            (self._bar, f'<div class="uav time"><div {touched(self.sender("share:"))}>{bar}</div>{head}</div>'),
            (self._words, f'<div class="uav time soft">{words}</div>'),
            (self._banner, f'<div class="then">{banner}</div>' if banner else ""),
        ):
            if node.content != text:
                node.content = text
