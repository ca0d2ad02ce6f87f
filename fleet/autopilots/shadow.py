"""Replay of the controller on telemetry, to synchronise its state with the controller on board.

The replay reconstructs states that telemetry does not contain: filters, integrators, angle flown on a circle. Initial
integrator values are unknown; a shift at the end aligns the outputs with the reported ones. Where the route changed at
the start, its controllers continue from the state before: then the outputs just after the change, whose time is known
to a fraction of a second, do not shift them.

The current mission item is reported once a second. The replay switches legs when its law does, and waits for the
report; without a report in time it returns to the reported leg and replays the rows since then.
"""

from math import isfinite, nan, sqrt

import numpy as np

from fleet.autopilots import control_law as S
from fleet.autopilots.arduplane import legs as leg_rules
from fleet.autopilots.control_law import array_kernel, kernel
from fleet.autopilots.laws import align_integrators, begin, engage, fly, restore, stabilise
from fleet.frames import wrap
from fleet.mission import SEQ

_MATCH_WINDOW = 5.0  # window at the end for matching the outputs [s]
NO_MEMORY = np.empty(0)  # the state before the first row is unknown
_REPORT_DELAY = 2.0  # maximum delay of a reported item behind the switch to it [s]
_MAX_STEP = 0.2  # step length for longer gaps in telemetry [s]


@kernel
def _leg_of_item(ctl: np.ndarray, legs: np.ndarray, seq: float) -> int:
    """Return the current or next leg with a reported item number; -1 if the route has none."""
    i_current, n = leg_rules.current_leg(ctl, legs), legs.shape[0]
    for j in range(n):
        i = (max(i_current, 0) + j) % n
        if legs[i, SEQ] == seq:
            return i
    return -1


@kernel
def _is_finite(x: np.ndarray) -> bool:
    """Return whether all three elements are finite; unlike `numpy.all` without allocating an array."""
    return isfinite(x[0]) and isfinite(x[1]) and isfinite(x[2])


@array_kernel
def replay_controller(
    par: np.ndarray,
    legs: np.ndarray,
    start: np.ndarray,
    t: np.ndarray,
    p: np.ndarray,
    v: np.ndarray,
    euler: np.ndarray,
    rates: np.ndarray,
    Va: np.ndarray,
    phi_c: np.ndarray,
    theta_c: np.ndarray,
    delta: np.ndarray,
    seq: np.ndarray,
    memory: np.ndarray,
) -> tuple[np.ndarray, float]:
    """Synchronise the controller with telemetry at about 10 Hz; rows with nan are skipped.

    Args:
        par: parameters of any law, see `laws`
        legs: route from the current item at t[0], (m, 9)
        start: point before the first leg, NED, (3,) [m]; nan: aircraft position
        t: time (n,) [s]
        p, v: position and ground velocity, NED, (n, 3) [m, m/s]
        euler, rates: phi theta psi, p q r, (n, 3) [rad, rad/s]
        Va: equivalent airspeed, nan without a sensor, (n,) [m/s]
        phi_c, theta_c: reported commands, nan where missing, (n,) [rad]
        delta: reported delta_a, delta_e, delta_r, delta_t, nan where missing, (n, 4) [-1..1, throttle 0..1]
        seq: reported mission item, (n,)
        memory: state before the first row from `laws.remember`, (S.N_CTL,), or `NO_MEMORY`
    Returns:
        ctl at t[n-1], (S.N_CTL,)
        root mean square of replayed minus reported phi_c [rad]; nan if none is reported
    """
    n = t.shape[0]
    ctl = np.zeros(S.N_CTL)
    residual = np.full((n, 6), nan)  # reported minus replayed: theta_c, delta_t, delta_a, delta_e, delta_r, phi_c
    last = -1
    reported_ctl, switched = ctl, -1  # state on the reported leg, and row of the switch that waits for its report
    refuted = False  # the law's condition to switch, as it still holds, was not followed by a report
    k = -1
    while k < n - 1:
        k += 1
        if not (_is_finite(p[k]) and _is_finite(v[k]) and _is_finite(euler[k])):
            continue
        if last < 0:
            ctl = engage(par, legs, start, p[k], v[k], euler[k], Va[k], theta_c[k], delta[k, 3])
            if memory.shape[0] > 0:
                restore(ctl, par, memory, -p[k, 2])
            last = k
        if switched >= 0 and seq[k] == seq[switched] and t[k] - t[switched] > _REPORT_DELAY:
            ctl, refuted = reported_ctl, True
            last, k, switched = switched, switched, -1
            continue
        dt = min(max(t[k] - t[last], 0.0), _MAX_STEP)
        last = k
        if switched < 0 or seq[k] != seq[switched]:
            switched = -1
            _follow_reported_item(ctl, par, legs, seq[k], p[k])
        if not dt > 0.0:
            continue
        phi_k, theta_k, thr_k, leg_done = fly(ctl, par, legs, p[k], v[k], euler[k], Va[k], nan, dt)
        residual[k, 0], residual[k, 1] = theta_c[k] - theta_k, delta[k, 3] - thr_k
        residual[k, 5] = wrap(phi_c[k] - phi_k) if switched < 0 else nan  # which leg is flown is not known yet
        if _is_finite(rates[k]):
            roll = phi_c[k] if np.isfinite(phi_c[k]) else phi_k
            pitch = theta_c[k] if np.isfinite(theta_c[k]) else theta_k
            delta_a, delta_e, delta_r = stabilise(ctl, par, roll, pitch, euler[k], rates[k], Va[k], dt)
            residual[k, 2], residual[k, 3], residual[k, 4] = (
                delta[k, 0] - delta_a,
                delta[k, 1] - delta_e,
                delta[k, 2] - delta_r,
            )
        leg = int(ctl[S.LEG])
        refuted = refuted and leg_done
        if leg_done and not refuted and switched < 0 and leg + 1 < legs.shape[0] and legs[leg, SEQ] == seq[k]:
            if legs[leg + 1, SEQ] != seq[k]:  # else no report follows, as within a route without items
                reported_ctl, switched = ctl.copy(), k
            begin(ctl, par, legs, leg + 1, p[k])
    if last >= 0:
        reported = np.array([phi_c[n - 1], theta_c[n - 1], delta[n - 1, 3], Va[n - 1]])
        since = max(t[n - 1] - _MATCH_WINDOW, t[0] + _MATCH_WINDOW if memory.shape[0] > 0 else t[0])
        align_integrators(ctl, par, _typical_residual(residual[t >= since]), reported)
    return ctl, sqrt(_mean(residual[:, 5] ** 2, nan))


@array_kernel
def _mean(values: np.ndarray, default: float) -> float:
    """Return the mean of the finite values, or the default if there are none."""
    finite = values[np.isfinite(values)]
    return np.mean(finite) if finite.size else default


@array_kernel
def _median(values: np.ndarray, default: float) -> float:
    """Return the median of the finite values, robust to short peaks from commands with a wrong time stamp."""
    finite = values[np.isfinite(values)]
    return np.median(finite) if finite.size else default


@array_kernel
def _typical_residual(residual: np.ndarray) -> np.ndarray:
    """Return the typical residual of pitch, throttle and surfaces; 0 without data, (5,)."""
    out = np.empty(5)
    for j in range(5):
        out[j] = _mean(residual[:, j], 0.0) if j < 2 else _median(residual[:, j], 0.0)
    return out


@kernel
def _follow_reported_item(ctl: np.ndarray, par: np.ndarray, legs: np.ndarray, seq: float, p: np.ndarray) -> None:
    """Switch to the leg of the mission item that the aircraft reports."""
    i = leg_rules.current_leg(ctl, legs)
    if i < 0 or not np.isfinite(seq) or legs[i, SEQ] == seq:
        return
    j = _leg_of_item(ctl, legs, seq)
    if j >= 0 and j != int(ctl[S.LEG]):
        begin(ctl, par, legs, j, p)
