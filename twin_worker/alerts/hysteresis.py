"""Raise an alert once and withdraw it once: what is found is probable for a while, then improbable for a while."""

from dataclasses import dataclass, field
from math import isfinite
from typing import NamedTuple

from fleet.contract import About, Alert, AlertKind
from fleet.frames import Origin


class Rule(NamedTuple):
    """When an alert of one kind begins and ends; between the two probabilities nothing changes."""

    raise_at: float  # probability from which it is raised
    clear_below: float  # probability below which it is withdrawn
    after_s: float  # how long it must be probable without a break [s]
    ease_s: float  # how long it must be improbable without a break [s]
    per_s: float = 0.0  # how much longer it must be probable for each second that it lies more than 30 s ahead [-]


_NEAR_S = 30.0  # dangers nearer than this are told at once [s]
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
    """What one judgement found of one danger.

    Attributes:
        kind: what is in danger
        probability: that it comes to pass, 0..1
        danger: what to say when it is raised, without the aircraft's name
        over: what to say when it is withdrawn
        other: the other UAV of a conflict, -1 none
        at: when it is predicted for [s since 1970]; None now
        place: where it is predicted for; None at no one place
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
    """One danger under watch."""

    alert: Alert | None = None  # in force
    since: float | None = None  # since when the contrary of what is in force was found [s since 1970]


@dataclass
class Ledger:
    """The alerts of one UAV: in force, or about to be."""

    _open: dict[About, Open] = field(default_factory=dict)

    def judge(self, uav: int, now: float, finding: Finding) -> list[Alert]:
        """Take a finding at data time `now` [s since 1970]; return the alert it raises or withdraws, if any."""
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
        """Return the other UAVs of all dangers of one kind that are in force or about to be."""
        return [other for one, other in self._open if one is kind]

    @property
    def active(self) -> list[Alert]:
        """Return the alerts in force, oldest first."""
        return [entry.alert for entry in tuple(self._open.values()) if entry.alert is not None]


def _patience(rule: Rule, found: Finding, now: float) -> float:
    """Return how long a danger must be probable before it is told [s]: what lies far ahead has time to be borne out."""
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
