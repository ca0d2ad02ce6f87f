"""`StateSpace`: a discrete linear model of any order with simulation, transformation, stabilisation.

x' = A x + B u + K e + c,  y = C x + D u + e;  D = 0 in closed loop with an autopilot.
"""

from dataclasses import dataclass, replace

import numpy as np

from twin_worker.identification.linear.prediction_error_method import free_run

_MAX_RADIUS = 0.9995  # largest pole radius after stabilisation [-]


@dataclass(frozen=True)
class StateSpace:
    """Discrete linear model in the units of its data.

    Attributes:
        A: (n, n)
        B: (n, m)
        C: (l, n)
        K: innovation gain, (n, l); zeros for output error
        c: constant state bias, (n,)
        x0: state at the first fitted sample, (n,)
        D: (l, m)
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    K: np.ndarray
    c: np.ndarray
    x0: np.ndarray
    D: np.ndarray

    @classmethod
    def of(cls, A: np.ndarray, B: np.ndarray, C: np.ndarray, **parts: np.ndarray) -> "StateSpace":
        """Create a model; omitted matrices are zero."""
        (l, n), m = C.shape, B.shape[1]
        zeros = {"K": np.zeros((n, l)), "c": np.zeros(n), "x0": np.zeros(n), "D": np.zeros((l, m))}
        return cls(A, B, C, **(zeros | parts))

    @property
    def order(self) -> int:
        """Return the number of states."""
        return len(self.A)

    @property
    def radius(self) -> float:
        """Return the largest modulus of a pole."""
        return float(np.abs(np.linalg.eigvals(self.A)).max())

    def run(self, u: np.ndarray, x0: np.ndarray | None = None) -> np.ndarray:
        """Simulate y (N, l) under u (N, m) from x0 (n,), by default the x0 of the model."""
        x = np.empty((len(u), self.order))
        step = np.hstack([self.A, self.B, self.c[:, None]])
        free_run(step, np.asarray(self.x0 if x0 is None else x0, float), np.ascontiguousarray(u, float), x)
        return x @ self.C.T + u @ self.D.T

    def transformed(self, T: np.ndarray) -> "StateSpace":
        """Return the equivalent model with state T x."""
        T_inv = np.linalg.inv(T)
        return StateSpace(T @ self.A @ T_inv, T @ self.B, self.C @ T_inv, T @ self.K, T @ self.c, T @ self.x0, self.D)

    def outputs_as_states(self) -> "StateSpace":
        """Transform the state so that C = I.

        Raises:
            ValueError: if the numbers of states and outputs differ; identify with order = outputs.
        """
        if self.C.shape[0] != self.order:
            sizes = f"found {self.order} states and {self.C.shape[0]} outputs"
            raise ValueError(f"similarity to C = I: {sizes}, expected equal numbers; identify with order = outputs")
        return self.transformed(self.C + 1e-9 * np.eye(self.order))

    def stabilised(self) -> "StateSpace":
        """Mirror poles from outside the unit circle to its inside and limit their radius."""
        if self.radius <= _MAX_RADIUS:
            return self
        poles, modes = np.linalg.eig(self.A)
        modulus = np.abs(poles)
        new_modulus = np.minimum(np.where(modulus > 1, 1 / modulus, modulus), _MAX_RADIUS)
        A = np.real(modes * (poles / np.maximum(modulus, 1e-12) * new_modulus) @ np.linalg.pinv(modes))
        return replace(self, A=A)
