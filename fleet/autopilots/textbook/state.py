"""The flat memory of the textbook's controller: slots of `ctl` by name.

The leg, the airspeed filter, THETA and THR lie where ArduPlane's controller has them (`arduplane.state`).
"""

C_N, C_E, SIDE = 12, 13, 22  # centre of the fillet, NED [m]; 1 it turns right, -1 left, 0 there is none
I_CHI, I_H, I_V = 32, 33, 34  # integrators [rad, rad, 0..1]
I_A, I_E = 43, 44  # what the surfaces carry at trim, 1 = full throw
