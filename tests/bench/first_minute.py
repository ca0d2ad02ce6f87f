"""What a newcomer sees after `make run`: terminal and page at 10, 30, 60 and 120 s.

    python -m tests.bench.first_minute --out /tmp/first-minute

`fleet up` runs in a pseudo-terminal of 120 columns on ports of its own. Seconds count from its start; with an empty
compile cache the first of them show the compilation. For each time, OUT gets the text on the terminal (`10s.txt`) and
the page of a browser that was opened as soon as its address was printed and served: its picture and all its visible
texts (`10s.png`, `10s-page.txt`; absent before that). Three pictures a second are drawn, in software.
"""

import argparse
import contextlib
import fcntl
import os
import pty
import re
import signal
import struct
import sys
import termios
import threading
import time
from pathlib import Path

from fleet.access.knock import accepts_connections

from .viewing.page import FEW_FRAMES, Page
from .viewing.process import free_port

TIMES_S = (10.0, 30.0, 60.0, 120.0)
PARTS = re.compile(r"\x1b\[(\d*)[0-9;?]*([A-Za-z])|([\r\n])|([^\x1b\r\n]+)")
ADDRESS = re.compile(r"http://127\.0\.0\.1:\d+")


class Terminal:
    """A command in a pseudo-terminal; `text` is what it printed."""

    def __init__(self, command: list[str]) -> None:
        self._pid, self._file = pty.fork()
        if self._pid == 0:
            fcntl.ioctl(0, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 120, 0, 0))
            os.execv(command[0], command)
        self.text = ""
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            while data := os.read(self._file, 65_536):
                self.text += data.decode(errors="replace")

    def screen(self) -> str:
        """Return all lines as a terminal shows them: progress displays move the cursor up and write again."""
        lines, row, column = [""], 0, 0
        read = -1
        while read < len(self.text):  # not in the middle of a display
            read = len(self.text)
            threading.Event().wait(0.1)
        for number, command, control, text in PARTS.findall(self.text):
            if control == "\n":
                row += 1
                lines += [""] * (row + 1 - len(lines))
            elif control == "\r":
                column = 0
            elif command == "A":
                row = max(row - int(number or 1), 0)
            elif command == "K":
                lines[row], column = "", 0
            elif text:
                lines[row] = lines[row][:column].ljust(column) + text + lines[row][column + len(text) :]
                column += len(text)
        return "\n".join(line.rstrip() for line in lines).strip() + "\n"

    def end(self) -> int:
        """Press Ctrl-C and return the exit code."""
        os.kill(self._pid, signal.SIGINT)
        return os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])


def main() -> int:
    """Run the fleet and write what is seen."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--uavs", type=int, default=8)
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    port, router = free_port(), f"tcp/127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "fleet.cli", "up", "--uavs", str(args.uavs), "--port", str(port)]
    begun, ticks = time.monotonic(), threading.Event()
    terminal = Terminal([*command, "--router", router, "--mavlink", f"127.0.0.1:{free_port()}"])
    with Page(args.chromium, FEW_FRAMES) as page:
        opened = False
        for at in TIMES_S:
            while (left := begun + at - time.monotonic()) > 0:
                ticks.wait(min(left, 0.2))
                # the panel prints the address at once, the viewer serves it as soon as it has started
                if not opened and ADDRESS.search(terminal.text) and accepts_connections(f"tcp/127.0.0.1:{port}"):
                    page.page.goto(f"http://127.0.0.1:{port}/")
                    opened = True
            name = f"{at:g}s"
            (args.out / f"{name}.txt").write_text(terminal.screen())
            if opened:
                (args.out / f"{name}-page.txt").write_text(page.page.inner_text("body"))
                page.picture(args.out / f"{name}.png")
            print(f"--- {name}, page {'open' if opened else 'not yet served'}\n{terminal.screen()}", flush=True)
    return terminal.end()


if __name__ == "__main__":
    sys.exit(main())
