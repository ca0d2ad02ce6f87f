"""What pysindy gives: x' a polynomial in x and u, integrated by Runge and Kutta's rule."""

from dataclasses import dataclass

import numpy as np

_MOST = 1e3
_LAST = 3  # samples averaged for the start


@dataclass
class Polynomial:
    """One identified axis in standardised units: x' = coefficients · monomials of (x, u).

    Attributes:
        powers: exponents of every monomial, (f, n + m)
        coefficients: (n, f)
        dt: sample time [s]
        x: state right after the window, (n,)
        ms: processor time of the identification [ms]
    """

    powers: np.ndarray
    coefficients: np.ndarray
    dt: float
    x: np.ndarray
    ms: float = 0.0

    def _rate(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        z = np.hstack([x, u])
        return np.prod(z[:, None, :] ** self.powers, axis=2) @ self.coefficients.T

    def _step(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Advance states (N, n) under inputs held (N, m)."""
        h = self.dt
        k1 = self._rate(x, u)
        k2 = self._rate(x + 0.5 * h * k1, u)
        k3 = self._rate(x + 0.5 * h * k2, u)
        k4 = self._rate(x + h * k3, u)
        return np.clip(x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), -_MOST, _MOST)

    def forecast(self, u: np.ndarray) -> np.ndarray:
        """Run free under u (N, m); (N, n), its first row right after the window."""
        x, out = self.x[None], np.empty((len(u), len(self.x)))
        for k, now in enumerate(u):
            out[k] = x[0]
            x = self._step(x, now[None])
        return out

    def kstep(self, y: np.ndarray, u: np.ndarray, k: int) -> np.ndarray:
        """Predict k rows ahead of every row of y (N, n), (N - k, n)."""
        x = y[:-k]
        for j in range(k):
            x = self._step(x, u[j : len(y) - k + j])
        return x


def polynomial(y: np.ndarray, u: np.ndarray, dt: float, choice: tuple[int, float]) -> Polynomial:
    """Identify with a library of some degree, and a threshold below which coefficients are dropped."""
    import pysindy

    degree, threshold = choice
    smooth = pysindy.SmoothedFiniteDifference(smoother_kws={"window_length": 9})
    model = pysindy.SINDy(
        optimizer=pysindy.STLSQ(threshold=threshold),
        feature_library=pysindy.PolynomialLibrary(degree=degree),
        differentiation_method=smooth,
    )
    model.fit(y, t=dt, u=u)
    powers = np.asarray(model.feature_library.powers_, int)
    start = Polynomial(powers, np.asarray(model.coefficients()), dt, y[-_LAST:].mean(axis=0))
    middle = (_LAST + 1) // 2
    for now in u[-middle:]:  # from the middle of the averaged rows to the row after the window
        start.x = start._step(start.x[None], now[None])[0]
    return start
