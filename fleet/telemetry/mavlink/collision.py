"""Alert for two senders that use one UAV id; cleared when the second sender is silent."""

from collections.abc import Hashable

from fleet.contract import Alert, AlertKind

QUIET_S = 10.0  # silence of the second sender after which the alert is cleared [s]


class Collision:
    """Second-sender alert of one UAV id."""

    def __init__(self, uav: int) -> None:
        self.uav = uav
        self._senders: tuple[Hashable, Hashable] = (None, None)
        self._since = self._last = float("-inf")
        self._raised = False

    def note(self, arrival: float, holder: Hashable, second: Hashable) -> None:
        """Record a message of the second sender; `arrival` is fleet time [s since 1970]."""
        if arrival - self._last > QUIET_S:
            self._since = arrival
        self._last, self._senders = arrival, (holder, second)

    def take(self, now: float) -> list[Alert]:
        """Return the alert changes up to `now` [s since 1970]."""
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
            f"uav-{self.uav}: found a second sender{second} of this id, expected only the first{holder}; its messages "
            "are rejected; give every aircraft its own MAVLink system id, or identify the second sender"
        )


def _named(source: Hashable) -> str:
    """Return a label of the sender, or an empty string."""
    if isinstance(source, tuple) and len(source) >= 2:
        return f" ({source[0]}:{source[1]})"
    return f" ({source})" if source is not None else ""
