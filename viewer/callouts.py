"""Three labels in 3-D for those who need an eye: supervision is by exception."""

from typing import Any

import numpy as np

from fleet.contract import State
from viewer.mismatch import in_force, short
from viewer.palette import GLYPH
from viewer.vehicle import Vehicle
from viewer.words import ago, severity

LABELS = 3  # labels do not make room for each other: few are readable


class Callouts:
    """The worst few of the fleet, named where they fly."""

    def __init__(self, server: Any) -> None:
        self._labels = [
            server.scene.add_label(
                f"/fleet/callout{k}", "", font_screen_scale=0.8, anchor="bottom-center", depth_test=False, visible=False
            )
            for k in range(LABELS)
        ]

    def draw(self, fleet: list[Vehicle], now: float, *, selected: int | None, size: float) -> None:
        """Name alerts and lost links; `now` is monotonic [s], `size` is the drawn span of an aircraft [10 m]."""
        flying = [v for v in fleet if v.uav != selected and not v.ended]
        worst = [v for v in flying if v.alerts or in_force(v.mismatch) or v.state(now) is State.LINK_LOST]
        worst = [v for v in sorted(worst, key=lambda v: severity(v, now)) if v.where(now) is not None][:LABELS]
        for label, vehicle in zip(self._labels, worst, strict=False):
            at = vehicle.where(now)
            label.text, label.visible = caption(vehicle, now), True
            if at is not None:
                label.position = tuple(float(x) for x in at + np.array([0.0, 0.0, 0.7 * size]))
        for label in self._labels[len(worst) :]:
            label.visible = False


def caption(vehicle: Vehicle, now: float) -> str:
    """Say in few words what is wrong with a UAV."""
    if vehicle.state(now) is State.LINK_LOST:
        return f"{GLYPH[State.LINK_LOST]} {vehicle.name} link lost {ago(vehicle.age(now))}"
    kinds = ", ".join(dict.fromkeys(alert.kind.value.replace("_", " ") for alert in vehicle.alerts.values()))
    if vehicle.mismatch is not None and in_force(vehicle.mismatch):
        kinds = ", ".join(filter(None, (short(vehicle.mismatch), kinds)))
    return f"▲ {vehicle.name} {kinds}"
