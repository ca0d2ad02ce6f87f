"""The viewer with one thing more on each page: a number that a press counts up, the least that a press can cost.

python -m tests.bench.viewing.echo --port 8090 --router tcp/127.0.0.1:17447
"""

import sys
from typing import Any

from viewer.__main__ import main
from viewer.server import app
from viewer.server.view import View

SEND = "window.__viserMutable.sendMessage({{type:'GuiUpdateMessage',uuid:'{}',updates:{{value:''+Math.random()}}}})"


class Echoing(View):
    """A page that answers."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        gui, self._pressed = self.client.gui, 0
        asked = gui.add_text("echo", "", visible=False)
        self._echo, self._send = gui.add_html(""), SEND.format(asked._impl.uuid)
        asked.on_update(lambda _: self._answer())
        self._answer()

    def _answer(self) -> None:
        self._pressed += 1
        self._echo.content = f'<i class="echo" onpointerdown="{self._send}">{self._pressed}</i>'
        self.client.flush()


if __name__ == "__main__":
    app.View = Echoing  # type: ignore[misc]
    sys.exit(main())
