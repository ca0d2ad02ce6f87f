"""Offline driver: recorded messages in time order through the same loop as live, without load shedding."""

from collections.abc import Iterable, Iterator

from fleet.contract import Message
from twin_worker.alerts.traffic import TrafficMonitor
from twin_worker.twin.step import Twin, advance


def run_offline(
    messages: Iterable[Message], twins: dict[int, Twin], traffic: TrafficMonitor | None = None
) -> Iterator[Message]:
    """Drive twins with recorded messages; every new UAV gets a twin.

    Args:
        messages: Sample, Status, Mission, Params in the order they were received
        twins: twins by UAV id, filled and changed in place
        traffic: conflict assessment of all pairs, changed in place; None: a new one
    Yields:
        Model, Prediction and Alert messages
    """
    traffic = traffic or TrafficMonitor()
    for message in messages:
        twin = twins.get(message.uav)
        if twin is None:
            twin = twins[message.uav] = Twin.of(message.uav)
        results = advance(twin, (message,))
        yield from traffic.process_results(twin.config.uav, twin.telemetry.last_step_t, results)
