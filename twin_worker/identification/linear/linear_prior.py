"""Prior of a generic small fixed wing: exact kinematics, approximate aerodynamics.

Rates of change per unit of each state and input, at 25 m/s; forces grow with airspeed, control with its square.
Source: Beard & McLain 2012, section 5.5 (linear models) with the Aerosonde of appendix E; gravity and rotation exact.
"""

import numpy as np

from fleet.frames import G

STATES = {"longitudinal": ("u", "w", "q", "theta"), "lateral": ("phi", "psi", "p", "r", "v")}
INPUTS = {"longitudinal": ("delta_e", "delta_t", "bank"), "lateral": ("delta_a", "delta_r")}
_TABLE_AIRSPEED = 25.0  # airspeed of the table [m/s]

# (row, column, derivative at 25 m/s, exponent of airspeed)
_AERODYNAMICS = (
    ("u", "u", -0.15, 0.0),
    ("u", "w", 0.30, 0.0),
    ("u", "delta_t", 6.0, 0.0),
    ("w", "u", -0.8, -1.0),
    ("w", "w", -4.5, 0.0),
    ("w", "delta_e", -1.5, 1.0),
    ("q", "w", -3.0, 1.0),
    ("q", "q", -5.0, 1.0),
    ("q", "delta_e", 16.0, 2.0),
    ("p", "p", -12.0, 1.0),
    ("p", "r", 4.0, 1.0),
    ("p", "v", -2.5, 1.0),
    ("p", "delta_a", 25.0, 2.0),
    ("r", "p", -0.5, 1.0),
    ("r", "r", -4.0, 1.0),
    ("r", "v", 2.5, 1.0),
    ("r", "delta_a", -1.0, 2.0),
    ("r", "delta_r", 5.0, 2.0),
    ("v", "v", -1.0, 0.0),
)
_DEFAULT_SIGMA = {"u": 0.3, "w": 0.6, "q": 1.0, "p": 1.5, "r": 1.0, "v": 0.5}  # sigma of other entries [1/s]
_RELATIVE_SIGMA = 0.4  # relative standard deviation of an entry in the table [-]
_KINEMATIC_SIGMA = {"theta": 0.05, "phi": 0.05, "psi": 0.05}  # standard deviation of kinematic rows [1/s]
_OFFSET_SIGMA = {"u": 2.0, "w": 3.0, "q": 3.0, "p": 3.0, "r": 2.0, "v": 2.0, "theta": 0.05, "phi": 0.05, "psi": 0.05}


def prior(axis: str, U0: float, W0: float, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of [A B c] for a generic small fixed wing.

    theta' = q - g/U0 bank, phi' = p, psi' = r;  u' = -g theta - W0 q, w' = U0 q, v' = g phi - U0 r + W0 p.

    Args:
        axis: `longitudinal` or `lateral`
        U0, W0: trim velocity along and down the body [m/s]
        dt: sample time [s]
    Returns:
        mean and standard deviation, unscaled units, each (n, n + m + 1)
    """
    states, columns = STATES[axis], (*STATES[axis], *INPUTS[axis], "1")
    rate = {(row, column): slope * (U0 / _TABLE_AIRSPEED) ** power for row, column, slope, power in _AERODYNAMICS}
    exact = {("theta", "q"): 1.0, ("theta", "bank"): -G / U0, ("phi", "p"): 1.0, ("psi", "r"): 1.0}
    exact |= {("u", "theta"): -G, ("u", "q"): -W0, ("w", "q"): U0, ("w", "bank"): -G / 2}
    exact |= {("v", "phi"): G, ("v", "r"): -U0, ("v", "p"): W0}
    mean = np.array([[exact.get((i, j), rate.get((i, j), 0.0)) for j in columns] for i in states])
    sigma = np.array([[_entry_sigma(i, j, rate.get((i, j))) for j in columns] for i in states])
    mean, sigma = dt * mean, dt * sigma
    mean[:, : len(states)] += np.eye(len(states))
    return mean, sigma


def _entry_sigma(row: str, column: str, slope: float | None) -> float:
    """Return the standard deviation of one continuous entry; per m/s for velocities, per rad or rad/s for the rest."""
    if column == "psi":
        return 1e-6  # forces do not depend on heading
    if column == "1":
        return _OFFSET_SIGMA[row]
    if row in _KINEMATIC_SIGMA:
        return _KINEMATIC_SIGMA[row] * (0.02 if column in ("u", "v", "w") else 1.0)
    if slope is not None:
        return _RELATIVE_SIGMA * abs(slope) + 0.2 * _DEFAULT_SIGMA[row]
    # rates depend weakly on velocities; velocities depend strongly on rates and angles
    weight = {"uvw": 1.0, "pqr": 0.3}["uvw" if column in ("u", "v", "w") else "pqr"]
    if row in ("u", "v", "w") and column not in ("u", "v", "w"):
        weight = 4.0
    return _DEFAULT_SIGMA[row] * weight
