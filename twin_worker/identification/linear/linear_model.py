"""Two-step identification of the paper on one window: subspace estimate, then refinement with a prior."""

from dataclasses import dataclass

import numpy as np

from fleet.contract import Array, LinearModel
from fleet.frames import G
from fleet.window import Window
from twin_worker.identification.linear.prediction_error_method import refine
from twin_worker.identification.linear.subspace import subspace

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


AXES = tuple(STATES)
_MAX_POLE_RADIUS = 1.02  # largest pole of a first-step model; the prior mean replaces an unstable one [-]
_PRIOR_SCALE = 0.3  # prior standard deviation of a verified model, relative to that of a generic fixed wing [-]


@dataclass(frozen=True)
class AxisModel:
    """Identified axis in scaled units: x' = A x + B u + c with D = [A B c], x = (y - mean) / scale.

    Attributes:
        states, inputs: names
        D: (n, n + m + 1)
        y_mean, y_scale: (n,)
        u_mean, u_scale: (m,)
        dt: sample time [s]
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    D: np.ndarray
    y_mean: np.ndarray
    y_scale: np.ndarray
    u_mean: np.ndarray
    u_scale: np.ndarray
    dt: float

    @property
    def means(self) -> np.ndarray:
        """Return the means of states and inputs, (n + m,)."""
        return np.concatenate([self.y_mean, self.u_mean])

    def scaled(self, window: Window) -> tuple[np.ndarray, np.ndarray]:
        """Return outputs (N, n) and inputs (N, m) of a window in the scaled units of the model."""
        y = (window.columns(self.states) - self.y_mean) / self.y_scale
        return y, (window.columns(self.inputs) - self.u_mean) / self.u_scale

    def physical(self) -> np.ndarray:
        """Return [A B c] for unscaled deviations from trim, x' = A x + B u + c, (n, n + m + 1)."""
        n, m = len(self.y_mean), len(self.u_mean)
        column_scale = np.concatenate([self.y_scale, self.u_scale, [1.0]])
        assert self.D.shape == (n, n + m + 1)
        return self.y_scale[:, None] * self.D / column_scale

    def linear(self) -> LinearModel:
        """Export as matrices about the trim point (the offset c moves into the trim). Source: Huang 2021 eq. 2-4."""
        return about_trim((self.states, self.inputs), self.physical(), (self.y_mean, self.u_mean), self.dt)


def about_trim(
    names: tuple[tuple[str, ...], tuple[str, ...]], D: np.ndarray, mean: tuple[np.ndarray, np.ndarray], dt: float
) -> LinearModel:
    """Export x' = A x + B u + c as matrices about the trim point: the offset c moves into the trim.

    Args:
        names: states and inputs
        D: [A B c] for deviations from the mean, (n, n + m + 1)
        mean: states (n,) and inputs (m,)
        dt: sample time [s]
    """
    n, m = map(len, mean)
    A, B, c = D[:, :n], D[:, n : n + m], D[:, -1]
    shift = np.linalg.lstsq(np.eye(n) - A, c, rcond=1e-3)[0]
    return LinearModel(
        states=names[0],
        inputs=names[1],
        A=Array.of(A),
        B=Array.of(B),
        C=Array.of(np.eye(n)),
        D=Array.of(np.zeros((n, m))),
        x_trim=Array.of(mean[0] + shift),
        u_trim=Array.of(mean[1]),
        dt_s=dt,
    )


def identify_axis(
    axis: str, window: Window, length_s: float, prior_model: AxisModel | None = None
) -> tuple[AxisModel, AxisModel]:
    """Identify one axis of one window in two steps.

    Args:
        axis: `longitudinal` or `lateral`
        window: identification data
        length_s: free-run length of the prediction-error step [s]
        prior_model: the last verified model, prior mean of the parameters
    Returns:
        the first-step (subspace) and the refined model
    Raises:
        ValueError: if the window has too few gap-free rows for the subspace step; wait for more.
    """
    states, inputs = STATES[axis], INPUTS[axis]
    y, u, ok = window.columns(states), window.columns(inputs), window.ok
    y_mean, u_mean = y[ok].mean(axis=0), u[ok].mean(axis=0)
    y_scale, u_scale = np.maximum(y[ok].std(axis=0), 1e-3), np.maximum(u[ok].std(axis=0), 1e-2)
    frame = AxisModel(states, inputs, np.empty((0, 0)), y_mean, y_scale, u_mean, u_scale, window.dt)
    y, u = frame.scaled(window)
    column_scale = np.concatenate([y_scale, u_scale, [1.0]])
    speed = window.columns(("u", "w"))[ok].mean(axis=0)
    mean, sigma = prior(axis, speed[0], speed[1], window.dt)
    if prior_model is not None:
        mean, sigma = prior_model.physical(), _PRIOR_SCALE * sigma
        mean[:, -1], sigma[:, -1] = 0.0, sigma[:, -1] / _PRIOR_SCALE
    mean, sigma = mean * column_scale / y_scale[:, None], sigma * column_scale / y_scale[:, None]
    A, B = subspace(y, u, ok)
    first = np.hstack([A, B, np.zeros((len(A), 1))])
    if not (np.isfinite(first).all() and np.abs(np.linalg.eigvals(A)).max() < _MAX_POLE_RADIUS):
        first = mean.copy()
    length = max(int(length_s / window.dt), 10)
    refined = refine(first, y, u, ok, prior=mean, precision=sigma**-2.0, length=length)
    return tuple(  # type: ignore[return-value]
        AxisModel(states, inputs, D, y_mean, y_scale, u_mean, u_scale, window.dt) for D in (first, refined)
    )
