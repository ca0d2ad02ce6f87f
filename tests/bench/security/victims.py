"""Everyone who reads the bus, bombarded on it: whoever is still right afterwards, in bounded memory, has survived."""

import io
import threading
from collections.abc import Callable
from typing import Any

import msgspec
from rich.console import Console

from fleet.bus.codec import encode
from fleet.bus.session import Bus, connect
from fleet.commands.live.record import BusRecorder
from fleet.commands.live.status import as_objects, fleet_rows, fleet_table
from fleet.commands.live.whatif import as_object, format_text, send_request
from fleet.contract import FleetState, GatewayCounters, Mission, Prediction, Sample, Status, WhatIf
from gateway.publication import Publisher
from tests.bench.peak_memory import peak_mb, reset_peak
from tests.support.examples import EXAMPLES
from twin_worker.service.worker import Worker
from viewer.store.store import FleetStore

from .attack import BOMBARD, UAV, Attack, from_outside, lying
from .trying import until

MOST_MB = 300  # a victim may grow by so much in all; a message of 1 MB may unpack to a hundred
LAST = msgspec.structs.replace(EXAMPLES[Status], sentence="the last word")


class Fallen(Exception):
    """A victim that did not survive."""


def viewer(at: str, attack: Attack) -> str:
    """Bombard the viewer's feed."""
    with connect(at) as bus:
        feed, stop = FleetStore(bus), threading.Event()
        listener = threading.Thread(target=_listen, args=(feed, stop), daemon=True)
        listener.start()
        count = attack(at, BOMBARD)
        _last_word(at, lambda: (vehicle := feed.get(UAV)) is not None and vehicle.status == LAST)
        feed.request_latest()
        stop.set()
        listener.join(10)
        return f"{count} messages, {bus.bad} did not decode, {feed.counts['strange']} were refused"


def _listen(feed: FleetStore, stop: threading.Event) -> None:
    """Take in what comes as often as the viewer does."""
    while not stop.wait(0.1):
        feed.poll()


def worker(at: str, attack: Attack) -> str:
    """Bombard a worker, and let its twins turn."""
    with connect(at) as bus:
        victim, heard = Worker(bus, range(50), omega=0.0), []
        victim.connect()
        bus.subscribe(Status, lambda message, _: heard.append(message))
        count = attack(at, BOMBARD)
        _last_word(at, lambda: LAST in heard)
        victim.sweep()
        if not victim.state().rows or len(encode(victim.state())) > 1 << 20:
            raise Fallen("its table is empty, or larger than the bus lets through")
        return f"{count} messages, {bus.bad} did not decode; it says {victim.state().sentence[:80]!r}"


def recorder(at: str, attack: Attack) -> str:
    """Bombard `fleet record`."""
    with connect(at) as bus:
        file = io.BytesIO()
        victim = BusRecorder(bus, file)
        victim.subscribe()
        count = attack(at, BOMBARD)

        def written() -> bool:
            victim.write()
            return LAST.sentence.encode() in file.getvalue()[-100_000:]

        _last_word(at, written)
        return f"{count} messages, {victim.size >> 20} MB kept as they came, {victim.dropped} dropped and counted"


def tools(at: str, attack: Attack) -> str:
    """Answer `fleet status` and `fleet whatif` with bombs."""
    with connect(at) as bus, lying(at, (FleetState, Status, Prediction)):
        if not until(lambda: bool(bus.get(Status))):
            raise Fallen("no answer arrived, so nothing was tried")
        rows = fleet_rows(bus)
        msgspec.json.encode(as_objects(rows))
        if "\x1b" in _printed(rows) + _told(bus):
            raise Fallen("a stranger's text steers the terminal")
        return f"{len(rows)} rows, {bus.bad} answers did not decode"


def gateway(at: str, attack: Attack) -> str:
    """Ask the gateway everything that no one should ask."""
    with connect(at) as bus:
        publisher = Publisher(bus)
        publisher.publish([EXAMPLES[kind] for kind in (Status, Sample, Mission)])
        publisher.account(EXAMPLES[GatewayCounters])
        count = attack(at, "history", "status", "mission", "params", "alert", "@gateway")
        return _still_answers(at, GatewayCounters, count)


def answers(at: str, attack: Attack) -> str:
    """Ask a worker everything that no one should ask."""
    with connect(at) as bus:
        Worker(bus, range(50), omega=0.0).connect()
        count = attack(at, "prediction", "model", "alert", "mismatch", "@fleet/state", "@claim", "@handover")
        return _still_answers(at, FleetState, count)


Victim = Callable[[str, Attack], str]
VICTIMS: tuple[Victim, ...] = (viewer, worker, recorder, tools, gateway, answers)


def survived(name: str, at: str) -> str:
    """Bombard one from another process; give words. Call it in a process of its own, whose memory is looked at.

    Raises:
        Fallen: when it is wrong afterwards, or took too much memory.
    """
    victim = {one.__name__: one for one in VICTIMS}[name]
    before = reset_peak()
    words = victim(at, from_outside)
    if (grown := peak_mb() - before) > MOST_MB:
        raise Fallen(f"{words}; but it took {grown:.0f} MB more")
    return f"{words}; {grown:.0f} MB more at most"


def _last_word(at: str, heard: Callable[[], bool]) -> None:
    with connect(at) as bus:

        def tell() -> bool:
            bus.publish(LAST)
            return heard()

        if not until(tell):
            raise Fallen("the message after the bombs was not heard")


def _still_answers(at: str, kind: type, count: int) -> str:
    with connect(at) as bus:
        if not until(lambda: bool(bus.get(kind))):
            raise Fallen("it answers no more")
    return f"{count} questions, and it still answers"


def _printed(rows: list[Any]) -> str:
    console = Console(file=io.StringIO(), width=200, color_system=None)
    with console.capture() as shown:
        console.print(fleet_table(rows))
    return shown.get()


def _told(bus: Bus) -> str:
    """Print what is told of one aircraft, where that makes sense at all."""
    try:
        if (made := send_request(bus, UAV, WhatIf())) is None:
            return ""
        msgspec.json.encode(as_object(made))
        return format_text(made, None)
    except ValueError as error:
        return str(error)
