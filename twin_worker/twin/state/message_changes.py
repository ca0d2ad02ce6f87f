"""Events that messages tell: another mode, another mission, other parameters; in words."""

from collections.abc import Mapping
from math import isfinite

from fleet.autopilots import arduplane
from fleet.contract import Mission

_OF_LAWS = ("FW_", "MPC_", "NAV_", "NPFG_", "Q_WP_", "RTL_", "WPNAV_", "WP_")  # how names of other laws begin
_OF_ARDUPLANE = {name for row in arduplane.TABLE for name in (row.name, *(older for older, _ in row.older))}
_MOST = 3  # changed parameters named


def changed(before: Mapping[str, float], after: Mapping[str, float]) -> list[str]:
    """Name the parameters of a controller twin that changed, not those that just arrived."""
    ours = (name for name in after if name in _OF_ARDUPLANE or name.startswith(_OF_LAWS))
    return [name for name in ours if name in before and before[name] != after[name] and isfinite(after[name])]


def parameters_said(names: list[str], before: Mapping[str, float], after: Mapping[str, float]) -> str:
    """Say which parameters changed."""
    told = [f"{name[:20]} is {after[name]:g}, it was {before[name]:g}" for name in names[:_MOST]]
    return "; ".join(told + ([f"and {len(names) - _MOST} more"] if len(names) > _MOST else []))


def mission_said(before: Mission | None, after: Mission) -> str:
    """Say what is on board now."""
    have = f"{len(after.items)} items" if after.items else "none"
    if before is None:
        return have
    if len(before.items) != len(after.items):
        return f"{have}, before {len(before.items)}"
    others = sum(one != other for one, other in zip(before.items, after.items, strict=True))
    return f"{have}, {others} of them others"
