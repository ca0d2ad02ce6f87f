"""Gauss-Newton descent with the damping of Marquardt.

    (H + mu diag H) dx = g

H is the information and g the downward gradient of half the cost, prior included. mu rises until the cost falls, and
falls after each step.

Source: Marquardt 1963; Ljung 1999, section 10.2.
"""

from collections.abc import Callable
from typing import TypeVar

import numpy as np

_MIN_DESCENT = 1e-3  # relative descent that ends the search [-]
_MAX_DAMPINGS = 6  # maximum damping values per step
_RAISE, _LOWER = 8.0, 5.0  # mu is multiplied by the first after a step that ascends, else divided by the second [-]
_MIN_RAISED, _MIN_LOWERED = 1e-3, 1e-6  # least mu after either [-]

Point = TypeVar("Point")


def gauss_newton(
    x: Point,
    linearise: Callable[[Point, int], tuple[float, np.ndarray, np.ndarray]],
    move: Callable[[Point, np.ndarray], tuple[Point, float]],
    *,
    steps: int,
    mu: float = 1e-3,
    converges_from: int = 0,
) -> tuple[Point, float, int]:
    """Descend from x by at most `steps` damped steps.

    Args:
        x: start
        linearise: returns cost, H (n, n) and g (n,) at a point; also receives the number of steps before it, so that it
            can update the weights of the residuals
        move: returns the point after a step dx, (n,), and its cost; not finite: diverged
        steps: maximum steps
        mu: first damping [-]
        converges_from: steps before which a small descent does not end the search
    Returns:
        the last point, its cost (not finite where the linearisation diverges), and the number of steps
    """
    cost, H, g = linearise(x, 0)
    for count in range(steps):
        if not np.isfinite(cost):
            return x, cost, count
        for _ in range(_MAX_DAMPINGS):
            candidate, candidate_cost = move(x, np.linalg.solve(H + np.diag(mu * np.diag(H)), g))
            if candidate_cost < cost:
                break
            mu = max(_RAISE * mu, _MIN_RAISED)
        else:
            return x, cost, count
        descent = cost - candidate_cost
        x, cost, mu = candidate, candidate_cost, max(mu / _LOWER, _MIN_LOWERED)
        if count >= converges_from and descent < _MIN_DESCENT * cost:
            return x, cost, count + 1
        if count < steps - 1:
            cost, H, g = linearise(x, count + 1)
    return x, cost, steps
