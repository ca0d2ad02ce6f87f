"""Describe changes of mission and autopilot parameters between two messages."""

from collections.abc import Mapping
from math import isfinite

from fleet.autopilots import arduplane
from fleet.contract import Mission

_OF_LAWS = ("FW_", "MPC_", "NAV_", "NPFG_", "Q_WP_", "RTL_", "WPNAV_", "WP_")  # not ArduPlane
_OF_ARDUPLANE = {name for row in arduplane.TABLE for name in (row.name, *(older for older, _ in row.older))}
_MOST = 3  # maximum number of changed parameters in the text


def changed(before: Mapping[str, float], after: Mapping[str, float]) -> list[str]:
    """Return the names of changed controller parameters; parameters received for the first time do not count."""
    ours = (name for name in after if name in _OF_ARDUPLANE or name.startswith(_OF_LAWS))
    return [name for name in ours if name in before and before[name] != after[name] and isfinite(after[name])]


def parameters_said(names: list[str], before: Mapping[str, float], after: Mapping[str, float]) -> str:
    """Describe the changed parameters with new and old values."""
    told = [f"{name[:20]} is {after[name]:g}, it was {before[name]:g}" for name in names[:_MOST]]
    return "; ".join(told + ([f"and {len(names) - _MOST} more"] if len(names) > _MOST else []))


def mission_said(before: Mission | None, after: Mission) -> str:
    """Describe the number of mission items and of changed items."""
    have = f"{len(after.items)} items" if after.items else "none"
    if before is None:
        return have
    if len(before.items) != len(after.items):
        return f"{have}, previously {len(before.items)}"
    others = sum(one != other for one, other in zip(before.items, after.items, strict=True))
    return f"{have}, {others} changed"
