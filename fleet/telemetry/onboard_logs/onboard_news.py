"""Replay an onboard log as messages of its aircraft, in the same steps as a telemetry recording."""

from collections.abc import Iterator
from functools import partial

import numpy as np

from fleet.telemetry.mavlink.aircraft_link import Craft
from fleet.telemetry.mavlink.arrays.fleet_arrays import Flock
from fleet.telemetry.mavlink.intake import News
from fleet.telemetry.mavlink.onboard_log import Chunk, OnboardLog
from fleet.telemetry.mavlink.steps import Steps

LEG_S = 1.0  # period of the current mission item [s]
UNDATED_S = 946_684_800.0  # 2000-01-01, for logs without date [s since 1970]


def craft_of(log: OnboardLog, offset: int) -> Craft:
    """Create the aircraft of a log; UAV id = its MAVLink system id + `offset`."""
    craft = Craft(Flock(), log.system + offset, log.system, 1)
    craft.autopilot, craft.kind, craft.firmware = log.autopilot, log.vehicle, log.firmware
    return craft


def log_steps(log: OnboardLog, craft: Craft) -> Iterator[tuple[float, list[News]]]:
    """Read a log in steps of 0.1 s: (end of the step [s since 1970], messages)."""
    epoch_s = UNDATED_S if log.epoch_s is None else log.epoch_s
    steps = Steps(partial(_take, craft))
    newest: dict[str, float] = {}
    leg: np.ndarray | None = None  # current mission item, (1,)
    for chunk in log.chunks():
        chunk, leg = _leg_said_again(chunk, leg)
        times = [said.t for said in chunk.said] + [edge for t, _ in chunk.rows.values() for edge in t]
        if times:
            _digest(chunk, craft, epoch_s, newest)
            yield from steps.upto(np.sort(np.array(times)) + epoch_s)
    yield from steps.last()


def _take(craft: Craft, now: float) -> list[News]:
    """Return the messages up to `now` [s since 1970]."""
    samples = [wire.message() for wire in craft.flock.take(now).values()]
    return [*samples, *craft.take(now)]


def _leg_said_again(chunk: Chunk, leg: np.ndarray | None) -> tuple[Chunk, np.ndarray | None]:
    """Repeat the current item every second, as in telemetry; a log contains only changes.

    Args:
        chunk: time range of a log
        item: item before the chunk, (1,); None if unknown
    Returns:
        chunk with added `leg` rows, item at its end
    """
    t, x = chunk.rows.get("leg", (np.empty(0), np.empty((0, 1))))
    edges = [edge for times, _ in chunk.rows.values() for edge in times[[0, -1]]]
    if not edges or (leg is None and not len(t)):
        return chunk, leg
    often = np.arange(np.ceil(min(edges)), max(edges), LEG_S)
    known = np.searchsorted(t, often, side="right")
    held = x[np.clip(known - 1, 0, None)] if len(t) else np.tile(leg, (len(often), 1))  # type: ignore[arg-type]
    if len(t) and leg is not None:
        held = np.where(known[:, None] > 0, held, leg)
    told = slice(None) if leg is not None else known > 0
    all_t, all_x = np.concatenate([t, often[told]]), np.concatenate([x, held[told]])
    all_t, first = np.unique(all_t, return_index=True)
    rows = chunk.rows | {"leg": (all_t, all_x[first])}
    return chunk._replace(rows=rows), all_x[first][-1] if len(all_t) else leg


def _digest(chunk: Chunk, craft: Craft, epoch_s: float, newest: dict[str, float]) -> None:
    _note(chunk, craft, epoch_s)
    for field, (t, x) in chunk.rows.items():
        fresh = t > newest.get(field, -np.inf)
        if fresh.any():
            newest[field] = float(t[-1])
            craft.flock.lay(craft.number, field, t[fresh] + epoch_s, x[fresh])
    for said in chunk.said:
        craft.queue(said.t + epoch_s, craft.told, said)


def _note(chunk: Chunk, craft: Craft, epoch_s: float) -> None:
    """Count the messages of a chunk, each kind at evenly spaced times."""
    edges = [t[k] for t, _ in chunk.rows.values() if len(t) for k in (0, -1)] or [said.t for said in chunk.said]
    if not edges:
        return
    times = {name: np.linspace(min(edges), max(edges), n) for name, n in chunk.counts.items() if n}
    arrival = np.concatenate(list(times.values())) if times else np.empty(0)
    if len(arrival):
        names = np.repeat(np.array(list(times)), [len(t) for t in times.values()])
        order = np.argsort(arrival, kind="stable")
        counts = craft.flock.counts
        kinds = counts.numbers(names[order].tolist())
        counts.note(np.full(len(order), craft.number), kinds, arrival[order] + epoch_s, None)
