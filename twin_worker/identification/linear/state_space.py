"""`StateSpace`: a discrete linear model of any order, and what can be done with one: run, predict, turn, stabilise.

x' = A x + B u + K e + c,  y = C x + D u + e;  D = 0 wherever an autopilot closes the loop.
"""

from dataclasses import dataclass, replace

import numpy as np

from twin_worker.identification.linear.prediction_error_method import free_run

_EDGE = 0.9995  # poles are drawn back to here [-]
_ECHO = 0.01  # weight of the echo against the fit [-]
_CAP = 1e6  # a run that leaves this has diverged, and stays there [scaled units]


@dataclass(frozen=True)
class StateSpace:
    """One model in the units of the data it came from.

    Attributes:
        A: (n, n)
        B: (n, m)
        C: (l, n)
        K: gain of the one-step prediction error; zeros: output error, (n, l)
        c: constant push on the state, (n,)
        x0: state at the first sample it was fitted to, (n,)
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
        """Make a model whose other parts are zero where they are not given."""
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
        """Simulate y (N, l) under u (N, m) from x0 (n,), the model's own where none is given."""
        x = np.empty((len(u), self.order))
        step = np.hstack([self.A, self.B, self.c[:, None]])
        free_run(step, np.asarray(self.x0 if x0 is None else x0, float), np.ascontiguousarray(u, float), x)
        return x @ self.C.T + u @ self.D.T

    def one_step(self, y: np.ndarray, u: np.ndarray, x0: np.ndarray | None = None) -> np.ndarray:
        """Predict every y (N, l) from what came before it."""
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
        """Estimate the state at the first of these samples: the state that explains them, (n,).

        Of states that explain them alike, the one whose echo through the whole run is weakest: an unsure state must
        not grow into a large error later.

        Args:
            y, u: the first few outputs (k, l) and inputs (k, m) of the run
            length: samples of the whole run
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
        """Return the same model with the state T x."""
        back = np.linalg.inv(T)
        return StateSpace(T @ self.A @ back, T @ self.B, self.C @ back, T @ self.K, T @ self.c, T @ self.x0, self.D)

    def outputs_as_states(self) -> "StateSpace":
        """Turn the state so that C = I.

        Raises:
            ValueError: when there are not as many states as outputs.
        """
        if self.C.shape[0] != self.order:
            found = f"found {self.order} states and {self.C.shape[0]} outputs"
            raise ValueError(f"similarity to C = I: {found}, expected as many; identify with order = outputs")
        return self.turned(self.C + 1e-9 * np.eye(self.order))

    def stabilised(self) -> "StateSpace":
        """Mirror the poles outside the unit circle and draw all of them to inside it."""
        if self.radius <= _EDGE:
            return self
        poles, modes = np.linalg.eig(self.A)
        size = np.abs(poles)
        size_new = np.minimum(np.where(size > 1, 1 / size, size), _EDGE)
        A = np.real(modes * (poles / np.maximum(size, 1e-12) * size_new) @ np.linalg.pinv(modes))
        return replace(self, A=A)
