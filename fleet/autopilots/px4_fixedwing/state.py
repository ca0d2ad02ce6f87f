"""State of the PX4 controller: indices of `ctl` by name.

Leg, airspeed filter, throttle and pitch have the indices of the ArduPlane controller (`common.controller_state`), so
that both share code. The indices below have a different meaning here.
"""

MIN_DISTANCE = 10  # minimum distance to the waypoint so far, -1 before [m]
PHI = 12  # roll demand, slew-limited [rad]
H_REF, H_DOT_REF = 25, 26  # height reference, up positive [m], and its rate [m/s]
STE_DOT = 31  # filtered total energy rate [m2/s3]
I_THETA = 33  # pitch integrator [rad]
I_R = 45  # yaw rate integrator, 1 = full throw
S_R, S_A, S_E = 46, 49, 50  # last surfaces before the limit, 1 = full throw
