"""Two senders that use one UAV id: an alarm while they do, withdrawn once the second has been silent."""

from collections.abc import Hashable

from fleet.contract import Alert, AlertKind

QUIET_S = 10.0  # silence of the second sender after which the alarm is over [s]


class Collision:
    """The alarm of one UAV id."""

    def __init__(self, uav: int) -> None:
        self.uav = uav
        self._senders: tuple[Hashable, Hashable] = (None, None)
        self._since = self._last = float("-inf")
        self._raised = False

    def note(self, arrival: float, holder: Hashable, second: Hashable) -> None:
        """Take note that the second sender spoke; `arrival` is fleet time [s since 1970]."""
        if arrival - self._last > QUIET_S:
            self._since = arrival
        self._last, self._senders = arrival, (holder, second)

    def take(self, now: float) -> list[Alert]:
        """Return what changed up to `now` [s since 1970]: the alarm, or its end."""
        on = self._since <= now <= self._last + QUIET_S
        if on == self._raised or now < self._since:
            return []
        self._raised = on
        return [Alert(uav=self.uav, t=now, kind=AlertKind.SECOND_SENDER, active=on, sentence=self._words(on))]

    def _words(self, on: bool) -> str:
        if not on:
            return f"uav-{self.uav}: the second sender of this id is silent"
        holder, second = map(_named, self._senders)
        return (
            f"uav-{self.uav}: found a second sender{second} of this id, expected only the first{holder}; what it says "
            "is refused; give every aircraft its own MAVLink system id, or find out who speaks in its name"
        )


def _named(source: Hashable) -> str:
    """Name a sender, where there is a name."""
    if isinstance(source, tuple) and len(source) >= 2:
        return f" ({source[0]}:{source[1]})"
    return f" ({source})" if source is not None else ""
