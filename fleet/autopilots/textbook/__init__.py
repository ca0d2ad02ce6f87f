"""Textbook autopilot: vector field for lines and orbits, fillets between lines, cascaded loops.

    line   chi_c = chi_q - chi_inf 2/pi atan(k_path e)                       e: right of the line
    orbit  chi_c = phi_orbit + d (pi/2 + atan(k_orbit (r - R) / R)),         phi_ff = d atan(v_g^2 / (g R))
    phi_c   = phi_ff + k_p_chi (chi_c - chi) + k_i_chi int,                  k_p = 2 zeta omega V/g, k_i = omega^2 V/g
    theta_c = asin(h_dot_c / V) + k_p_h (h_c - h) + k_i_h int
    delta_t = delta_t_trim + k_ff_h h_dot_c + k_ff_n (n^2 - 1) + k_p_V (Va_c - Va) + k_i_V int

The path changes from a line to the fillet (radius `R_fillet`) and to the next line at the tangent points.
Source: Beard & McLain, "Small Unmanned Aircraft" (2012), chapters 6, 10 and 11; the feed-forward terms are additions.
"""

from fleet.autopilots.textbook.loops import align_integrators, fly, init, stabilise
from fleet.autopilots.textbook.params import DEFAULTS, NAMES, TABLE, parameters
from fleet.autopilots.textbook.path import begin, height_demand

LAW = "textbook: vector field, cascaded loops"

__all__ = [
    "DEFAULTS",
    "LAW",
    "NAMES",
    "TABLE",
    "align_integrators",
    "begin",
    "fly",
    "height_demand",
    "init",
    "parameters",
    "stabilise",
]
