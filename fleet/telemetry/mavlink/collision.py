"""Alert for two senders that use one UAV id; cleared when the second sender is silent."""

from collections.abc import Hashable

from fleet.contract import Alert, AlertKind

CLEAR_AFTER_S = 10.0  # silence of the second sender after which the alert is cleared [s]


class SenderConflict:
    """Second-sender alert of one UAV id."""

    def __init__(self, uav: int) -> None:
        self.uav = uav
        self._senders: tuple[Hashable, Hashable] = (None, None)
        self._first_arrival = self._last_arrival = float("-inf")
        self._raised = False

    def record_conflict(self, arrival: float, first: Hashable, second: Hashable) -> None:
        """Record a message of the second sender; `arrival` is fleet time [s since 1970]."""
        if arrival - self._last_arrival > CLEAR_AFTER_S:
            self._first_arrival = arrival
        self._last_arrival, self._senders = arrival, (first, second)

    def take_alerts(self, now: float) -> list[Alert]:
        """Return the alert changes up to `now` [s since 1970]."""
        active = self._first_arrival <= now <= self._last_arrival + CLEAR_AFTER_S
        if active == self._raised or now < self._first_arrival:
            return []
        self._raised = active
        return [Alert(uav=self.uav, t=now, kind=AlertKind.SECOND_SENDER, active=active, sentence=self._text(active))]

    def _text(self, active: bool) -> str:
        if not active:
            return f"uav-{self.uav}: the second sender of this id is silent"
        first, second = map(_sender_label, self._senders)
        return (
            f"uav-{self.uav}: found a second sender{second} of this id, expected only the first{first}; its messages "
            "are rejected; give every aircraft its own MAVLink system id, or identify the second sender"
        )


def _sender_label(sender: Hashable) -> str:
    """Return a label of the sender, or an empty string."""
    if isinstance(sender, tuple) and len(sender) >= 2:
        return f" ({sender[0]}:{sender[1]})"
    return f" ({sender})" if sender is not None else ""
