"""Steps that execute the change of one aircraft, and those that restore its plan from before."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.contract import Change, Item
from fleet.telemetry.mavlink.aircraft_link import AircraftLink
from gateway.commands.approval_check import Situation
from gateway.commands.autopilot_modes import commanded_modes, default_speed, mission_speed
from gateway.commands.mission_transfer import RawItem, Target, planned_items, same_missions
from gateway.commands.steps import (
    AcknowledgedCommand,
    CommandStep,
    CurrentItemCommand,
    MissionCommand,
    ModeCommand,
)


@dataclass
class FormerPlan:
    """Plan of one aircraft before an execution, and the steps that changed it."""

    seq: int
    mode: str
    custom_mode: int
    speed: float | None  # [m/s]; None: not known
    steps: list[CommandStep]
    final_mode: str = ""  # mode after the last step

    @property
    def changed(self) -> list[CommandStep]:
        """Return the steps that may have changed something."""
        return [step for step in self.steps if _has_changed(step)]

    @property
    def is_restorable(self) -> bool:
        """Return whether every changed part can be restored."""
        speeds = [step for step in self.changed if type(step) is AcknowledgedCommand]
        return bool(self.changed) and (self.speed is not None or not speeds)


def _has_changed(step: CommandStep) -> bool:
    if isinstance(step, MissionCommand):
        return step.stored != step.former
    return isinstance(step, AcknowledgedCommand) and step.sent > 0


def former_plan(aircraft: AircraftLink, commanded_speed: float | None) -> FormerPlan:
    """Return the present plan of an aircraft, to be restored later.

    Args:
        aircraft: the aircraft
        commanded_speed: speed that was commanded from here last [m/s]; None: none
    """
    speed = commanded_speed or mission_speed(aircraft.mission.items, aircraft.mission.seq)
    speed = speed or default_speed(aircraft.vehicle, aircraft.params.values)
    return FormerPlan(max(aircraft.mission.seq, 0), aircraft.mode, aircraft.custom_mode, speed, [])


def change_steps(aircraft: AircraftLink, change: Change, situation: Situation) -> list[CommandStep]:
    """Return the steps of a change, in the order in which they are sent: mission, item, speed, mode."""
    target, is_px4 = (aircraft.system, aircraft.component), aircraft.autopilot == "px4"
    steps: list[CommandStep] = []
    if change.items is not None:
        seq = change.seq
        if seq is None:
            seq = _same_item(change.items, situation.published_items, max(aircraft.mission.seq, 0))
        expected = planned_items(change.items, (), (), is_px4)
        plan = partial(_proposed_mission, change.items, situation, is_px4)
        steps.append(MissionCommand(target, plan, expected, current=seq, has_home=not is_px4))
        old, new = situation.published_items[aircraft.mission.seq : aircraft.mission.seq + 1], change.items[seq]
        reload = not is_px4 and old != (msgspec.structs.replace(new, seq=aircraft.mission.seq),)
        steps.append(CurrentItemCommand(target, seq, is_px4=is_px4, reload=reload))
    elif change.seq is not None:
        steps.append(CurrentItemCommand(target, change.seq, is_px4=is_px4))
    if change.speed is not None:
        steps.append(_speed_command(aircraft, change.speed))
    if change.mode:
        mode = commanded_modes(aircraft.autopilot, aircraft.vehicle)[change.mode]
        steps.append(ModeCommand(target, mode.name, mode.custom_mode, is_px4))
    return steps


def undo_steps(aircraft: AircraftLink, former: FormerPlan) -> list[CommandStep]:
    """Return the steps that restore a former plan, only of what was changed: mission, item, speed, mode."""
    target, is_px4 = (aircraft.system, aircraft.component), aircraft.autopilot == "px4"
    return [again for step in former.changed for again in _undo(step, aircraft, former, target, is_px4)]


def _undo(
    step: CommandStep, aircraft: AircraftLink, former: FormerPlan, target: Target, is_px4: bool
) -> Iterator[CommandStep]:
    if isinstance(step, MissionCommand):
        seq = _same_raw_item(step.former, step.items, max(aircraft.mission.seq, 0), former.seq)
        plan = partial(_former_mission, step, not is_px4)
        yield MissionCommand(target, plan, step.former, current=seq, has_home=not is_px4)
        yield CurrentItemCommand(target, seq, is_px4=is_px4, reload=not is_px4)
    elif isinstance(step, ModeCommand):
        yield ModeCommand(target, former.mode, former.custom_mode, is_px4)
    elif isinstance(step, CurrentItemCommand):
        if not any(isinstance(one, MissionCommand) for one in former.changed):
            yield CurrentItemCommand(target, former.seq, is_px4=is_px4)
    elif former.speed is not None:
        yield _speed_command(aircraft, former.speed)


def _speed_command(aircraft: AircraftLink, speed: float) -> AcknowledgedCommand:
    kind = (
        1.0 if commanded_modes(aircraft.autopilot, aircraft.vehicle).get("land") and not _has_wings(aircraft) else 0.0
    )
    params = (kind, speed, -1.0)  # airspeed or ground speed, the speed, no change of throttle
    target = aircraft.system, aircraft.component
    return AcknowledgedCommand(target, f"speed {speed:.1f} m/s", dialect.MAV_CMD_DO_CHANGE_SPEED, params)


def _has_wings(aircraft: AircraftLink) -> bool:
    return aircraft.vehicle not in ("multirotor", "helicopter")


def _proposed_mission(
    items: tuple[Item, ...], situation: Situation, is_px4: bool, on_board: tuple[RawItem, ...]
) -> tuple[RawItem, ...]:
    """Return the mission to send where the one on board is still that of the proposal.

    Raises:
        ValueError: when it is another one.
    """
    expected = [RawItem.from_item(item, item.param4) for item in situation.items]
    if not same_missions(expected, on_board, not is_px4):
        raise ValueError("the mission on board is not the one of the proposal")
    return planned_items(items, on_board, situation.published_items, is_px4)


def _former_mission(step: MissionCommand, has_home: bool, on_board: tuple[RawItem, ...]) -> tuple[RawItem, ...]:
    """Return the former mission where the one on board is still what the execution left.

    Raises:
        ValueError: when somebody has uploaded another one since.
    """
    if step.stored is not None and not same_missions(step.stored, on_board, has_home):
        raise ValueError("the mission on board is not the one that was uploaded")
    return step.former


def _same_item(items: tuple[Item, ...], present: tuple[Item, ...], seq: int) -> int:
    """Return the number in a proposed mission of the item that is flown now; where it is left out, its old number."""
    current = present[seq : seq + 1]
    numbers = [item.seq for item in items if (msgspec.structs.replace(item, seq=seq),) == current]
    return min(numbers, key=lambda number: abs(number - seq), default=min(seq, len(items) - 1))


def _same_raw_item(former: tuple[RawItem, ...], sent: tuple[RawItem, ...], seq: int, former_seq: int) -> int:
    """Return the number in the former mission of the item that is flown now; where it is new, that from before."""
    current = sent[seq : seq + 1]
    numbers = [number for number, item in enumerate(former) if current and item.is_stored_as(current[0])]
    return min(numbers, key=lambda number: abs(number - seq), default=min(former_seq, max(len(former) - 1, 0)))
