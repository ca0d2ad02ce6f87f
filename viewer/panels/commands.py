"""Command palette (Ctrl+K) of one page: actions and UAVs to select."""

from collections.abc import Callable
from functools import partial
from typing import Any

import viser

from viewer.store.vehicle import Vehicle

MAX_OFFERED = 200  # UAVs in the palette; the search field finds the others


class Commands:
    """Commands of the palette."""

    def __init__(self, gui: Any, choose: Callable[[int], None], actions: dict[str, Callable[[], None]]) -> None:
        self._gui, self._choose = gui, choose
        self._offered: set[int] = set()
        for label, act in actions.items():
            gui.add_command(label).on_trigger(partial(self._act, act))

    def offer(self, fleet: list[Vehicle]) -> None:
        """Add selection commands for the first `MAX_OFFERED` UAVs."""
        for vehicle in fleet[:MAX_OFFERED]:
            if vehicle.uav not in self._offered and len(self._offered) < MAX_OFFERED:
                command = self._gui.add_command(f"Select {vehicle.name}", icon=viser.Icon.DRONE)
                command.on_trigger(partial(self._pick, vehicle.uav))
                self._offered.add(vehicle.uav)

    def _pick(self, uav: int, _: Any) -> None:
        self._choose(uav)

    @staticmethod
    def _act(act: Callable[[], None], _: Any) -> None:
        act()
