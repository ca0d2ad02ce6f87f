"""Progress display: bars on a terminal, periodic lines otherwise."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

from fleet.process.interrupt import interrupt_deferred

REFRESH_S = 0.5
PLAIN_S = 10.0  # interval of lines without a terminal [s]


class ProgressSource(Protocol):
    """Source of progress."""

    @property
    def name(self) -> str:
        """Return its name."""

    @property
    def share(self) -> float:
        """Return the progress, 0..1."""

    def progress_text(self) -> str:
        """Return additional text."""


@contextmanager
def show_progress(
    sources: Sequence[ProgressSource],
    write_line: Callable[[str], None],
    console: Console | None = None,
    *,
    leave: bool = True,
) -> Iterator[None]:
    """Show progress while the block runs.

    Args:
        sources: sources of progress; read on another thread
        write_line: receives lines without a terminal
        console: output of the bars (default: standard output)
        leave: keep the bars at the end
    """
    console = console or Console()
    if not sources:
        yield
        return

    def show(done: threading.Event) -> None:
        if console.is_terminal:
            _draw_progress(sources, done, console, leave)
        else:
            _write_lines(sources, done, write_line)

    with run_alongside(show):
        yield


@contextmanager
def run_alongside(show: Callable[[threading.Event], None]) -> Iterator[None]:
    """Run `show` on a thread while the block runs; its event argument is set at the end."""
    done = threading.Event()
    thread = threading.Thread(target=show, args=(done,), name="shown")

    def end() -> None:
        with interrupt_deferred():
            done.set()
            if thread.ident is not None:
                thread.join()

    try:
        try:
            with interrupt_deferred():
                thread.start()
            yield
        finally:
            end()
    finally:
        end()  # Ctrl-C may interrupt the first call; a remaining thread would block process exit


def _draw_progress(sources: Sequence[ProgressSource], done: threading.Event, console: Console, leave: bool) -> None:
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TextColumn("{task.fields[words]}"))
    with Progress(*columns, console=console, transient=not leave) as progress:
        task_ids = [progress.add_task(source.name, total=1.0, words="") for source in sources]
        ended = False
        while not ended:
            ended = done.wait(REFRESH_S)
            for task_id, source in zip(task_ids, sources, strict=True):
                progress.update(task_id, completed=source.share, words=source.progress_text())


def _write_lines(sources: Sequence[ProgressSource], done: threading.Event, write_line: Callable[[str], None]) -> None:
    due = time.monotonic() + PLAIN_S
    while not done.wait(max(due - time.monotonic(), 0.0)):
        due += PLAIN_S
        for source in sources:
            write_line(f"{source.name}: {source.share:.0%}, {source.progress_text()}")
