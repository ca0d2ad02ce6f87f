"""Parameters of the textbook autopilot, with the names of the book, as one vector for the compiled controller.

The defaults suit a small aircraft.
"""

from collections.abc import Mapping
from math import pi

import numpy as np

from fleet.autopilots.control_law import TEXTBOOK, ParameterSpec, eas2tas, lookup, padded

TABLE = (
    ParameterSpec("chi_inf", pi / 3, 1, 0.1, pi / 2),
    ParameterSpec("k_path", 0.025, 1, 1e-4, 1),
    ParameterSpec("k_orbit", 4.0, 1, 0.1, 100),
    ParameterSpec("R_fillet", 75.0, 1, 1, 1e5),
    ParameterSpec("R_orbit", 80.0, 1, -1e5, 1e5),
    ParameterSpec("omega_chi", 0.6, 1, 0.01, 10),
    ParameterSpec("zeta_chi", 1.0, 1, 0.1, 5),
    ParameterSpec("k_i_chi", 0.0, 1, 0, 10),
    ParameterSpec("phi_max", pi / 4, 1, 0.05, 1.4),
    ParameterSpec("k_p_h", 0.012, 1, 0, 1),
    ParameterSpec("k_i_h", 0.001, 1, 0, 1),
    ParameterSpec("theta_max", 0.35, 1, 0.05, 1.2),
    ParameterSpec("climb_max", 4.0, 1, 0.1, 100),
    ParameterSpec("sink_max", 3.0, 1, 0.1, 100),
    ParameterSpec("Va_c", 15.0, 1, 1, 300),
    ParameterSpec("k_p_V", 0.05, 1, 0, 10),
    ParameterSpec("k_i_V", 0.01, 1, 0, 10),
    ParameterSpec("k_ff_h", 0.08, 1, 0, 10),
    ParameterSpec("k_ff_n", 0.05, 1, 0, 10),
    ParameterSpec("delta_t_trim", 0.5, 1, 0, 1),
    ParameterSpec("k_p_phi", 1.0, 1, 0, 100),
    ParameterSpec("k_d_phi", 0.1, 1, 0, 100),
    ParameterSpec("k_p_theta", 1.0, 1, 0, 100),
    ParameterSpec("k_d_theta", 0.2, 1, 0, 100),
    ParameterSpec("k_i_theta", 0.2, 1, 0, 100),
)
(
    CHI_INF, K_PATH, K_ORBIT, FILLET, ORBIT, OMEGA, ZETA, K_I_CHI, PHI_MAX, K_P_H, K_I_H, THETA_MAX, CLIMB, SINK,
    CRUISE, K_P_V, K_I_V, K_FF_H, K_FF_N, THR_TRIM, K_P_PHI, K_D_PHI, K_P_THETA, K_D_THETA, K_I_THETA,
) = range(len(TABLE))  # fmt: skip
EAS2TAS = len(TABLE)

NAMES = tuple(row.name for row in TABLE)
DEFAULTS: dict[str, float] = {row.name: float(row.default) for row in TABLE}


def parameters(values: Mapping[str, float], altitude_m: float = 0.0) -> tuple[np.ndarray, tuple[str, ...]]:
    """Convert parameters to the vector for the kernels; arguments and result as for PX4."""
    inputs = {name: float(value) for name, value in values.items()}
    matches = [lookup(row, inputs) for row in TABLE]
    resolved = [row.default if value is None else value for row, value in zip(TABLE, matches, strict=True)]
    absent = tuple(row.name for row, value in zip(TABLE, matches, strict=True) if value is None)
    return padded(np.array([*resolved, eas2tas(altitude_m)], float), TEXTBOOK), absent


C_N, C_E, FILLET_SIDE = 12, 13, 22  # centre of the fillet, NED [m]; 1 right turn, -1 left turn, 0 no fillet
I_CHI, I_H, I_V = 32, 33, 34  # integrators [rad, rad, 0..1]
I_A, I_E = 43, 44  # surface deflections at trim, 1 = full throw
