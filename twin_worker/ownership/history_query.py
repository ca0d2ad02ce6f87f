"""Query the last minutes of one aircraft from a gateway for a twin started without a snapshot."""

from collections.abc import Mapping

from fleet.bus.bus_protocol import Bus
from fleet.contract import History, Message, Mission, Params, Status
from twin_worker.ownership.history_decoder import read

PATIENCE_S = 0.5  # for one message from a gateway [s]
_LONG_S = 2.0  # for a history of several megabytes [s]
_TRIES = 2  # large answers are dropped on a congested link
SELDOM: tuple[type[Message], ...] = (Status, Params, Mission)
"""Rare messages of which the last one stays valid."""


def recall(bus: Bus, uav: int, known: Mapping[type, Message]) -> list[Message]:
    """Query the past messages of an aircraft for a new twin; types in `cached` are not queried.

    Raises:
        ConnectionError: when the session is closed; stop, the worker is shutting down.
    """
    found: list[Message] = []
    for kind in SELDOM:
        found += [known[kind]] if kind in known else [said for said, _ in bus.ask(kind, uav, PATIENCE_S)]
    for _ in range(_TRIES):
        heard = [said for said in map(read, bus.fetch(History, uav, _LONG_S)) if said is not None and said.uav == uav]
        if heard:
            return [*found, *heard]
    return found
