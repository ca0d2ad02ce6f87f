"""Alarm hysteresis: raise an alert after a hazard stays probable, and clear it after it stays improbable."""

from dataclasses import dataclass, field
from math import isfinite
from typing import NamedTuple

from fleet.contract import About, Alert, AlertKind
from fleet.frames import Origin


class Rule(NamedTuple):
    """Thresholds and delays of one kind of alert; between the two probabilities the state does not change."""

    raise_at: float  # probability at and above which it is raised
    clear_below: float  # probability below which it is cleared
    after_s: float  # uninterrupted time above `raise_at` before it is raised [s]
    ease_s: float  # uninterrupted time below `clear_below` before it is cleared [s]
    per_s: float = 0.0  # additional delay for each second that it lies more than 30 s ahead [-]


_NEAR_S = 30.0  # hazards nearer than this have no additional delay [s]
RULES = {
    AlertKind.LINK_LOST: Rule(0.5, 0.5, 0.0, 0.0),
    AlertKind.SHORT_HORIZON: Rule(0.9, 0.1, 15.0, 5.0),
    AlertKind.CONFLICT: Rule(0.25, 0.05, 2.0, 5.0, 0.15),
    AlertKind.GROUND: Rule(0.5, 0.2, 2.0, 5.0, 0.15),
    AlertKind.GEOFENCE: Rule(0.5, 0.2, 2.0, 5.0, 0.15),
    AlertKind.NOT_ACHIEVABLE: Rule(0.9, 0.5, 5.0, 5.0),
}


@dataclass(frozen=True)
class Finding:
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
    danger: str
    over: str
    other: int = -1
    at: float | None = None
    place: Origin | None = None


@dataclass
class Open:
    """Hysteresis state of one hazard."""

    alert: Alert | None = None  # active alert
    since: float | None = None  # when the condition for the opposite state began to be met [s since 1970]


@dataclass
class Ledger:
    """Alerts of one UAV, active or pending."""

    _open: dict[About, Open] = field(default_factory=dict)

    def judge(self, uav: int, now: float, finding: Finding) -> list[Alert]:
        """Update with a hazard at data time `now` [s since 1970]; return the alert it raises or clears, if any."""
        about = finding.kind, finding.other
        entry, rule = self._open.setdefault(about, Open()), RULES[finding.kind]
        p = finding.probability if isfinite(finding.probability) else 0.0
        contrary = p < rule.clear_below if entry.alert else p >= rule.raise_at
        if not contrary:
            entry.since = None
            if entry.alert is None:
                del self._open[about]
            return []
        if entry.since is None or now < entry.since:  # the clock may jump back
            entry.since = now
        if now - entry.since < (rule.ease_s if entry.alert else _patience(rule, finding, now)):
            return []
        if entry.alert:
            del self._open[about]
            return [_alert(uav, now, finding, active=False)]
        entry.alert, entry.since = _alert(uav, now, finding, active=True), None
        return [entry.alert]

    def watched(self, kind: AlertKind) -> list[int]:
        """Return the other UAVs of all alerts of one kind, active or pending."""
        return [other for one, other in self._open if one is kind]

    @property
    def active(self) -> list[Alert]:
        """Return the active alerts, oldest first."""
        return [entry.alert for entry in tuple(self._open.values()) if entry.alert is not None]


def _patience(rule: Rule, found: Finding, now: float) -> float:
    """Return how long a hazard must be probable before it is raised [s]; longer for hazards far ahead."""
    ahead = found.at - now if found.at is not None else 0.0
    return rule.after_s + rule.per_s * max(ahead - _NEAR_S, 0.0)


def _alert(uav: int, now: float, found: Finding, *, active: bool) -> Alert:
    place = found.place if active and found.place is not None else (None, None, None)
    return Alert(
        uav=uav,
        t=now,
        kind=found.kind,
        active=active,
        sentence=f"uav-{uav}: {found.danger if active else found.over}",
        other=found.other,
        probability=round(found.probability, 3) if active and found.kind is not AlertKind.LINK_LOST else None,
        at=found.at if active else None,
        lat=place[0],
        lon=place[1],
        alt=place[2],
    )
