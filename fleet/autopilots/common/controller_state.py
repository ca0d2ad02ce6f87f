"""The flat memory of the controller: one float64 vector `ctl`, its slots by name.

The slots up to N_LEG belong to the leg being flown; the shadow run winds them back on their own.
"""

# the leg
LEG = 0  # index of the current leg
PREV_N, PREV_E, PREV_D = 1, 2, 3  # where its line begins, NED [m]
FROM = slice(1, 4)  # the same
TURN = 4  # size of the turn at its end [rad]
ANGLE, BEARING = 5, 6  # angle flown on the circle, last bearing to its centre [rad]
ON, AROUND = 7, 8  # 1: the circle was reached; 1: flying on the circle now
TIMER = 9  # time since the circle was reached [s]
READY = 10  # circle angle at which the exit condition was met, -1 before [rad]
LINE = 11  # 1: the line begins at a waypoint and is to be followed even to a circle
N_LEG = 12
# L1
XTRACK, NU = 12, 13  # crosstrack integral, last course error [rad]
# airspeed filter
V_N, V_E, V_D, SEEN = 14, 15, 16, 17  # last ground velocity, NED [m/s]; 1: there is one
ACCEL, ACCEL_LP = 18, 19  # forward acceleration, and its slow part [m/s2]
V_HAT, V_DOT_HAT = 20, 21  # filtered true airspeed [m/s], its bias state [m/s2]
# speed demand
V_DEM, V_DEM_LP, V_TOP = 22, 23, 24  # demanded true airspeed [m/s], slow part of its rate [m/s2], ceiling [m/s]
# height demand, up is positive
H_IN, H_LIMITED, H_DEM, H_LAST = 25, 26, 27, 28  # raw, rate-limited, lagged, lagged one step ago [m]
UP, DOWN = 29, 30  # share of the climb and sink limits in force, 0..1
# energy
STE_LP = 31  # filtered error of the total energy rate [m2/s3]
I_THR, I_SEB, I_KE = 32, 33, 34  # integrators: throttle 0..1, energy balance rate, kinetic energy [m2/s3]
THR, THR_SAT = 35, 36  # throttle before its integrator 0..1; -1, 0, +1 saturated
THETA, THETA_SAT = 37, 38  # pitch demand [rad]; -1, 0, +1 saturated
SLOW, SINKING = 39, 40  # 1: underspeed; 1: bad descent
# rate loops
P_T, Q_T = 41, 42  # filtered rate targets [rad/s]
I_A, I_E = 43, 44  # integrators [rad of surface]
E_A, E_E, D_A, D_E = 45, 46, 47, 48  # last errors [rad/s], filtered derivatives [rad/s2]
S_A, S_E = 49, 50  # last surfaces before the limit, 1 = full throw
N_CTL = 51
