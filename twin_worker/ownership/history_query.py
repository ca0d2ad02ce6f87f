"""Query the last minutes of one aircraft from a gateway for a twin started without a snapshot."""

from collections.abc import Mapping

from fleet.bus.bus_protocol import Bus
from fleet.contract import History, Message, Mission, Params, Status
from twin_worker.ownership.history_decoder import decode_history

QUERY_TIMEOUT_S = 0.5  # for one message from a gateway [s]
_HISTORY_TIMEOUT_S = 2.0  # for a history of several megabytes [s]
_TRIES = 2  # large answers are dropped on a congested link
LATCHED_TYPES: tuple[type[Message], ...] = (Status, Params, Mission)
"""Rare messages of which the last one stays valid."""


def query_history(bus: Bus, uav: int, cached: Mapping[type, Message]) -> list[Message]:
    """Query the past messages of an aircraft for a new twin; types in `cached` are not queried.

    Raises:
        ConnectionError: when the session is closed; stop, the worker is shutting down.
    """
    latched: list[Message] = []
    for kind in LATCHED_TYPES:
        latched += [cached[kind]] if kind in cached else [message for message, _ in bus.get(kind, uav, QUERY_TIMEOUT_S)]
    for _ in range(_TRIES):
        samples = [
            sample
            for sample in map(decode_history, bus.get_payloads(History, uav, _HISTORY_TIMEOUT_S))
            if sample is not None and sample.uav == uav
        ]
        if samples:
            return [*latched, *samples]
    return latched
