"""The recording driver: messages in time order through the same loop as live, never shedding, as fast as it can."""

from collections.abc import Iterable, Iterator

from fleet.contract import Message
from twin_worker.alerts.traffic import Traffic
from twin_worker.twin.step import Twin, advance


def run(messages: Iterable[Message], twins: dict[int, Twin], traffic: Traffic | None = None) -> Iterator[Message]:
    """Drive twins by recorded messages; a twin is made for every new UAV.

    Args:
        messages: Sample, Status, Mission, Params in the order they were heard
        twins: twins by UAV id, filled and changed in place
        traffic: judge of all pairs, changed in place; None makes one that ends with the messages
    Yields:
        Model, Prediction and Alert messages
    """
    traffic = traffic or Traffic()
    for message in messages:
        twin = twins.get(message.uav)
        if twin is None:
            twin = twins[message.uav] = Twin(message.uav)
        results = advance(twin, (message,))
        yield from traffic.after(twin.uav, twin.turned_t, results)
