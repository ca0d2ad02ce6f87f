"""Identification of the control law and of missing autopilot parameters by replay of the flight.

A known autopilot has a known law. For any other autopilot the law with the smallest error to the commanded banks is
selected. Turn parameters are estimated by a search over several values, scored over all replays. Bank limit, airspeed
and waypoint radius are read from the flight. Parameters that cannot be identified keep their default and are reported
as defaults.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import atan2, degrees, isfinite, pi, radians

import numpy as np

from fleet.autopilots import laws
from fleet.autopilots.shadow import shadow
from fleet.frames import wrap
from fleet.mission import P_D, P_N, SEQ, VA_C, WAYPOINT
from twin_worker.estimation.airspeed_setpoint import aimed_at
from twin_worker.prediction.autopilot_parameters import CRUISE_OF, on_wings
from twin_worker.prediction.closed_loop import Heard, Situation, heard, known_wind

OWN = {"ardupilot": "arduplane", "px4": "px4"}
EVERY_S = 10.0  # interval of replays [s]
_BELIEVED = radians(6.0)  # largest error to the commanded banks of an accepted law [rad]
_TURN = radians(12.0)  # smaller banks do not distinguish laws [rad]
_NEWS = 0.15  # smoothing weight of the newest replay
_FLAT = radians(0.3), 8  # band below the steepest bank, and minimum reports in it, that indicate a limit [rad]
_NEAR = (0.7, 1.4)  # default minimum and maximum airspeed over cruise [-]
_SHARPEST = radians(35.0)  # minimum turn that determines the switch distance [rad]
_SHAPES: dict[str, dict[str, tuple[float, ...]]] = {  # turn parameters, tried if not received
    "arduplane": {
        "NAVL1_PERIOD": (8.0, 10.0, 12.0, 13.0, 14.0, 15.0, 16.0, 17.0, 18.0, 20.0, 22.0, 25.0, 30.0),
        "NAVL1_DAMPING": (0.65, 0.7, 0.75, 0.8, 0.85, 0.95),
    },
    "px4": {"NPFG_PERIOD": (6.0, 8.0, 10.0, 12.0, 14.0, 17.0, 20.0, 25.0)},
    "textbook": {"k_path": (0.01, 0.015, 0.02, 0.03, 0.04, 0.06, 0.08)},
}
_LIMIT = {"arduplane": ("ROLL_LIMIT_DEG", 1.0), "px4": ("FW_R_LIM", 1.0), "textbook": ("phi_max", radians(1.0))}
_RANGE: dict[str, tuple[str, ...]] = {
    "arduplane": ("AIRSPEED_MIN", "AIRSPEED_MAX"),
    "px4": ("FW_AIRSPD_MIN", "FW_AIRSPD_MAX"),
    "textbook": (),
}


@dataclass
class Learnt:
    """Identified law and parameters of one autopilot.

    Attributes:
        law: name in `laws.LAWS`; empty while unknown
        values: identified parameters of that law, in autopilot units
        reason: how the law was selected, or why none is; empty for a known autopilot
        steepest_banks: steepest commanded banks so far [rad]
        switch_radii: waypoint radii from switches so far [m]
        cost: smoothed bank error of each tried value [rad], by law, parameter and value
        bank_error: smoothed bank error of each law [rad]
        replay_t: last replay [s since 1970]
    """

    law: str = ""
    values: dict[str, float] = field(default_factory=dict)
    said: str = ""
    steepest: np.ndarray = field(default_factory=lambda: np.empty(0))
    switched: dict[int, float] = field(default_factory=dict)
    cost: dict[tuple[str, str, float], float] = field(default_factory=dict)
    miss: dict[str, float] = field(default_factory=dict)
    t: float = -np.inf


def learn_law(learnt: Learnt, autopilot: str, now: Situation) -> None:
    """Replay the flight to identify unknown law and parameters; update `estimate` in place.

    Args:
        estimate: earlier estimate
        autopilot: reported autopilot type
        context: newest telemetry; its law and values are ignored
    """
    own = OWN.get(autopilot)
    lacking = {law: laws.parameters(law, now.onboard.params)[1] for law in ((own,) if own else _SHAPES)}
    if own:
        learnt.law, learnt.said = own, ""
    if own and not any(lacking.values()):
        learnt.values = {}
        return
    seen = heard(now)
    if not isinstance(seen, Heard):
        return
    learnt.t = float(seen.good.t[-1])
    _watch_banks(learnt, seen.phi_c)
    turned = bool((np.abs(seen.phi_c) > _TURN).any())
    found = {law: _values(learnt, law, absent, now, seen) for law, absent in lacking.items()}
    if turned:
        for law, absent in lacking.items():
            _replay(learnt, law, absent, (now, seen), found[law])
    if own is None:
        _choose(learnt, autopilot)
    if learnt.law:
        learnt.values = found[learnt.law]


def _watch_banks(learnt: Learnt, phi_c: np.ndarray) -> None:
    """Store the steepest commanded banks."""
    banks = np.concatenate([learnt.steepest, np.abs(phi_c[np.isfinite(phi_c)])])
    learnt.steepest = np.sort(banks)[-200:]


def _values(learnt: Learnt, law: str, absent: tuple[str, ...], now: Situation, seen: Heard) -> dict[str, float]:
    """Read the parameters that need no replay from the flight."""
    values: dict[str, float] = {}
    name, unit = _LIMIT[law]
    if name in absent and len(learnt.steepest):
        top = float(learnt.steepest[-1])
        if (learnt.steepest > top - _FLAT[0]).sum() >= _FLAT[1] and top > _TURN:
            values[name] = degrees(top) * unit
    cruise = CRUISE_OF[law]
    if cruise in absent:
        values[cruise] = _cruise(learnt, now, seen, cruise)
        values |= dict(zip(_RANGE[law], (share * values[cruise] for share in _NEAR), strict=False))
    if law == "arduplane" and "WP_RADIUS" in absent:
        learnt.switched.update(_switches(seen))
        if learnt.switched:
            values["WP_RADIUS"] = float(np.median(list(learnt.switched.values())))
    return {name: value for name, value in values.items() if name in absent}


def _cruise(learnt: Learnt, now: Situation, seen: Heard, name: str) -> float:
    """Return the set-point on a leg without commanded speed, else the identified or the flown airspeed [m/s]."""
    at = np.flatnonzero(seen.legs[:, SEQ] == seen.seq[-1])
    told = aimed_at(now.history, learnt.t)
    if len(at) and seen.legs[at[0], VA_C] <= 0 and isfinite(told):
        return told
    flown = seen.Va[np.isfinite(seen.Va) & (seen.Va > 3.0)]
    return learnt.values.get(name, float(np.median(flown)) if len(flown) else 15.0)


def _switches(seen: Heard) -> dict[int, float]:
    """Return the waypoint radius of each switch between two lines [m], by time: distance over turn fraction."""
    found: dict[int, float] = {}
    dt = float(seen.t[1] - seen.t[0])
    for k in np.flatnonzero(np.diff(seen.seq)).tolist():
        i = np.flatnonzero(seen.legs[:, SEQ] == seen.seq[k])
        if not len(i) or not 0 < i[0] < len(seen.legs) - 1 or (seen.legs[i[0] - 1 : i[0] + 2, 0] != WAYPOINT).any():
            continue
        a, b, c = seen.legs[i[0] - 1 : i[0] + 2, P_N:P_D]
        turn = abs(wrap(atan2(c[1] - b[1], c[0] - b[0]) - atan2(b[1] - a[1], b[0] - a[0])))
        late = min(int(0.5 / dt), k)  # mean delay of a report once a second
        if turn > _SHARPEST:
            away = float(np.hypot(*(seen.p[k - late, :2] - b)))
            found[round(float(seen.good.t[0] + seen.t[k]))] = away / (min(turn, pi / 2) / (pi / 2))
    return found


def _replay(
    learnt: Learnt, law: str, absent: tuple[str, ...], flown: tuple[Situation, Heard], values: dict[str, float]
) -> None:
    """Try the values of the turn parameters one after the other; set the best in `values`."""
    for name, tried in _SHAPES[law].items():
        if name not in absent:
            continue
        for value in tried:
            rms = _rms(law, flown, {**values, name: value})
            key = law, name, value
            before = learnt.cost.get(key, rms)
            learnt.cost[key] = before + _NEWS * (rms - before)
        values[name] = _least([(value, learnt.cost[law, name, value]) for value in tried])
    rms = _rms(law, flown, values)
    before = learnt.miss.get(law, rms)
    learnt.miss[law] = before + _NEWS * (rms - before)


def _least(tried: list[tuple[float, float]]) -> float:
    """Return the minimum of the parabola through the value of least cost and its neighbours."""
    x, y = (np.array(column) for column in zip(*tried, strict=True))
    k = int(np.argmin(y))
    if not 0 < k < len(x) - 1:
        return float(x[k])
    a, b, _ = np.polyfit(x[k - 1 : k + 2] - x[k], y[k - 1 : k + 2], 2)
    return float(x[k] + np.clip(-b / (2 * a), x[k - 1] - x[k], x[k + 1] - x[k])) if a > 0 else float(x[k])


def _rms(law: str, flown: tuple[Situation, Heard], values: Mapping[str, float]) -> float:
    """Replay the flight; return the RMS error of the law to the commanded banks [rad]."""
    now, seen = flown
    control = on_wings(now.onboard.params, values, law=law)
    par = laws.blown(control.par(seen.altitude_m), *known_wind(now, seen.good))
    _, rms = shadow(par, seen.legs, seen.start, *seen.rows, seen.seq)  # type: ignore[call-arg]
    return float(rms) if isfinite(rms) else np.inf


def _choose(learnt: Learnt, autopilot: str) -> None:
    """Select the law with the smallest bank error if it is below the limit."""
    if not learnt.miss:
        learnt.said = f"autopilot {autopilot}: no commanded bank received in a turn yet, control law unknown"
        return
    law, miss = min(learnt.miss.items(), key=lambda one: one[1])
    within = f"the commanded banks within {degrees(miss):.1f} deg"
    if miss < _BELIEVED:
        learnt.law = law
        learnt.said = f"autopilot {autopilot}: control law {laws.LAWS[law].sentence} matches {within}"
    else:
        learnt.law = ""
        learnt.said = f"autopilot {autopilot}: no known control law matches {within}"
