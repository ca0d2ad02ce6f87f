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
        expected = planned_items(change.items, (), (), is_px4)
        plan = partial(_proposed_mission, change.items, situation, is_px4)
        active_seq = max(aircraft.mission.seq, 0)
        current = partial(_proposed_item, change, situation.published_items, active_seq)
        step = MissionCommand(target, plan, expected, current=current, active_seq=active_seq, has_home=not is_px4)
        steps += [step, CurrentItemCommand(target, partial(_item_to_command, step, is_px4), is_px4=is_px4)]
    elif change.seq is not None:
        steps.append(CurrentItemCommand(target, partial(_unless_current, change.seq), is_px4=is_px4))
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
        plan = partial(_former_mission, step, not is_px4)
        current = partial(_same_raw_item, step.former, step.items, former.seq)
        active_seq = max(aircraft.mission.seq, 0)
        again = MissionCommand(target, plan, step.former, current=current, active_seq=active_seq, has_home=not is_px4)
        yield again
        yield CurrentItemCommand(target, partial(_item_to_command, again, is_px4), is_px4=is_px4)
    elif isinstance(step, ModeCommand):
        yield ModeCommand(target, former.mode, former.custom_mode, is_px4)
    elif isinstance(step, CurrentItemCommand):
        if not any(isinstance(one, MissionCommand) for one in former.changed):
            yield CurrentItemCommand(target, partial(_unless_current, former.seq), is_px4=is_px4)
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


def _unless_current(seq: int, reported: int) -> int | None:
    return None if reported == seq else seq


def _item_to_command(step: MissionCommand, is_px4: bool, reported: int) -> int | None:
    """Return the item to command after an upload; None where the aircraft flies the right one by itself.

    PX4 begins at the marked item. ArduPilot goes on at the same number, with the item as it was before the upload: it
    loads an item when it becomes current. Where another item is reported, the aircraft has gone on in the new mission.
    """
    if reported != (step.marked if is_px4 else step.active_seq):
        return None
    seq = step.current(step.active_seq)
    if seq != reported:
        return seq
    before, now = step.former[step.active_seq : step.active_seq + 1], step.items[seq]
    is_same = bool(before) and before[0].is_stored_as(now)
    return None if is_px4 or is_same else seq


def _proposed_item(change: Change, present: tuple[Item, ...], approved: int, active_seq: int) -> int:
    """Return the item of a proposed mission to fly to, for the item that is flown on board.

    It is the one that the proposal names, or a later one where the aircraft has gone on since the approval.

    Args:
        change: proposed mission, and the item that it names
        present: mission on board
        approved: item on board that was flown at the approval
        active_seq: item on board that is flown
    """
    items = change.items or ()
    if change.seq is None:
        return _same_item(items, present, active_seq)
    has_advanced = active_seq != approved and change.seq >= _same_item(items, present, approved)
    return max(change.seq, _same_item(items, present, active_seq)) if has_advanced else change.seq


def _same_item(items: tuple[Item, ...], present: tuple[Item, ...], active_seq: int) -> int:
    """Return the number in a proposed mission of the item that is flown; where that is changed, its old number."""
    current = present[active_seq : active_seq + 1]
    numbers = [item.seq for item in items if (msgspec.structs.replace(item, seq=active_seq),) == current]
    return min(numbers, key=lambda number: abs(number - active_seq), default=min(active_seq, len(items) - 1))


def _same_raw_item(former: tuple[RawItem, ...], sent: tuple[RawItem, ...], former_seq: int, active_seq: int) -> int:
    """Return the number in the former mission of the item that is flown.

    Where that was changed, the same number, or where there is none, the number of the item flown before the upload.
    """
    current = sent[active_seq : active_seq + 1]
    numbers = [number for number, item in enumerate(former) if current and item.is_stored_as(current[0])]
    default = active_seq if len(sent) == len(former) else min(former_seq, max(len(former) - 1, 0))
    return min(numbers, key=lambda number: abs(number - active_seq), default=default)
