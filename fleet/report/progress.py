"""Show how far recordings have come: a bar each on a terminal, a line now and then elsewhere."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

from fleet.process.interrupt import deferred

REFRESH_S = 0.5
PLAIN_S = 10.0  # between lines where the output is no terminal [s]


class Played(Protocol):
    """Something that is worked through."""

    @property
    def name(self) -> str:
        """Name it."""

    @property
    def share(self) -> float:
        """Tell how far it has come, 0..1."""

    def words(self) -> str:
        """Say what else there is to say."""


@contextmanager
def shown(
    played: Sequence[Played], say: Callable[[str], None], console: Console | None = None, *, leave: bool = True
) -> Iterator[None]:
    """Show progress for as long as the block lasts.

    Args:
        played: what is worked through; read on a thread of this block
        say: takes a line where there is no terminal
        console: where the bars go (standard output)
        leave: let the bars stand at the end
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
    """Run `show` on a thread for as long as the block lasts; the event it is given tells it to end."""
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
        end()  # Ctrl-C may have come before the first one began; a thread left behind would keep the process alive


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
