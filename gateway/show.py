"""What the terminal shows: one line per link, and a bar while a recording plays."""

import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

from gateway.link import Link
from gateway.recorded import Replay

REFRESH_S = 0.5


@contextmanager
def shown(links: Sequence[Link]) -> Iterator[None]:
    """Show the links for as long as the block lasts; bars only on a terminal."""
    for link in links:
        print(f"gateway: {link.spec.text}", flush=True)
    replays = [link for link in links if isinstance(link, Replay)]
    if not replays or not sys.stdout.isatty():
        yield
        return
    done = threading.Event()
    thread = threading.Thread(target=_bars, args=(replays, done), name="bars")
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def _bars(replays: Sequence[Replay], done: threading.Event) -> None:
    with Progress(TextColumn("{task.description}"), BarColumn(), TaskProgressColumn()) as progress:
        bars = [progress.add_task(replay.recording.name, total=1.0) for replay in replays]
        ended = False
        while not ended:
            ended = done.wait(REFRESH_S)
            for bar, replay in zip(bars, replays, strict=True):
                progress.update(bar, completed=replay.recording.share)
