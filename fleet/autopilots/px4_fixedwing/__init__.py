"""PX4 fixed-wing control law from its equations: NPFG or L1 guidance, TECS for energy, rate loops for attitude.

    route --path--> line or circle --npfg--> phi_c ----------------+
      +--path--> height and speed --tecs--> theta_c, delta_t --------+--attitude--> delta_a, delta_e, delta_r
          every 0.1 s                                                    every 0.02 s

    par, absent = parameters(values, altitude_m)              autopilot parameters -> one vector, SI
    ctl = init(par, legs, k, start, p, v, euler, Va, theta_c, delta_t)
    phi_c, theta_c, delta_t, over = fly(ctl, par, legs, p, v, euler, Va, Va_dot, dt)
    delta_a, delta_e, delta_r = stabilise(ctl, par, phi_c, theta_c, euler, rates, Va, dt)

`fleet.autopilots.laws` provides `guide`, `fleet.autopilots.shadow` the replay. NPFG uses the wind estimate of the
autopilot: par[W_N], par[W_E] of `fleet.autopilots.control_law`. Not modelled: terrain following, flaps,
landing, the upper bound of the period in wind on circles, throttle compensation for airspeed and air density.

Source: see `npfg`, `tecs`; PX4 1.13 to 1.16 for the implementation.
"""

from fleet.autopilots.px4_fixedwing.guide import align_integrators, fly, init, stabilise
from fleet.autopilots.px4_fixedwing.params import DEFAULTS, L1_NAMES, L1_TABLE, NAMES, TABLE, l1_parameters, parameters
from fleet.autopilots.px4_fixedwing.path import begin, height_demand

LAW = "px4: NPFG + TECS"
LAW_L1 = "px4 before 1.13: L1 + TECS"

__all__ = [
    "DEFAULTS",
    "L1_NAMES",
    "L1_TABLE",
    "LAW",
    "LAW_L1",
    "NAMES",
    "TABLE",
    "align_integrators",
    "begin",
    "fly",
    "height_demand",
    "init",
    "l1_parameters",
    "parameters",
    "stabilise",
]
