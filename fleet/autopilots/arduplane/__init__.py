"""ArduPlane control law from its equations: L1 guidance, TECS for energy, PID loops for attitude.

    route --legs--> line or circle --l1--> phi_c ----------------+
      +--legs--> height and speed --tecs--> theta_c, delta_t ------+--attitude--> delta_a, delta_e, delta_r
          every 0.1 s                                                  every 0.02 s

    par, absent = parameters(values, altitude_m)              autopilot parameters -> one vector, SI
    ctl = init(par, legs, k, start, p, v, euler, Va, theta_c, delta_t)
    phi_c, theta_c, delta_t = guide(ctl, par, legs, p, v, euler, Va, Va_dot, dt)
    delta_a, delta_e, delta_r = stabilise(ctl, par, phi_c, theta_c, euler, rates, Va, dt)

All but `parameters` are compiled and change `ctl` in place; ctl[LEG] is the index of the current leg. Airspeeds are
equivalent, as reported by the sensor, and converted to true airspeed inside. `fleet.autopilots.shadow` synchronises
the state with telemetry. Not modelled: terrain following, flaps, reverse thrust, the yaw damper (off by default) and
the gain reduction of oscillating loops.

Source: Park, Deyst & How (2004) for L1; Lambregts (1983) for TECS; ArduPlane 4.x for the implementation.
"""

from fleet.autopilots.arduplane.guide import guide, init, stabilise
from fleet.autopilots.arduplane.legs import set_leg
from fleet.autopilots.arduplane.params import DEFAULTS, N_PAR, NAMES, TABLE, parameters, read, vector
from fleet.autopilots.control_law import FROM, LEG, N_CTL, N_LEG, TURN, eas2tas

LAW = "arduplane: L1 + TECS"

__all__ = [
    "DEFAULTS",
    "FROM",
    "LAW",
    "LEG",
    "NAMES",
    "N_CTL",
    "N_LEG",
    "N_PAR",
    "TABLE",
    "TURN",
    "eas2tas",
    "guide",
    "init",
    "parameters",
    "read",
    "set_leg",
    "stabilise",
    "vector",
]
