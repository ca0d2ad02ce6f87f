"""Replay an onboard log as messages of its aircraft, in the same steps as a telemetry recording."""

from collections.abc import Iterator
from functools import partial

import numpy as np

from fleet.telemetry.mavlink.aircraft_link import AircraftLink
from fleet.telemetry.mavlink.arrays.fleet_arrays import AircraftArrays
from fleet.telemetry.mavlink.intake import TelemetryMessage
from fleet.telemetry.mavlink.onboard_log import Chunk, OnboardLog
from fleet.telemetry.mavlink.steps import ReplaySteps

ITEM_REPORT_S = 1.0  # period of the current mission item [s]
DEFAULT_EPOCH_S = 946_684_800.0  # 2000-01-01, for logs without date [s since 1970]


def aircraft_of(log: OnboardLog, offset: int) -> AircraftLink:
    """Create the aircraft of a log; UAV id = its MAVLink system id + `offset`."""
    link = AircraftLink(AircraftArrays(), log.system + offset, log.system, 1)
    link.autopilot, link.vehicle_type, link.firmware = log.autopilot, log.vehicle, log.firmware
    return link


def log_steps(log: OnboardLog, link: AircraftLink) -> Iterator[tuple[float, list[TelemetryMessage]]]:
    """Read a log in steps of 0.1 s: (end of the step [s since 1970], messages)."""
    epoch_s = DEFAULT_EPOCH_S if log.epoch_s is None else log.epoch_s
    steps = ReplaySteps(partial(_collect, link))
    newest: dict[str, float] = {}
    item: np.ndarray | None = None  # current mission item, (1,)
    for chunk in log.chunks():
        chunk, item = _repeat_current_item(chunk, item)
        times = [event.t for event in chunk.events] + [time for t, _ in chunk.rows.values() for time in t]
        if times:
            _process_chunk(chunk, link, epoch_s, newest)
            yield from steps.until(np.sort(np.array(times)) + epoch_s)
    yield from steps.remaining()


def _collect(link: AircraftLink, now: float) -> list[TelemetryMessage]:
    """Return the messages up to `now` [s since 1970]."""
    samples = [wire.message() for wire in link.arrays.take_samples(now).values()]
    return [*samples, *link.collect(now)]


def _repeat_current_item(chunk: Chunk, item: np.ndarray | None) -> tuple[Chunk, np.ndarray | None]:
    """Repeat the current item every second, as in telemetry; a log contains only changes.

    Args:
        chunk: time range of a log
        item: item before the chunk, (1,); None if unknown
    Returns:
        chunk with added `leg` rows, item at its end
    """
    t, x = chunk.rows.get("leg", (np.empty(0), np.empty((0, 1))))
    edges = [time for times, _ in chunk.rows.values() for time in times[[0, -1]]]
    if not edges or (item is None and not len(t)):
        return chunk, item
    grid_t = np.arange(np.ceil(min(edges)), max(edges), ITEM_REPORT_S)
    index = np.searchsorted(t, grid_t, side="right")
    items = x[np.clip(index - 1, 0, None)] if len(t) else np.tile(item, (len(grid_t), 1))  # type: ignore[arg-type]
    if len(t) and item is not None:
        items = np.where(index[:, None] > 0, items, item)
    selection = slice(None) if item is not None else index > 0
    all_t, all_x = np.concatenate([t, grid_t[selection]]), np.concatenate([x, items[selection]])
    all_t, unique_rows = np.unique(all_t, return_index=True)
    rows = chunk.rows | {"leg": (all_t, all_x[unique_rows])}
    return chunk._replace(rows=rows), all_x[unique_rows][-1] if len(all_t) else item


def _process_chunk(chunk: Chunk, link: AircraftLink, epoch_s: float, newest: dict[str, float]) -> None:
    _count_messages(chunk, link, epoch_s)
    for field, (t, x) in chunk.rows.items():
        is_new = t > newest.get(field, -np.inf)
        if is_new.any():
            newest[field] = float(t[-1])
            link.arrays.add_rows(link.number, field, t[is_new] + epoch_s, x[is_new])
    for event in chunk.events:
        link.queue(event.t + epoch_s, link.process_log_event, event)


def _count_messages(chunk: Chunk, link: AircraftLink, epoch_s: float) -> None:
    """Count the messages of a chunk, each kind at evenly spaced times."""
    edges = [t[index] for t, _ in chunk.rows.values() if len(t) for index in (0, -1)] or [
        event.t for event in chunk.events
    ]
    if not edges:
        return
    times = {name: np.linspace(min(edges), max(edges), n) for name, n in chunk.counts.items() if n}
    arrival = np.concatenate(list(times.values())) if times else np.empty(0)
    if len(arrival):
        names = np.repeat(np.array(list(times)), [len(t) for t in times.values()])
        order = np.argsort(arrival, kind="stable")
        counts = link.arrays.counts
        kinds = counts.kind_indices(names[order].tolist())
        counts.add_messages(np.full(len(order), link.number), kinds, arrival[order] + epoch_s, None)
