"""Flight mode of a simulated autopilot, which commands and failsafes change.

The failsafes are timers that run at every guidance step, as on board; they share nothing with the rules by which the
twin predicts them (`fleet.autopilots.failsafe`). A lost link is lost in both directions, with the remote control.

    ArduPlane   short action 0.2 s after RC_FS_TIMEOUT; long action FS_LONG_TIMEOUT after the short one, or after the
                last contact where there is none; the ground station's failsafe FS_LONG_TIMEOUT after its last heartbeat
    PX4         hold at COM_DL_LOSS_T (data link) or COM_RC_LOSS_T (remote control); its action COM_FAIL_ACT_T later

Source: ArduPlane failsafe documentation and the timing of its checks; PX4 user guide, safety configuration.
"""

from collections.abc import Mapping

MISSION_MODES = {"ardupilot": "AUTO", "px4": "MISSION"}
_RC_CHECKS_S = 0.2  # ten checks at 50 Hz until ArduPlane declares the remote control lost [s]
_KEEPS_BY_ITSELF = ("AUTO", "GUIDED", "LOITER")  # modes that the short action 0 does not change
_RETURNS = "RTL"
_PX4_ACTIONS = {1: "LOITER", 2: "RTL", 3: "LAND"}
_PX4_RC_BY_LINK = 1  # COM_RC_IN_MODE: remote control over the data link


class FlightMode:
    """Mode of one autopilot; `update` runs its failsafes."""

    def __init__(self, autopilot: str, params: Mapping[str, float]):
        """Start in the mission.

        Args:
            autopilot: ardupilot or px4
            params: parameters in the names and units of the autopilot
        """
        self.name = MISSION_MODES[autopilot]
        self.by_failsafe = False  # the present mode was selected by a failsafe
        self._is_px4, self._params = autopilot == "px4", params
        self._contact_t = 0.0  # last contact with the ground [s]
        self._short_t: float | None = None  # when the short failsafe began [s]
        self._long_done = False
        self._hold_t: float | None = None  # when the hold before a failsafe action of PX4 began [s]

    @property
    def follows_mission(self) -> bool:
        """Return whether the mode follows the mission."""
        return self.name in MISSION_MODES.values()

    def command(self, name: str) -> None:
        """Enter a mode by command of the ground."""
        self.name, self.by_failsafe = name, False

    def contact(self, t: float) -> None:
        """Record contact with the ground at `t` [s]: every failsafe ends, and the mode stays."""
        self._contact_t, self._short_t, self._hold_t, self._long_done = t, None, None, False

    def update(self, t: float) -> bool:
        """Run the failsafes at time `t` [s]; return whether one has changed the mode."""
        before = self.name
        if self._is_px4:
            self._run_px4(t)
        else:
            self._run_arduplane(t)
        self.by_failsafe = self.by_failsafe or self.name != before
        return self.name != before

    def _run_arduplane(self, t: float) -> None:
        get, silence = self._params.get, t - self._contact_t
        rc_lost = get("THR_FAILSAFE", 1.0) == 1 and silence > get("RC_FS_TIMEOUT", 1.0) + _RC_CHECKS_S
        action = int(get("FS_SHORT_ACTN", 0.0))
        if rc_lost and action != 3 and self._short_t is None and not self._long_done:
            self._short_t = t
            self.name = self._short_mode(action)
        since = self._contact_t if self._short_t is None else self._short_t
        timeout, heartbeat = get("FS_LONG_TIMEOUT", 5.0), get("FS_GCS_ENABL", 0.0)
        gcs_lost = silence > timeout and (heartbeat in (1, 2) or (heartbeat == 3 and self.name == "AUTO"))
        if not self._long_done and ((rc_lost and t - since > timeout) or gcs_lost):
            self._long_done = True
            self.name = self._long_mode(int(get("FS_LONG_ACTN", 0.0)))

    def _short_mode(self, action: int) -> str:
        if self.name in (_RETURNS, "CIRCLE", "TAKEOFF") or (action == 0 and self.name in _KEEPS_BY_ITSELF):
            return self.name
        return {2: "FBWA", 4: "FBWB"}.get(action, "CIRCLE")

    def _long_mode(self, action: int) -> str:
        if self.name == _RETURNS:
            return "AUTO" if action == 4 else self.name
        if self.name in ("AUTO", "GUIDED"):
            return {1: _RETURNS, 2: "FBWA", 4: "AUTO"}.get(action, self.name)
        return {2: "FBWA", 3: self.name, 4: "AUTO"}.get(action, _RETURNS)

    def _run_px4(self, t: float) -> None:
        get, silence = self._params.get, t - self._contact_t
        rules = [("NAV_DLL_ACT", get("COM_DL_LOSS_T", 10.0))]
        if get("COM_RC_IN_MODE") == _PX4_RC_BY_LINK and not int(get("COM_RCL_EXCEPT", 0.0)) & 1:
            rules.append(("NAV_RCL_ACT", get("COM_RC_LOSS_T", 0.5)))
        due = [
            int(get(name, 0.0)) for name, lost_s in rules if silence > lost_s and int(get(name, 0.0)) in _PX4_ACTIONS
        ]
        if not due or self._long_done:
            return
        self._hold_t = t if self._hold_t is None else self._hold_t
        if t - self._hold_t >= get("COM_FAIL_ACT_T", 0.0):
            self.name, self._long_done = _PX4_ACTIONS[max(due)], True
        elif self.name != "LOITER":
            self.name = "LOITER"
