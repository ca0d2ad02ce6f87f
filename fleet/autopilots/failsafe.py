"""What an autopilot does after the radio link is lost: the mode changes that its parameters describe, one rule per law.

    link_loss_steps("arduplane", "AUTO", params)  ->  (FailsafeStep(6.2, "RTL", "FS_LONG_ACTN 1"),)

A lost link is assumed to be lost in both directions, together with the remote control. Then ArduPlane begins the short
failsafe 0.2 s after RC_FS_TIMEOUT, but not before FS_SHORT_TIMEOUT, if THR_FAILSAFE is 1. The long action follows
FS_LONG_TIMEOUT after that, also where the short one does not change the mode; after the last contact where
FS_SHORT_ACTN disables it, and by FS_GCS_ENABL. PX4 takes NAV_DLL_ACT at COM_DL_LOSS_T, and holds for COM_FAIL_ACT_T
before it. NAV_RCL_ACT is followed only where the remote control arrives by the same link (COM_RC_IN_MODE 1). A
parameter that is not received causes no action.
Source: ArduPlane failsafe documentation, parameter reference and the timing of its checks; PX4 user guide, "Safety
configuration (failsafes)".
"""

from collections.abc import Mapping
from math import inf, isfinite
from typing import NamedTuple

GLIDE, LEVEL, LAND_SEQUENCE = "FBWA", "FBWB", "AUTO"
_MANUAL = ("MANUAL", "STABILIZE", "ACRO", "FBWA", "AUTOTUNE", "FBWB", "CRUISE", "TRAINING")
_NAVIGATES = ("AUTO", "AVOID_ADSB", "GUIDED", "LOITER", "THERMAL")
_DETECTION_S = 0.2  # time in which ArduPlane detects that the remote control is lost [s]
_SHORT_MODES = {0: "CIRCLE", 1: "CIRCLE", 2: GLIDE, 4: LEVEL}
_SHORT_DISABLED = _PARACHUTE = 3
_LONG_MODES = {1: "RTL", 2: GLIDE, 4: "AUTO", 5: "AUTOLAND"}
_GCS_HEARTBEAT, _GCS_AUTO_ONLY = (1, 2), 3  # FS_GCS_ENABL
_PX4_MODES = {1: "LOITER", 2: "RTL", 3: "LAND"}
_RC_BY_LINK = 1  # COM_RC_IN_MODE
_RC_EXCEPT = {"MISSION": 1, "LOITER": 2, "OFFBOARD": 4}  # bits of COM_RCL_EXCEPT


class FailsafeStep(NamedTuple):
    """One mode change after a link loss.

    Attributes:
        after_s: time since the link was lost [s]
        mode: as in `Status.mode`
        cause: parameter and value that describe it
    """

    after_s: float
    mode: str
    cause: str


def _arduplane_short(mode: str, action: int) -> str:
    """Return the mode of ArduPlane's short action; empty: no change."""
    if action == _SHORT_DISABLED or (mode in _NAVIGATES and action == 0):
        return ""
    return _SHORT_MODES.get(action, "CIRCLE") if mode in _NAVIGATES + _MANUAL else ""


def _arduplane_long(mode: str, action: int) -> str:
    """Return the mode of ArduPlane's long action; empty: no change."""
    if mode in ("AUTO", "AVOID_ADSB", "GUIDED"):
        return _LONG_MODES.get(action, "")
    if mode == "RTL":
        return _LONG_MODES[action] if action in (4, 5) else ""
    continues = mode in (*_MANUAL, "CIRCLE", "LOITER", "THERMAL", "TAKEOFF")
    return _LONG_MODES.get(action, "RTL") if continues and action != _PARACHUTE else ""


def _arduplane_steps(mode: str, params: Mapping[str, float]) -> tuple[FailsafeStep, ...]:
    steps: list[FailsafeStep] = []
    gcs, timeout_s = params.get("FS_GCS_ENABL", 0), params.get("FS_LONG_TIMEOUT", 5.0)
    rc_lost_s = params.get("RC_FS_TIMEOUT", 1.0) + _DETECTION_S
    long_s = inf
    if params.get("THR_FAILSAFE") == 1:
        action = int(params.get("FS_SHORT_ACTN", _SHORT_DISABLED))
        if action == _SHORT_DISABLED:
            long_s = max(timeout_s, rc_lost_s)
        else:
            short_s = max(rc_lost_s, params.get("FS_SHORT_TIMEOUT", 0.0))
            long_s = short_s + timeout_s
            short_mode = _arduplane_short(mode, action)
            if short_mode and short_mode != mode:
                steps.append(FailsafeStep(short_s, short_mode, f"FS_SHORT_ACTN {action}"))
    before = steps[-1].mode if steps else mode
    by_gcs = gcs in _GCS_HEARTBEAT or (gcs == _GCS_AUTO_ONLY and before == "AUTO")
    if by_gcs:
        long_s = min(long_s, timeout_s)
    if isfinite(long_s) and "FS_LONG_ACTN" in params:
        action = int(params["FS_LONG_ACTN"])
        steps = [step for step in steps if step.after_s < long_s]
        before = steps[-1].mode if steps else mode
        long_mode = _arduplane_long(before, action)
        if long_mode and long_mode != before:
            cause = f"FS_LONG_ACTN {action}" + (f", FS_GCS_ENABL {gcs:.0f}" if by_gcs else "")
            steps.append(FailsafeStep(long_s, long_mode, cause))
    return tuple(steps)


def _px4_steps(mode: str, params: Mapping[str, float]) -> tuple[FailsafeStep, ...]:
    steps: list[FailsafeStep] = []
    hold_s = params.get("COM_FAIL_ACT_T", 0.0)
    rc_excepted = int(params.get("COM_RCL_EXCEPT", 0)) & _RC_EXCEPT.get(mode, 0)
    rules = [("NAV_DLL_ACT", "COM_DL_LOSS_T", 10.0)]
    if params.get("COM_RC_IN_MODE") == _RC_BY_LINK and not rc_excepted:
        rules.append(("NAV_RCL_ACT", "COM_RC_LOSS_T", 0.5))
    for action_name, timeout_name, default_s in rules:
        new_mode = _PX4_MODES.get(int(params.get(action_name, 0)), "")
        if not new_mode or new_mode == mode:
            continue
        lost_s, cause = params.get(timeout_name, default_s), f"{action_name} {params[action_name]:.0f}"
        if hold_s > 0 and new_mode != "LOITER" and mode != "LOITER":
            steps.append(FailsafeStep(lost_s, "LOITER", f"COM_FAIL_ACT_T {hold_s:g}"))
        steps.append(FailsafeStep(lost_s + (hold_s if new_mode != "LOITER" else 0.0), new_mode, cause))
    return tuple(sorted(steps)[:2])


def link_loss_steps(law: str, mode: str, params: Mapping[str, float]) -> tuple[FailsafeStep, ...]:
    """Return the mode changes after a link loss in time order, at most two; empty: the mode continues.

    Args:
        law: name in `fleet.autopilots.laws.LAWS`
        mode: at the loss, as in `Status.mode`
        params: received parameters in the autopilot's names and units
    """
    rules = {"arduplane": _arduplane_steps, "px4": _px4_steps}
    return rules[law](mode, params) if law in rules else ()


def describe_steps(steps: tuple[FailsafeStep, ...]) -> str:
    """Describe the failsafe that a prediction follows; empty without steps."""
    return "; ".join(f"failsafe: {step.mode} {step.after_s:.1f} s after the loss ({step.cause})" for step in steps)
