"""Labels in 3-D for UAVs with an alert, a mismatch or a lost link."""

import numpy as np

from fleet.contract import TwinState
from viewer.scene.fleet_arrays import FleetArrays
from viewer.scene.labels import Tag
from viewer.store.vehicle import Vehicle
from viewer.text.words import age_text, in_force, severity, short_text
from viewer.theme.palette import GLYPH

MAX_ALERT_LABELS = 6  # most labels at once; overlapping ones are omitted


def alert_labels(fleet_arrays: FleetArrays, selected: int | None, unit: float) -> list[Tag]:
    """Return labels at the most severe UAVs; `unit` is the drawn span of an aircraft [10 m]."""
    exceptional = [(v, i) for v, i in fleet_arrays.exceptional if v.uav != selected and not v.ended]
    rows = sorted(exceptional, key=lambda entry: severity(entry[0], fleet_arrays.now))[:MAX_ALERT_LABELS]
    above = np.array([0.0, 0.0, 0.9 * unit])
    return [
        Tag(
            f"uav{v.uav}",
            f"▲ {v.name}" if fleet_arrays.large_fleet else alert_text(v, fleet_arrays.now),
            fleet_arrays.at[i] + above,
            "bottom-center",
        )
        for v, i in rows
    ]


def alert_text(vehicle: Vehicle, now: float) -> str:
    """Describe the problems of a UAV in a short label."""
    if vehicle.state(now) is TwinState.LINK_LOST:
        return f"{GLYPH[TwinState.LINK_LOST]} {vehicle.name} link lost {age_text(vehicle.sample_age_s(now))}"
    kinds = ", ".join(dict.fromkeys(alert.kind.value.replace("_", " ") for alert in vehicle.alerts.values()))
    if vehicle.mismatch is not None and in_force(vehicle.mismatch):
        kinds = ", ".join(filter(None, (short_text(vehicle.mismatch), kinds)))
    return f"▲ {vehicle.name} {kinds}"
