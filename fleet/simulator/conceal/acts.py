"""Strength of a hidden effect on its flight, relative to sensor noise.

Two comparisons. The first is decisive: within one flight, at 10 Hz, commands, readings, forces and moments of the same
state with and without the effect. The second compares two flights of the same seed, with and without the effect.
"""

import numpy as np

from fleet.simulator.conceal.plan import Planned
from fleet.simulator.conceal.record import Log, fly
from fleet.simulator.faults.carried import Carried
from fleet.simulator.faults.fault import Fault
from fleet.simulator.faults.oddities import ODD
from fleet.simulator.faults.physics import CHANGES, WINDS
from fleet.simulator.flight.uav import PretendUav
from fleet.simulator.vehicle.jsbsim import DT

_AT_ONCE: dict[str, float] = {  # noise per channel and sample, as in `sensors`
    **dict.fromkeys(("aileron", "elevator", "rudder", "throttle"), 0.01),  # fraction of full travel
    **dict.fromkeys(("p", "q", "r"), 0.003),  # [rad/s]
    **dict.fromkeys(("a_x", "a_y", "a_z"), 0.07),  # [m/s2]
    **dict.fromkeys(("phi", "theta", "psi"), 0.0044),  # [rad]
    **dict.fromkeys(("v_n", "v_e", "v_d"), 0.075),  # [m/s]
    "Va": 0.25,
    "baro": 0.4,  # [m/s], [m]
    **dict.fromkeys(("p_dot", "q_dot", "r_dot"), 0.006),  # derivative of the gyros up to 1.5 Hz [rad/s2]
    **dict.fromkeys(("f_x", "f_y", "f_z"), 0.07),  # [m/s2]
    **dict.fromkeys(("w_n", "w_e", "w_d"), 0.25),  # [m/s]
}
_FLOWN: dict[str, float] = {  # columns of `ExamFlightLog.channels`
    **{name: _AT_ONCE[name] for name in ("p", "q", "r", "a_x", "a_y", "a_z", "phi", "theta", "psi")},
    **{name: _AT_ONCE[name] for name in ("v_n", "v_e", "v_d")},
    **dict.fromkeys(("p_n", "p_e", "p_d"), 0.5),  # [m]
    "Va": 0.25,
    "baro": 0.4,
    "satellites": 1.5,  # [m/s], [m], [m]
    **{name: _AT_ONCE[name] for name in ("aileron", "elevator", "throttle", "rudder")},
}
_LATE = ("turbulence", "flap_deployed", "thrust_loss", "_surging_engine")  # not observable in a single sample
_SHAKEN = ("p", "q", "r", "a_y", "a_z", "Va")
LEAST = 2.0  # rms over the noise


def acts(planned: Planned, fault: Fault, log: Log) -> dict[str, object]:
    """Compute the strength of one hidden effect while it is active.

    Args:
        planned: the flight
        fault: one of its hidden faults
        log: the flight with all hidden faults
    Returns:
        name; over_noise, channel: largest rms over noise and its channel; flown_over_noise, flown_channel: the same for
        the difference of two flights
    """
    without, _ = fly(planned, tuple(x for x in planned.hidden if x is not fault))
    there = np.array([fault.share(t) > 0 for t in log.t])
    flown = _flown(log.seen[there], without.seen[there], shaken=fault.name == "turbulence")
    late = fault.name in _LATE and not (fault.name == "thrust_loss" and planned.job.airframe == "small")
    best = flown if late else _at_once(planned, fault, there)
    return {
        "name": fault.name,
        "over_noise": round(best[0], 1),
        "channel": best[1],
        "flown_over_noise": round(flown[0], 1),
        "flown_channel": flown[1],
    }


def _flown(with_it: np.ndarray, without: np.ndarray, shaken: bool) -> tuple[float, str]:
    """Compare two flights; turbulence by its variance. Horizontal position and velocity are no evidence."""
    names = list(_FLOWN)
    difference = with_it - without
    turns = [names.index(name) for name in ("phi", "psi")]
    difference[:, turns] = np.angle(np.exp(1j * difference[:, turns]))
    size = np.sqrt(np.mean(difference**2, axis=0))
    if shaken:
        size = np.sqrt(np.maximum(with_it.var(axis=0) - without.var(axis=0), 0.0))
    rms = dict(zip(names, size / np.array(list(_FLOWN.values())), strict=True))
    telling = _SHAKEN if shaken else [x for x in names if x not in ("p_n", "p_e", "v_n", "v_e", "satellites")]
    return _most(rms, telling)


def _most(rms: dict[str, float], telling: object) -> tuple[float, str]:
    best = max(telling, key=lambda name: rms[name])  # type: ignore[call-overload]
    return float(rms[best]), best


def _at_once(planned: Planned, fault: Fault, there: np.ndarray) -> tuple[float, str]:
    """Repeat the flight and compare with and without the fault at each sample."""
    rows: list[np.ndarray] = []
    fly(planned, planned.hidden, look=lambda uav: rows.append(_changed(uav, fault)))
    size = np.sqrt(np.mean(np.array(rows)[there] ** 2, axis=0)) / np.array(list(_AT_ONCE.values()))
    return _most(dict(zip(_AT_ONCE, size, strict=True)), list(_AT_ONCE))


def _changed(uav: PretendUav, fault: Fault) -> np.ndarray:
    """Return the changes by one fault at this instant, columns as in `_NOISE`."""
    t, carried = uav.tick * DT, uav.carried
    assert carried is not None
    felt, blown = np.zeros(6), np.zeros(3)
    if fault.name in CHANGES or fault.name in ODD:
        felt = _forces(uav, carried, fault, t)
    if fault.name in WINDS:
        blown = fault.share(t) * WINDS[fault.name](fault.values, -float(uav.now.p[2]))
    return np.concatenate([carried.moved[fault], carried.spoilt[fault], felt, blown])


def _forces(uav: PretendUav, carried: Carried, fault: Fault, t: float) -> np.ndarray:
    """Return the change of moments and forces by a fault; evaluate twice with it, since servos advance each time."""
    before = uav.aircraft.ponder()
    carried.press(t, without=fault)
    without = uav.aircraft.ponder()
    carried.press(t)
    return np.asarray((before + uav.aircraft.ponder()) / 2 - without)
