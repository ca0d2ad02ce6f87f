"""Mission learnt item by item, as they become the current one, where no list is received."""

from fleet.contract import MAX_ITEMS, Item

_NO_POSITION = 95  # MAV_CMD_NAV_LAST: an item that moves nothing
_JUMP, _ENDLESS = 177, -1.0  # MAV_CMD_DO_JUMP, repeat count
_MAX_SKIPPED = 10  # a larger step forward is a command of the operator, not a row of actions


class LearnedMission:
    """Items known so far; what is between them follows from the order in which they are flown.

    A step forward over numbers shows actions without a position, a step back a jump after the item before it.
    """

    def __init__(self) -> None:
        self._known: dict[int, Item] = {}
        self._between: dict[int, Item] = {}
        self._current = -1

    @property
    def items(self) -> tuple[Item, ...]:
        """Return the items in order."""
        return tuple(item for _, item in sorted((self._between | self._known).items()))

    def add(self, item: Item) -> bool:
        """Add the current item; return whether anything new was is_new."""
        before, self._current = self._current, item.seq
        is_new = self._known.get(item.seq) != item
        self._known[item.seq] = item
        if before < 0 or item.seq in (before, before + 1):
            return is_new
        if before + 1 < item.seq <= before + _MAX_SKIPPED:
            between = {seq: Item(seq=seq, command=_NO_POSITION) for seq in range(before + 1, item.seq)}
        elif item.seq < before and before + 1 < MAX_ITEMS:
            between = {before + 1: Item(seq=before + 1, command=_JUMP, param1=float(item.seq), param2=_ENDLESS)}
        else:
            return is_new
        new = {seq: other for seq, other in between.items() if seq not in self._known and seq not in self._between}
        self._between |= new
        return is_new or bool(new)

    def add_known(self, item: Item) -> None:
        """Add an item that is not the current one."""
        self._known[item.seq] = item
