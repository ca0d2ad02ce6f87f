"""Generic fixed-wing autopilot model: L1 guidance on the route, first-order lags for attitude, speed and climb.

    phi_c from L1 (`arduplane.legs`);  phi' = (phi_c - phi) / tau_phi;  psi' = g tan(phi + b) / V
    V' = (V_c - V) / tau_V;  h_dot_c = clip((h_sp - h) / tau_h, climb, sink);  h_ddot = (h_dot_c - h_dot) / tau_climb

phi is the bank of the attitude estimate, which the autopilot controls; b is its error. The model needs position and
velocity only: no surfaces, rate loops or airspeed sensor.
Source: Park, Deyst & How (2004) for L1; lags as in Beard & McLain 2012, section 9.1 (autopilot design models).
"""

from math import cos, sin, sqrt, tan

import numpy as np

from fleet.autopilots.arduplane import legs as leg_rules
from fleet.autopilots.arduplane.l1 import to_roll
from fleet.autopilots.control_law import SWITCH_S, array_kernel, clip
from fleet.autopilots.laws import switch_when_due
from fleet.compiled_frames import assign
from fleet.frames import G
from fleet.mission import KIND, LAND, VA_C

LAW = "greybox: L1 on the route, lags for the rest"

TAU_PHI, TAU_V, TAU_H, TAU_CLIMB, CRUISE, TAS_RATIO, CLIMB, SINK, B_PHI = range(9)
N_PAR = 9
"""Time constants of bank, speed, height, climb [s]; default true airspeed [m/s]; true over commanded airspeed [-];
maximum climb and sink rate [m/s]; true minus estimated bank [rad]."""


@array_kernel
def follow(
    ctl: np.ndarray,
    par: np.ndarray,
    legs: np.ndarray,
    lags: np.ndarray,
    start: np.ndarray,
    wind: np.ndarray,
    dt: float,
    out: np.ndarray,
) -> None:
    """Simulate the flight along the route.

    Args:
        ctl, par: state (changed) and parameters of the ArduPlane guidance
        legs: route, (n, 9), see `fleet.mission`
        grey: (N_PAR,)
        start: p NED [m], V true airspeed [m/s], phi, psi [rad], h_dot [m/s], (7,)
        wind: NED, direction the wind blows to, (2,) [m/s]
        dt: step [s]
        out: positions, filled in, NED, (k, 3) [m]; out[0] is the start
    """
    p, v, euler = start[:3].copy(), np.zeros(3), np.zeros(3)
    V, phi, psi, h_dot = start[3], start[4], start[5], start[6]
    landed = False
    v_before = np.zeros(3)
    for k in range(len(out)):
        if landed:
            assign(out[k], p)
            continue
        V_horizontal = sqrt(max(V * V - h_dot * h_dot, 1.0))
        v[0], v[1], v[2] = V_horizontal * cos(psi) + wind[0], V_horizontal * sin(psi) + wind[1], -h_dot
        for j in range(3):
            p[j] += 0.5 * dt * (v_before[j] + v[j]) if k > 0 else 0.0  # trapezoidal rule: no lag in turns
            out[k, j], v_before[j] = p[j], v[j]
        euler[0], euler[2] = phi, psi
        if ctl[SWITCH_S] > 0.0:
            switch_when_due(ctl, par, legs, p, dt)
        a_lat, leg_done = leg_rules.steer(ctl, par, legs, p, v, euler, dt)
        h_sp = leg_rules.height_demand(ctl, par, legs, p)
        i = leg_rules.current_leg(ctl, legs)
        Va_c = legs[i, VA_C] * lags[TAS_RATIO] if legs[i, VA_C] > 0.0 else lags[CRUISE]
        phi_before = phi
        phi += (to_roll(par, a_lat, 0.0) - phi) * min(dt / lags[TAU_PHI], 1.0)
        phi_mean = clip(0.5 * (phi_before + phi) + lags[B_PHI], -1.2, 1.2)
        psi += G * tan(phi_mean) / max(V, 3.0) * dt
        V += (Va_c - V) * min(dt / lags[TAU_V], 1.0)
        h_dot_c = clip((h_sp + p[2]) / lags[TAU_H], -lags[SINK], lags[CLIMB])
        h_dot += (h_dot_c - h_dot) * min(dt / lags[TAU_CLIMB], 1.0)
        if int(legs[i, KIND]) == LAND:
            along, length = leg_rules.along_line(ctl, legs[i], p)
            landed = along >= length
        if leg_done and i + 1 < legs.shape[0]:
            leg_rules.begin(ctl, par, legs, i + 1, p)
