"""The recording driver: messages in time order through the same loop as live, never shedding, as fast as it can."""

from collections.abc import Iterable, Iterator

from fleet.contract import Message
from twin_worker.twin import Twin, advance


def run(messages: Iterable[Message], twins: dict[int, Twin]) -> Iterator[Message]:
    """Drive twins by recorded messages; a twin is made for every new UAV.

    Args:
        messages: Sample, Status, Mission, Params in the order they were heard
        twins: twins by UAV id, filled and changed in place
    Yields:
        Model, Prediction and Alert messages
    """
    for message in messages:
        yield from advance(twins.setdefault(message.uav, Twin(message.uav)), (message,))
