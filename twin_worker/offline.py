"""The recording driver: messages in time order through the same loop as live, never shedding, as fast as it can."""

from collections.abc import Iterable, Iterator

from fleet.contract import Message
from twin_worker.twin import Twin, advance

_TICK_S = 1.0  # the loop also turns where a recording is silent


def run(messages: Iterable[Message], twins: dict[int, Twin]) -> Iterator[Message]:
    """Drive twins by recorded messages; a twin is made for every new UAV.

    Args:
        messages: Sample, Status, Mission, Params in the order they were heard
        twins: twins by UAV id, filled and changed in place
    Yields:
        Model, Prediction and Alert messages
    """
    now: dict[int, float] = {}
    for message in messages:
        twin = twins.setdefault(message.uav, Twin(message.uav))
        while message.t - now.setdefault(message.uav, message.t) > 2 * _TICK_S:
            now[message.uav] += _TICK_S
            yield from advance(twin, (), now[message.uav])
        now[message.uav] = max(now[message.uav], message.t)
        yield from advance(twin, (message,), now[message.uav])
