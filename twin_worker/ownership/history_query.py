"""The last minutes of one aircraft, from a gateway, for a twin that was never handed over to hear."""

from collections.abc import Mapping

from fleet.bus.bus_protocol import Bus
from fleet.contract import History, Message, Mission, Params, Status
from twin_worker.ownership.history_decoder import read

PATIENCE_S = 0.5  # with a gateway that does not answer [s]
_LONG_S = 2.0  # with one that sends megabytes [s]
_TRIES = 2  # megabytes are dropped on a way that is full
SELDOM: tuple[type[Message], ...] = (Status, Params, Mission)
"""What is said so seldom that the last of each is worth keeping."""


def recall(bus: Bus, uav: int, known: Mapping[type, Message]) -> list[Message]:
    """Ask what was said of an aircraft before, for a fresh twin to hear; what is `known` already is not asked for.

    Raises:
        ConnectionError: when the session is closed.
    """
    found: list[Message] = []
    for kind in SELDOM:
        found += [known[kind]] if kind in known else [said for said, _ in bus.ask(kind, uav, PATIENCE_S)]
    for _ in range(_TRIES):
        heard = [said for said in map(read, bus.fetch(History, uav, _LONG_S)) if said is not None and said.uav == uav]
        if heard:
            return [*found, *heard]
    return found
