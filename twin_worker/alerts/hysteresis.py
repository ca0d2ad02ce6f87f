"""Alarm hysteresis: raise an alert after a hazard stays probable, and clear it after it stays improbable."""

from dataclasses import dataclass, field
from math import isfinite
from typing import NamedTuple

from fleet.contract import Alert, AlertKey, AlertKind
from fleet.frames import Origin


class AlertRule(NamedTuple):
    """Thresholds and delays of one kind of alert; between the two probabilities the state does not change."""

    raise_at: float  # probability at and above which it is raised
    clear_below: float  # probability below which it is cleared
    raise_after_s: float  # uninterrupted time above `raise_at` before it is raised [s]
    clear_after_s: float  # uninterrupted time below `clear_below` before it is cleared [s]
    delay_per_s: float = 0.0  # additional delay for each second that it lies more than 30 s ahead [-]


_IMMINENT_S = 30.0  # hazards nearer than this have no additional delay [s]
RULES = {
    AlertKind.LINK_LOST: AlertRule(0.5, 0.5, 0.0, 0.0),
    AlertKind.SHORT_HORIZON: AlertRule(0.5, 0.25, 15.0, 5.0),
    AlertKind.CONFLICT: AlertRule(0.25, 0.05, 2.0, 5.0, 0.15),
    AlertKind.GROUND: AlertRule(0.5, 0.2, 2.0, 5.0, 0.15),
    AlertKind.GEOFENCE: AlertRule(0.5, 0.2, 2.0, 5.0, 0.15),
    AlertKind.NOT_ACHIEVABLE: AlertRule(0.9, 0.5, 5.0, 5.0),
    AlertKind.BATTERY: AlertRule(0.5, 0.2, 5.0, 10.0),
}


@dataclass(frozen=True)
class HazardEstimate:
    """Probability and description of one hazard.

    Attributes:
        kind: kind of alert
        probability: that the hazard occurs, 0..1
        message: text when the alert is raised, without the aircraft's name
        clear_message: text when the alert is cleared
        other: the other UAV of a conflict, -1 none
        predicted_t: predicted time [s since 1970]; None: now
        position: predicted position; None: unknown
    """

    kind: AlertKind
    probability: float
    message: str
    clear_message: str
    other: int = -1
    predicted_t: float | None = None
    position: Origin | None = None


@dataclass
class PendingAlert:
    """Hysteresis state of one hazard."""

    alert: Alert | None = None  # active alert
    contrary_since: float | None = None  # when the condition for the opposite state began to be met [s since 1970]


@dataclass
class AlertState:
    """Alerts of one UAV, active or pending."""

    _pending: dict[AlertKey, PendingAlert] = field(default_factory=dict)

    def update(self, uav: int, now: float, hazard: HazardEstimate) -> list[Alert]:
        """Update with a hazard at data time `now` [s since 1970]; return the alert it raises or clears, if any."""
        key = hazard.kind, hazard.other
        entry, rule = self._pending.setdefault(key, PendingAlert()), RULES[hazard.kind]
        probability = hazard.probability if isfinite(hazard.probability) else 0.0
        contrary = probability < rule.clear_below if entry.alert else probability >= rule.raise_at
        if not contrary:
            entry.contrary_since = None
            if entry.alert is None:
                del self._pending[key]
            return []
        if entry.contrary_since is None or now < entry.contrary_since:  # the clock may jump back
            entry.contrary_since = now
        if now - entry.contrary_since < (rule.clear_after_s if entry.alert else _raise_delay(rule, hazard, now)):
            return []
        if entry.alert:
            del self._pending[key]
            return [_alert(uav, now, hazard, active=False)]
        entry.alert, entry.contrary_since = _alert(uav, now, hazard, active=True), None
        return [entry.alert]

    def tracked_uavs(self, kind: AlertKind) -> list[int]:
        """Return the other UAVs of all alerts of one kind, active or pending."""
        return [other for key, other in self._pending if key is kind]

    @property
    def active(self) -> list[Alert]:
        """Return the active alerts, oldest first."""
        return [entry.alert for entry in tuple(self._pending.values()) if entry.alert is not None]


def _raise_delay(rule: AlertRule, hazard: HazardEstimate, now: float) -> float:
    """Return how long a hazard must be probable before it is raised [s]; longer for hazards far ahead."""
    ahead = hazard.predicted_t - now if hazard.predicted_t is not None else 0.0
    return rule.raise_after_s + rule.delay_per_s * max(ahead - _IMMINENT_S, 0.0)


def _alert(uav: int, now: float, hazard: HazardEstimate, *, active: bool) -> Alert:
    position = hazard.position if active and hazard.position is not None else (None, None, None)
    return Alert(
        uav=uav,
        t=now,
        kind=hazard.kind,
        active=active,
        sentence=f"uav-{uav}: {hazard.message if active else hazard.clear_message}",
        other=hazard.other,
        probability=round(hazard.probability, 3) if active and hazard.kind is not AlertKind.LINK_LOST else None,
        predicted_t=hazard.predicted_t if active else None,
        lat=position[0],
        lon=position[1],
        alt=position[2],
    )
