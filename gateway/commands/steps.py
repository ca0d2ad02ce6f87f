"""Steps of an execution: each sends one command, repeats it, and ends when it is acknowledged and verified, or fails.

Source: MAVLink services, "Command Protocol" and "Mission Protocol"; MAV_CMD reference.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from gateway.commands.mission_transfer import (
    RETRY_S,
    MissionRead,
    MissionWrite,
    RawItem,
    Target,
    enum_words,
    is_for_us,
    same_missions,
)

TRIES = 8  # equal commands sent before a step has failed
TRANSFERS = 3  # complete transfers of a mission before it has failed
_WAIT = (dialect.MAV_RESULT_TEMPORARILY_REJECTED, dialect.MAV_RESULT_IN_PROGRESS)
_RESULT_NAMES = enum_words("MAV_RESULT", "MAV_RESULT_")


class StepResult(NamedTuple):
    """Result of a step."""

    accepted: bool
    sentence: str


class CommandStep:
    """Base of all steps; `messages` and `receive` are called until `result` is set.

    Args:
        target: the autopilot
        sentence: what the step does
    """

    transfers_mission = False  # whether other requests for the mission must wait

    def __init__(self, target: Target, sentence: str) -> None:
        self.target, self.sentence = target, sentence
        self.result: StepResult | None = None

    def messages(self, now: float) -> list[Any]:
        """Return the messages to send now; `now` is fleet time [s since 1970]."""
        raise NotImplementedError

    def receive(self, message: Any, now: float) -> None:
        """Process one message of the autopilot."""
        raise NotImplementedError

    def planned(self) -> list[Any]:
        """Return the messages of the step over a link without loss, as far as they are known before."""
        raise NotImplementedError

    def _end(self, accepted: bool, sentence: str) -> None:
        self.result = StepResult(accepted, sentence)


class AcknowledgedCommand(CommandStep):
    """COMMAND_LONG that ends with its COMMAND_ACK.

    Args:
        target: the autopilot
        sentence: what the step does
        command: MAV_CMD
        params: parameters 1..7; missing ones are 0
    """

    def __init__(self, target: Target, sentence: str, command: int, params: Sequence[float]) -> None:
        super().__init__(target, sentence)
        self.command, self.params = command, (*params, *(0.0,) * (7 - len(params)))
        self.sent = 0  # messages sent
        self._sent_t = float("-inf")

    def messages(self, now: float) -> list[Any]:
        """Return the command when it is due."""
        if self.result is not None or now - self._sent_t < RETRY_S:
            return []
        if self.sent >= TRIES:
            self._end(False, f"{self.sentence}: {self._missing()}")
            return []
        self._sent_t = now
        self.sent += 1
        return [self._message(self.sent - 1)]

    def receive(self, message: Any, now: float) -> None:
        """Process COMMAND_ACK."""
        is_answer = message.get_type() == "COMMAND_ACK" and message.command == self.command and is_for_us(message)
        if not is_answer or not self.sent or self.result is not None or message.result in _WAIT:
            return
        if message.result == dialect.MAV_RESULT_ACCEPTED:
            self._acknowledge()
        else:
            result = _RESULT_NAMES.get(message.result, message.result)
            self._end(False, f"{self.sentence}: the autopilot answered {result}")

    def planned(self) -> list[Any]:
        """Return the command, once."""
        return [self._message(0)]

    def _message(self, confirmation: int) -> Any:
        return dialect.MAVLink_command_long_message(*self.target, self.command, confirmation, *self.params)

    def _acknowledge(self) -> None:
        self._end(True, self.sentence)

    def _missing(self) -> str:
        return f"no acknowledgement of {TRIES} messages"


class ModeCommand(AcknowledgedCommand):
    """DO_SET_MODE, verified by the mode in HEARTBEAT.

    Args:
        target: the autopilot
        name: of the mode
        custom_mode: as in HEARTBEAT
        is_px4: the autopilot is PX4, whose main and sub mode are separate parameters
    """

    def __init__(self, target: Target, name: str, custom_mode: int, is_px4: bool) -> None:
        mode = (float(custom_mode >> 16 & 0xFF), float(custom_mode >> 24)) if is_px4 else (float(custom_mode),)
        params = (float(dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED), *mode)
        super().__init__(target, f"mode {name}", dialect.MAV_CMD_DO_SET_MODE, params)
        self._custom_mode = custom_mode

    def receive(self, message: Any, now: float) -> None:
        """Process COMMAND_ACK and HEARTBEAT."""
        super().receive(message, now)
        is_mode = message.get_type() == "HEARTBEAT" and message.custom_mode == self._custom_mode
        if is_mode and self.sent and self.result is None:
            self._end(True, f"{self.sentence}, verified by heartbeat")

    def _acknowledge(self) -> None:
        """Wait for the heartbeat."""

    def _missing(self) -> str:
        return f"no heartbeat with it after {TRIES} messages"


class CurrentItemCommand(AcknowledgedCommand):
    """Change of the current mission item, verified by COMMAND_ACK or MISSION_CURRENT.

    The item is chosen when the current one has been reported. It is not sent again once another item is reported: the
    aircraft has gone on, and must not be sent back.

    Args:
        target: the autopilot
        choose: returns the item to fly to for the reported one; None: the reported one
        is_px4: send MISSION_SET_CURRENT, as PX4 has no such command
    """

    def __init__(self, target: Target, choose: Callable[[int], int | None], *, is_px4: bool) -> None:
        super().__init__(target, "current item", dialect.MAV_CMD_DO_SET_MISSION_CURRENT, ())
        self._choose, self._is_px4 = choose, is_px4
        self._before: int | None = None  # the reported item before the command
        self._seq = -1
        self._begun_t: float | None = None

    def messages(self, now: float) -> list[Any]:
        """Return the command when it is due; none before the current item is reported."""
        self._begun_t = now if self._begun_t is None else self._begun_t
        if self._before is not None:
            return super().messages(now)
        if now - self._begun_t > TRIES * RETRY_S:
            self._end(False, f"{self.sentence}: not reported for {TRIES * RETRY_S:.0f} s")
        return []

    def receive(self, message: Any, now: float) -> None:
        """Process COMMAND_ACK and MISSION_CURRENT."""
        super().receive(message, now)
        if message.get_type() != "MISSION_CURRENT" or self.result is not None or self._begun_t is None:
            return
        if self._before is not None:
            has_changed = message.seq != self._before
            if self.sent and has_changed:
                self._end(True, f"{self.sentence}, now {message.seq}")
            return
        seq, self._before = self._choose(message.seq), message.seq
        if seq is None:
            self._end(True, f"current item {message.seq}, not changed")
            return
        self._seq, self.params = seq, (float(seq), *(0.0,) * 6)
        self.sentence = f"current item {seq}"

    def planned(self) -> list[Any]:
        """Return the command for item 0, as the item is chosen later."""
        self._seq = max(self._seq, 0)
        return super().planned()

    def _message(self, confirmation: int) -> Any:
        if self._is_px4:
            return dialect.MAVLink_mission_set_current_message(*self.target, self._seq)
        return super()._message(confirmation)

    def _missing(self) -> str:
        return f"no acknowledgement or change of it after {TRIES} messages"


class MissionCommand(CommandStep):
    """Upload of a mission: read the former one, write, read back and compare; after errors restore the former one.

    Args:
        target: the autopilot
        plan: returns the mission to send for the mission on board; raises ValueError where it must not be sent
        expected: the mission to send as far as it is known before
        current: returns the item of the sent mission to fly to, for the item that is flown on board
        active_seq: the item that is flown on board
        has_home: item 0 is home, which an upload does not change
    """

    transfers_mission = True

    def __init__(
        self,
        target: Target,
        plan: Callable[[tuple[RawItem, ...]], tuple[RawItem, ...]],
        expected: Sequence[RawItem],
        *,
        current: Callable[[int], int],
        active_seq: int,
        has_home: bool,
    ) -> None:
        super().__init__(target, f"mission of {len(expected)} items")
        self._plan, self._expected, self.current, self._has_home = plan, tuple(expected), current, has_home
        self.active_seq = active_seq  # the item on board that was reported last before the mission was stored
        self.marked = current(active_seq)  # the item marked as the current one, to which PX4 goes
        self.former: tuple[RawItem, ...] = ()  # the mission on board before
        self.items: tuple[RawItem, ...] = ()  # the mission sent
        self.stored: tuple[RawItem, ...] | None = ()  # the mission on board; None: unknown, a write has begun
        self._transfer: MissionRead | MissionWrite | None = None
        self._advance: Callable[[float], None] = self._after_first_read
        self._attempts = 0
        self._error = ""  # of the last transfer

    def messages(self, now: float) -> list[Any]:
        """Return the messages of the present transfer."""
        if self._transfer is None:
            self._transfer = MissionRead(self.target, now)
        out = self._transfer.messages(now)
        if not out and self.result is None and self._transfer.result is not None:
            self._error = self._transfer.result or self._error
            self._advance(now)
            out = self._transfer.messages(now) if self.result is None else []
        return out

    def receive(self, message: Any, now: float) -> None:
        """Process one message of the autopilot."""
        if message.get_type() == "MISSION_CURRENT" and (self.stored is not None or self._is_writing):
            self.active_seq = message.seq
        if self._transfer is not None:
            self._transfer.receive(message, now)

    @property
    def _is_writing(self) -> bool:
        return isinstance(self._transfer, MissionWrite) and self._transfer.result is None

    def planned(self) -> list[Any]:
        """Return the messages of the step without loss; the replies of the autopilot lie between them."""
        target, items = self.target, self._expected
        count = dialect.MAVLink_mission_count_message(*target, len(items))
        read = dialect.MAVLink_mission_request_list_message(*target)
        sent = [item.to_message(target, seq, seq == self.marked) for seq, item in enumerate(items)]
        return [read, count, *sent, read]

    def _write(self, items: tuple[RawItem, ...], now: float, then: Callable[[float], None]) -> None:
        self.stored = None
        self.marked = self.current(self.active_seq) if items is self.items else self.active_seq
        self._transfer, self._advance = MissionWrite(self.target, items, self.marked, now), self._read_back(then)

    def _read_back(self, then: Callable[[float], None]) -> Callable[[float], None]:
        def begin(now: float) -> None:
            self._transfer, self._advance = MissionRead(self.target, now), then

        return begin

    def _is_stored(self, items: tuple[RawItem, ...]) -> bool:
        """Return whether the mission just read is this one."""
        transfer = self._transfer
        complete = isinstance(transfer, MissionRead) and transfer.result == ""
        is_stored = complete and same_missions(items, transfer.items, self._has_home)  # type: ignore[union-attr]
        self.stored = items if is_stored else self.stored
        return is_stored

    def _after_first_read(self, now: float) -> None:
        assert isinstance(self._transfer, MissionRead)
        if self._transfer.result:
            self._end(False, f"{self.sentence}: {self._error}; nothing was changed")
            return
        self.former = self.stored = self._transfer.items
        try:
            self.items = self._plan(self.former)
        except ValueError as error:
            self._end(False, f"{self.sentence}: {error}; nothing was changed")
            return
        self._write(self.items, now, self._after_write)

    def _after_write(self, now: float) -> None:
        self._attempts += 1
        if self._is_stored(self.items):
            self._end(True, f"{self.sentence}, read back and compared")
        elif self._attempts < TRANSFERS:
            self._write(self.items, now, self._after_write)
        elif self._is_stored(self.former):
            self._end(False, f"{self.sentence}: {self._error or 'not stored'}; the former mission is on board")
        else:
            self._attempts = 0
            self._write(self.former, now, self._after_restore)

    def _after_restore(self, now: float) -> None:
        self._attempts += 1
        if self._is_stored(self.former):
            self._end(False, f"{self.sentence}: {self._error or 'not stored'}; the former mission was restored")
        elif self._attempts < TRANSFERS:
            self._write(self.former, now, self._after_restore)
        else:
            reason = self._error or "not stored"
            self._end(False, f"{self.sentence}: {reason}; the mission on board is unknown, read and upload it by hand")
