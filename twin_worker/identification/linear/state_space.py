"""`StateSpace`: a discrete linear model of any order with simulation, prediction, transformation, stabilisation.

x' = A x + B u + K e + c,  y = C x + D u + e;  D = 0 in closed loop with an autopilot.
"""

from dataclasses import dataclass, replace

import numpy as np

from twin_worker.identification.linear.prediction_error_method import free_run

_EDGE = 0.9995  # largest pole radius after stabilisation [-]
_ECHO = 0.01  # weight of the observability Gramian against the fit [-]
_CAP = 1e6  # bound of the observability rows [scaled units]


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
    def of(cls, A: np.ndarray, B: np.ndarray, C: np.ndarray, **more: np.ndarray) -> "StateSpace":
        """Create a model; omitted matrices are zero."""
        (l, n), m = C.shape, B.shape[1]
        zeros = {"K": np.zeros((n, l)), "c": np.zeros(n), "x0": np.zeros(n), "D": np.zeros((l, m))}
        return cls(A, B, C, **(zeros | more))

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

    def one_step(self, y: np.ndarray, u: np.ndarray, x0: np.ndarray | None = None) -> np.ndarray:
        """Predict every y (N, l) from the samples before it."""
        watched = StateSpace(
            A=self.A - self.K @ self.C,
            B=np.hstack([self.B - self.K @ self.D, self.K]),
            C=self.C,
            K=self.K,
            c=self.c,
            x0=self.x0,
            D=np.hstack([self.D, np.zeros((len(self.C), len(self.C)))]),
        )
        return watched.run(np.hstack([u, y]), x0)

    def begin(self, y: np.ndarray, u: np.ndarray, length: int) -> np.ndarray:
        """Estimate the state at the first sample by regularised least squares, (n,).

        The observability Gramian of the complete run is the regulariser: it prevents an uncertain state from growing
        into a large error later.

        Args:
            y, u: the first outputs (k, l) and inputs (k, m) of the run
            length: samples of the complete run
        """
        rest = y - self.run(u, np.zeros(self.order))
        seen = np.empty((len(y), *self.C.shape))
        echo, row = np.zeros((self.order, self.order)), self.C
        for k in range(length):
            if k < len(y):
                seen[k] = row
            echo += row.T @ row
            row = np.clip(row @ self.A, -_CAP, _CAP)
        rows = seen.reshape(-1, self.order)
        lhs = rows.T @ rows + _ECHO * len(y) / length * echo
        return np.linalg.lstsq(lhs, rows.T @ rest.ravel(), rcond=1e-12)[0]

    def turned(self, T: np.ndarray) -> "StateSpace":
        """Return the equivalent model with state T x."""
        back = np.linalg.inv(T)
        return StateSpace(T @ self.A @ back, T @ self.B, self.C @ back, T @ self.K, T @ self.c, T @ self.x0, self.D)

    def outputs_as_states(self) -> "StateSpace":
        """Transform the state so that C = I.

        Raises:
            ValueError: if the numbers of states and outputs differ; identify with order = outputs.
        """
        if self.C.shape[0] != self.order:
            found = f"found {self.order} states and {self.C.shape[0]} outputs"
            raise ValueError(f"similarity to C = I: {found}, expected equal numbers; identify with order = outputs")
        return self.turned(self.C + 1e-9 * np.eye(self.order))

    def stabilised(self) -> "StateSpace":
        """Mirror poles from outside the unit circle to its inside and limit their radius."""
        if self.radius <= _EDGE:
            return self
        poles, modes = np.linalg.eig(self.A)
        size = np.abs(poles)
        size_new = np.minimum(np.where(size > 1, 1 / size, size), _EDGE)
        A = np.real(modes * (poles / np.maximum(size, 1e-12) * size_new) @ np.linalg.pinv(modes))
        return replace(self, A=A)
