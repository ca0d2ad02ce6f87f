"""Progress display: bars on a terminal, periodic lines otherwise."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

from fleet.process.interrupt import deferred

REFRESH_S = 0.5
PLAIN_S = 10.0  # interval of lines without a terminal [s]


class Played(Protocol):
    """Source of progress."""

    @property
    def name(self) -> str:
        """Return its name."""

    @property
    def share(self) -> float:
        """Return the progress, 0..1."""

    def words(self) -> str:
        """Return additional text."""


@contextmanager
def shown(
    played: Sequence[Played], say: Callable[[str], None], console: Console | None = None, *, leave: bool = True
) -> Iterator[None]:
    """Show progress while the block runs.

    Args:
        sources: sources of progress; read on another thread
        write_line: receives lines without a terminal
        console: output of the bars (default: standard output)
        leave: keep the bars at the end
    """
    console = console or Console()
    if not played:
        yield
        return
    draw = _bars if console.is_terminal else _lines
    with alongside(lambda done: draw(played, done, say, console, leave=leave)):
        yield


@contextmanager
def alongside(show: Callable[[threading.Event], None]) -> Iterator[None]:
    """Run `show` on a thread while the block runs; its event argument is set at the end."""
    done = threading.Event()
    thread = threading.Thread(target=show, args=(done,), name="shown")

    def end() -> None:
        with deferred():
            done.set()
            if thread.ident is not None:
                thread.join()

    try:
        try:
            with deferred():
                thread.start()
            yield
        finally:
            end()
    finally:
        end()  # Ctrl-C may interrupt the first call; a remaining thread would block process exit


def _bars(
    played: Sequence[Played], done: threading.Event, _: Callable[[str], None], console: Console, *, leave: bool
) -> None:
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TextColumn("{task.fields[words]}"))
    with Progress(*columns, console=console, transient=not leave) as progress:
        bars = [progress.add_task(one.name, total=1.0, words="") for one in played]
        ended = False
        while not ended:
            ended = done.wait(REFRESH_S)
            for bar, one in zip(bars, played, strict=True):
                progress.update(bar, completed=one.share, words=one.words())


def _lines(
    played: Sequence[Played], done: threading.Event, say: Callable[[str], None], _: Console, *, leave: bool
) -> None:
    del leave
    due = time.monotonic() + PLAIN_S
    while not done.wait(max(due - time.monotonic(), 0.0)):
        due += PLAIN_S
        for one in played:
            say(f"{one.name}: {one.share:.0%}, {one.words()}")
