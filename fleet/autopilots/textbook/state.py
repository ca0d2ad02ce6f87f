"""State of the textbook controller: indices of `ctl` by name.

Leg, airspeed filter, THETA and THR have the indices of the ArduPlane controller (`common.controller_state`).
"""

C_N, C_E, FILLET_SIDE = 12, 13, 22  # centre of the fillet, NED [m]; 1 right turn, -1 left turn, 0 no fillet
I_CHI, I_H, I_V = 32, 33, 34  # integrators [rad, rad, 0..1]
I_A, I_E = 43, 44  # surface deflections at trim, 1 = full throw
