"""Labels in 3-D for UAVs with an alert, a mismatch or a lost link."""

import numpy as np

from fleet.contract import State
from viewer.scene.fleet_arrays import Flock
from viewer.scene.labels import Tag
from viewer.store.vehicle import Vehicle
from viewer.text.mismatch_text import in_force, short
from viewer.text.words import ago, severity
from viewer.theme.palette import GLYPH

MOST = 6  # most labels at once; overlapping ones are omitted


def callouts(flock: Flock, selected: int | None, unit: float) -> list[Tag]:
    """Return labels at the most severe UAVs; `unit` is the drawn span of an aircraft [10 m]."""
    needy = [(v, i) for v, i in flock.needy if v.uav != selected and not v.ended]
    rows = sorted(needy, key=lambda one: severity(one[0], flock.now))[:MOST]
    above = np.array([0.0, 0.0, 0.9 * unit])
    return [
        Tag(
            f"uav{v.uav}",
            f"▲ {v.name}" if flock.crowd else caption(v, flock.now),
            flock.at[i] + above,
            "bottom-center",
        )
        for v, i in rows
    ]


def caption(vehicle: Vehicle, now: float) -> str:
    """Describe the problems of a UAV in a short label."""
    if vehicle.state(now) is State.LINK_LOST:
        return f"{GLYPH[State.LINK_LOST]} {vehicle.name} link lost {ago(vehicle.age(now))}"
    kinds = ", ".join(dict.fromkeys(alert.kind.value.replace("_", " ") for alert in vehicle.alerts.values()))
    if vehicle.mismatch is not None and in_force(vehicle.mismatch):
        kinds = ", ".join(filter(None, (short(vehicle.mismatch), kinds)))
    return f"▲ {vehicle.name} {kinds}"
