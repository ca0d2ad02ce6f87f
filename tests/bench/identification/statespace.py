"""What subspace packages give: x' = A x + B u, y = C x + D u, made to forecast; and the choice of its order."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg

_START_S = 3.0  # of the window's end, from which the state is found [s]
_HELD = 0.75  # share of the window on which orders are tried; the rest judges them
_MOST = 1e6


@dataclass
class StateSpace:
    """One identified axis in standardised units.

    Attributes:
        A, B, C, D: (n, n), (n, m), (l, n), (l, m)
        K: innovation gain, (n, l)
        x: state right after the window, (n,)
        ms: processor time of the identification, the choice of the order left out; 0: not yet known [ms]
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    K: np.ndarray
    x: np.ndarray
    ms: float = 0.0

    def forecast(self, u: np.ndarray) -> np.ndarray:
        """Run free under u (N, m); y (N, l), its first row right after the window."""
        x, out = self.x, np.empty((len(u), len(self.C)))
        for k, now in enumerate(u):
            out[k] = self.C @ x + self.D @ now
            x = np.clip(self.A @ x + self.B @ now, -_MOST, _MOST)
        return out

    def kstep(self, y: np.ndarray, u: np.ndarray, k: int) -> np.ndarray:
        """Filter y (N, l) from the window's end on and predict k rows ahead of every row, (N - k, l)."""
        x, filtered = self.x, np.empty((len(y), len(self.A)))
        for i, now in enumerate(u):
            x = np.clip(self.A @ x + self.B @ now + self.K @ (y[i] - self.C @ x - self.D @ now), -_MOST, _MOST)
            filtered[i] = x  # of row i + 1, knowing rows up to i
        ahead = filtered[: len(y) - k]
        for j in range(1, k):
            ahead = np.clip(ahead @ self.A.T + u[j : len(y) - k + j] @ self.B.T, -_MOST, _MOST)
        return ahead @ self.C.T + u[k:] @ self.D.T


def assembled(matrices: Iterable[np.ndarray | None], y: np.ndarray, u: np.ndarray, dt: float) -> StateSpace:
    """Take A B C D K as a package gives them (D and K may be missing) and find the state at the end of the window."""
    given = [None if each is None else np.asarray(each, float) for each in matrices]
    A, B, C = given[0], given[1], given[2]
    assert A is not None and B is not None and C is not None
    D = np.zeros((y.shape[1], u.shape[1])) if given[3] is None else given[3]
    if not all(np.isfinite(each).all() for each in (A, B, C, D)):
        raise ValueError("the model is not finite")
    model = StateSpace(A, B, C, D, np.zeros((len(A), len(C))), np.zeros(len(A)))
    n = round(_START_S / dt)
    model.x = _state(model, y[-n:], u[-n:])
    model.K = _gain(model, given[4], y, u, dt)
    return model


def _state(model: StateSpace, y: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Find the state that explains these rows best by least squares, and carry it to the row after them."""
    A, B, C, D = model.A, model.B, model.C, model.D
    rows, rest, power, x = [], [], np.eye(len(A)), np.zeros(len(A))
    for seen, now in zip(y, u, strict=True):
        rows.append(C @ power)
        rest.append(seen - C @ x - D @ now)
        power, x = A @ power, A @ x + B @ now
    return power @ np.linalg.lstsq(np.vstack(rows), np.concatenate(rest), rcond=1e-10)[0] + x


def _gain(model: StateSpace, K: np.ndarray | None, y: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
    """Keep the package's gain where it is stable; else take the Kalman gain that best foretells 1 s within the window.

    The gains tried are for noise of 10 % at y and noise of several strengths at the states.
    """
    if K is not None and np.isfinite(K).all() and np.abs(np.linalg.eigvals(model.A - K @ model.C)).max() < 1:
        return K
    k, best, least = round(1 / dt), model.K, np.inf
    to_state = np.linalg.pinv(model.C)
    for strength in (1e-4, 1e-3, 1e-2, 1e-1):
        Q = strength * (to_state @ to_state.T) + 1e-9 * np.eye(len(model.A))
        tried = replace(model, K=_kalman(model.A, model.C, Q), x=to_state @ y[0])
        e = y[k:] - tried.kstep(y, u, k)
        error = float(np.nan_to_num(np.minimum(e**2, _MOST)[k:].sum(), nan=np.inf))
        if error < least:
            best, least = tried.K, error
    return best


def _kalman(A: np.ndarray, C: np.ndarray, Q: np.ndarray) -> np.ndarray:
    R = 0.01 * np.eye(len(C))
    try:
        P = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R)
    except (np.linalg.LinAlgError, ValueError):
        return np.zeros((len(A), len(C)))
    return A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + R)


def chosen(fit: Callable, choices: Sequence, y: np.ndarray, u: np.ndarray, dt: float) -> Any:
    """Choose by the free run over the last quarter of the window, then fit once more on all of it.

    Args:
        fit: (y, u, dt, choice) -> a model with forecast; a choice at which it throws comes last
        choices: orders, or whatever the package wants decided; one alone needs no trial
        y, u: the window, standardised, (N, l), (N, m)
        dt: sample time [s]
    Returns:
        the model, with its `ms`
    """
    best = choices[0] if len(choices) == 1 else min(choices, key=lambda choice: _error(fit, choice, y, u, dt))
    began = time.process_time()
    model = fit(y, u, dt, best)
    model.ms = model.ms or 1e3 * (time.process_time() - began)
    return model


def _error(fit: Callable, choice: Any, y: np.ndarray, u: np.ndarray, dt: float) -> float:
    n = int(_HELD * len(y))
    try:
        e = fit(y[:n], u[:n], dt, choice).forecast(u[n:]) - y[n:]
    except (Exception, SystemExit):
        return np.inf
    return float(np.nan_to_num(np.minimum(e**2, _MOST).sum(), nan=np.inf))
