"""Two-step identification of the paper on one window: subspace estimate, then prediction-error refinement."""

from dataclasses import dataclass

import numpy as np

from fleet.contract import Array, LinearModel
from fleet.window import Window
from twin_worker.identification.linear.linear_prior import INPUTS, STATES, prior
from twin_worker.identification.linear.prediction_error_method import refine
from twin_worker.identification.linear.subspace import subspace

AXES = tuple(STATES)
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
        n, m = len(self.y_mean), len(self.u_mean)
        D = self.physical()
        A, B, c = D[:, :n], D[:, n : n + m], D[:, -1]
        shift = np.linalg.lstsq(np.eye(n) - A, c, rcond=1e-3)[0]
        return LinearModel(
            states=self.states,
            inputs=self.inputs,
            A=Array.of(A),
            B=Array.of(B),
            C=Array.of(np.eye(n)),
            D=Array.of(np.zeros((n, m))),
            x_trim=Array.of(self.y_mean + shift),
            u_trim=Array.of(self.u_mean),
            dt_s=self.dt,
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
    first = _stable_or_prior(first, mean)
    length = max(int(length_s / window.dt), 10)
    refined = refine(first, y, u, ok, prior=mean, precision=sigma**-2.0, length=length)
    return tuple(  # type: ignore[return-value]
        AxisModel(states, inputs, D, y_mean, y_scale, u_mean, u_scale, window.dt) for D in (first, refined)
    )


def _stable_or_prior(D: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return the first-step model, or the prior mean if that model is not finite or unstable."""
    n = len(D)
    if np.isfinite(D).all() and np.abs(np.linalg.eigvals(D[:, :n])).max() < 1.02:
        return D
    return mean.copy()
