"""Checks of the messages on the bus: late clocks of aircraft, stalled predictions, two writers of one key."""

import threading
from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import Any

from fleet.bus.bus_protocol import key_of
from fleet.bus.codec import Stamp, is_plausible_epoch
from fleet.bus.session import Bus
from fleet.contract import Alert, FleetRow, FleetState, Mismatch, Model, Prediction, Status, TwinState
from fleet.health.machine import BAD, NOTE, OK, CheckResult
from fleet.report.report_text import id_ranges

LISTEN_S = 2.2  # every aircraft in flight gets two predictions in this time [s]
LATE_PREDICTION_S = 5.0  # as in `fleet status` [s]
LATE_CLOCK_S = 1.0  # sum of corrections, or distance from satellite time, that is reported [s]
STAMPED = (Prediction, Model, Mismatch, Alert)  # messages of workers, which carry the writer


def check_traffic(bus: Bus) -> Iterator[CheckResult]:
    """Check the messages of a running fleet."""
    writers = listen(bus)
    statuses = [status for status, _ in bus.get(Status)]
    rows = [row for state, _ in bus.get(FleetState) for row in state.rows]
    yield from check_aircraft_clocks(statuses)
    yield from check_predictions(rows)
    yield from check_writers(writers)


def listen(bus: Bus) -> dict[tuple[type, int], set[Stamp | None]]:
    """Receive worker messages for `LISTEN_S` and return the writers by message class and UAV id."""
    writers: dict[tuple[type, int], set[Stamp | None]] = defaultdict(set)
    lock = threading.Lock()

    def on_message(message: Any, stamp: Stamp | None) -> None:
        with lock:
            writers[type(message), message.uav].add(stamp)

    for kind in STAMPED:
        bus.subscribe(kind, on_message)
    threading.Event().wait(LISTEN_S)
    with lock:
        return {key: set(stamps) for key, stamps in writers.items()}


def check_writers(writers: dict[tuple[type, int], set[Stamp | None]]) -> Iterator[CheckResult]:
    """Check that each key has one writer; during a handover the higher epoch follows the lower one."""
    problems = 0
    for (kind, uav), stamps in sorted(writers.items(), key=lambda item: (item[0][1], item[0][0].__name__)):
        key = key_of(kind, uav)
        if None in stamps:
            problems += 1
            yield CheckResult(BAD, "writers", f"{key}: messages without a writer; stop the program that sends them")
        named = sorted(stamp for stamp in stamps if stamp is not None)
        if any(not is_plausible_epoch(stamp.epoch) for stamp in named):
            problems += 1
            text = (
                f"{key}: an epoch in the future, which all readers reject; set the clock of the writer and restart it"
            )
            yield CheckResult(BAD, "writers", text)
        if len({stamp.writer for stamp in named}) > 1:
            problems += 1
            names = " and ".join(sorted({f"{stamp.writer:016x}" for stamp in named}))
            text = f"{key}: written by {names} within {LISTEN_S:g} s; readers use the higher epoch"
            yield CheckResult(BAD, "writers", f"{text}; repeat, and stop one if it persists")
    if writers and not problems:
        yield CheckResult(OK, "writers", f"one for each of {len(writers)} keys received in {LISTEN_S:g} s")


def check_predictions(rows: Iterable[FleetRow]) -> Iterator[CheckResult]:
    """Check that aircraft with telemetry and a verified model have a new prediction."""
    stalled: dict[str, list[FleetRow]] = defaultdict(list)
    current = 0
    for row in rows:
        if row.state not in (TwinState.PREDICTING, TwinState.VERIFIED) or (row.sample_age_s or 0.0) > LATE_PREDICTION_S:
            continue
        if row.prediction_age_s is not None and row.prediction_age_s > LATE_PREDICTION_S:
            stalled[row.worker].append(row)
        else:
            current += 1
    for worker, late in sorted(stalled.items()):
        oldest = max(row.prediction_age_s or 0.0 for row in late)
        text = f"uav {id_ranges(row.uav for row in late)}: newest {oldest:.0f} s old although telemetry arrives"
        remedy = f"worker {worker or 'unknown'} is overloaded or blocked: assign fewer UAVs to it, or restart it"
        yield CheckResult(BAD, "predictions", f"{text}; {remedy}")
    if current and not stalled:
        yield CheckResult(OK, "predictions", f"none of {current} is older than {LATE_PREDICTION_S:g} s")


def check_aircraft_clocks(statuses: Iterable[Status]) -> Iterator[CheckResult]:
    """Check the clocks of the aircraft against arrival times and satellite time."""
    reports = list(statuses)
    late = {s.uav: s.clock_advance_s for s in reports if s.clock_advance_s > LATE_CLOCK_S}
    if late:
        text = f"uav {id_ranges(late)}: timestamps late, corrected by up to {max(late.values()):.1f} s"
        yield CheckResult(NOTE, "aircraft clocks", f"{text}; check load of autopilot and radio, then restart the link")
    if jumps := {s.uav: s.clock_jumps for s in reports if s.clock_jumps}:
        text = f"uav {id_ranges(jumps)}: clock jumped ({max(jumps.values())} times at most)"
        yield CheckResult(NOTE, "aircraft clocks", f"{text}; the autopilot restarted, or two aircraft share one id")
    offsets = {s.uav: s.gps_offset_s for s in reports if s.gps_offset_s is not None}
    if wrong := {uav: offset for uav, offset in offsets.items() if abs(offset) > LATE_CLOCK_S}:
        worst = max(wrong.values(), key=abs)
        side = "ahead of" if worst > 0 else "behind"
        text = f"uav {id_ranges(wrong)}: gateway clock {abs(worst):.1f} s {side} satellite time"
        yield CheckResult(NOTE, "aircraft clocks", f"{text}; synchronise the gateway (chrony), ignore it for a replay")
    if reports and not late and not jumps and not wrong:
        yield CheckResult(OK, "aircraft clocks", f"{len(reports)} aircraft: no late timestamps, no jumps")
