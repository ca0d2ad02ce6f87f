"""Wrench of a fixed wing: specific force and angular acceleration, affine in the derivatives.

    s = u_a / U0 within 0.4..2,   du = u_a - U0,   dw = w_a - W0 s         (air-relative velocity u_a v_a w_a)

    X = X_0 + X_u du + X_w dw + X_de delta_e s2 + X_dt delta_t + X_ww dw2
    Z = Z_0 s2 + Z_u du + Z_w dw s + Z_q q s + Z_de delta_e s2          M as Z, + M_dt delta_t
    Y = Y_v v_a s + Y_p p s + Y_r r s + Y_da delta_a s2 + Y_dr delta_r s2 + Y_0         L, N as Y

Derivatives are dimensional, at airspeed U0: unit mass and geometry, so no airframe card is needed. The same vector
contains the mean wind over the ground, because it is identified together with them.

Source: Beard & McLain 2012, section 5.5 (dimensional derivatives); Klein & Morelli 2006, chapter 3.
"""

import numpy as np

from fleet.physics.kernel import inlined_kernel, kernel, no_alloc_kernel

NAMES = (
    *("X_0", "X_u", "X_w", "X_de", "X_dt", "X_ww"),
    *("Z_0", "Z_u", "Z_w", "Z_q", "Z_de"),
    *("M_0", "M_u", "M_w", "M_q", "M_de", "M_dt"),
    *("Y_v", "Y_p", "Y_r", "Y_da", "Y_dr", "Y_0"),
    *("L_v", "L_p", "L_r", "L_da", "L_dr", "L_0"),
    *("N_v", "N_p", "N_r", "N_da", "N_dr", "N_0"),
    *("w_n", "w_e"),
)
"""The parameter vector `par`, (37,): specific force [m/s2] and angular acceleration [rad/s2] per unit of each term."""

N_PAR = len(NAMES)
N_AERO = N_PAR - 2  # without the wind
X, Z, M, Y, L, N, WIND = 0, 6, 11, 17, 23, 29, 35  # index of the first term of each row
OFFSETS = tuple(NAMES.index(name) for name in ("X_0", "Z_0", "M_0", "Y_0", "L_0", "N_0"))
ROW = np.array([0] * 6 + [2] * 5 + [4] * 6 + [1] * 6 + [3] * 6 + [5] * 6)  # state whose rate each derivative drives
MIN_SPEED_RATIO, MAX_SPEED_RATIO = 0.4, 2.0  # limits of u_a / U0; the derivatives are constant beyond [-]


@inlined_kernel
def wrench(par, u_a, v_a, w_a, p, q, r, delta, trim):  # type: ignore[no-untyped-def]
    """Return X Y Z [m/s2], L M N [rad/s2].

    Args:
        par: derivatives in the order of `NAMES`, (37,)
        u_a, v_a, w_a: air-relative velocity, FRD [m/s]
        p, q, r: body rates, FRD [rad/s]
        delta: actuator state delta_a delta_e delta_r delta_t, (4,)
        trim: U0, W0 of the derivatives, (2,) [m/s]
    """
    s = min(max(u_a / trim[0], MIN_SPEED_RATIO), MAX_SPEED_RATIO)
    s2 = s * s
    du, dw = u_a - trim[0], w_a - trim[1] * s
    v_s, p_s, q_s, r_s, w_s = v_a * s, p * s, q * s, r * s, dw * s
    a_s, e_s, r_d = delta[0] * s2, delta[1] * s2, delta[2] * s2
    return (
        par[0] + par[1] * du + par[2] * dw + par[3] * e_s + par[4] * delta[3] + par[5] * dw * dw,
        par[17] * v_s + par[18] * p_s + par[19] * r_s + par[20] * a_s + par[21] * r_d + par[22],
        par[6] * s2 + par[7] * du + par[8] * w_s + par[9] * q_s + par[10] * e_s,
        par[23] * v_s + par[24] * p_s + par[25] * r_s + par[26] * a_s + par[27] * r_d + par[28],
        par[11] * s2 + par[12] * du + par[13] * w_s + par[14] * q_s + par[15] * e_s + par[16] * delta[3],
        par[29] * v_s + par[30] * p_s + par[31] * r_s + par[32] * a_s + par[33] * r_d + par[34],
    )


@no_alloc_kernel
def terms(u_a: float, v_a: float, w_a: float, rates: np.ndarray, delta: np.ndarray, trim: np.ndarray, out: np.ndarray):  # type: ignore[no-untyped-def]
    """Compute the factor of each derivative, (35,), in the order of `NAMES`; arguments as for `wrench`."""
    s = min(max(u_a / trim[0], MIN_SPEED_RATIO), MAX_SPEED_RATIO)
    s2 = s * s
    du, dw = u_a - trim[0], w_a - trim[1] * s
    p, q, r = rates[0], rates[1], rates[2]
    out[0], out[1], out[2], out[3], out[4], out[5] = 1.0, du, dw, delta[1] * s2, delta[3], dw * dw
    out[6], out[7], out[8], out[9], out[10] = s2, du, dw * s, q * s, delta[1] * s2
    out[11], out[12], out[13], out[14], out[15], out[16] = s2, du, dw * s, q * s, delta[1] * s2, delta[3]
    for k in (17, 23, 29):
        out[k], out[k + 1], out[k + 2] = v_a * s, p * s, r * s
        out[k + 3], out[k + 4], out[k + 5] = delta[0] * s2, delta[2] * s2, 1.0


@kernel
def wrench_jacobian(
    par: np.ndarray,
    air: np.ndarray,
    rates: np.ndarray,
    delta: np.ndarray,
    trim: np.ndarray,
    by_air: np.ndarray,
    by_rate: np.ndarray,
) -> None:
    """Compute the derivative of the wrench by air-relative velocity and by body rates, each (6, 3)."""
    s = min(max(air[0] / trim[0], MIN_SPEED_RATIO), MAX_SPEED_RATIO)
    ds = 1.0 / trim[0] if MIN_SPEED_RATIO < air[0] / trim[0] < MAX_SPEED_RATIO else 0.0
    dw = air[2] - trim[1] * s
    dw_u = -trim[1] * ds
    d_a, d_e, d_r = delta[0], delta[1], delta[2]
    p, q, r = rates[0], rates[1], rates[2]
    by_air[:] = 0.0
    by_rate[:] = 0.0
    by_air[0, 0] = par[1] + (par[2] + 2.0 * par[5] * dw) * dw_u + 2.0 * par[3] * d_e * s * ds
    by_air[0, 2] = par[2] + 2.0 * par[5] * dw
    for row, k in ((2, 6), (4, 11)):
        by_air[row, 0] = 2.0 * s * ds * (par[k] + par[k + 4] * d_e) + par[k + 1]
        by_air[row, 0] += par[k + 2] * (dw_u * s + dw * ds) + par[k + 3] * q * ds
        by_air[row, 2] = par[k + 2] * s
        by_rate[row, 1] = par[k + 3] * s
    for row, k in ((1, 17), (3, 23), (5, 29)):
        by_air[row, 0] = ds * (par[k] * air[1] + par[k + 1] * p + par[k + 2] * r)
        by_air[row, 0] += 2.0 * s * ds * (par[k + 3] * d_a + par[k + 4] * d_r)
        by_air[row, 1] = par[k] * s
        by_rate[row, 0] = par[k + 1] * s
        by_rate[row, 2] = par[k + 2] * s
