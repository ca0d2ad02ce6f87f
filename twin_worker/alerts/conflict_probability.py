"""Probability that two aircraft lose separation at any time of their predictions.

The errors of two aircraft are assumed independent, so the covariance of their relative position is the sum of both.
(Common wind correlates the errors and makes the true covariance smaller.) With S(t) that sum, 2 x 2 horizontally:

    distance(t) = d(t) + S(t)^(1/2) z,      z ~ N(0, I) drawn once for the whole encounter, vertical alike

and the probability is the share of 128 quasi-random draws that come within both limits at the same instant; between two
instants of the grid the motion is a straight line. For a straight encounter this is the closed form of
Source: Paielli & Erzberger 1997, "Conflict probability estimation for free flight", J. Guidance 20(3).
"""

from math import sqrt
from typing import NamedTuple

import numpy as np

from fleet.compiled_frames import assign
from fleet.physics.kernel import kernel

_CUTOFF_SIGMA = 2.0  # standard deviations beyond which a pair is rejected: probability below 0.023 [-]
_PILOT_DRAWS = 32  # draws without a hit after which the probability is taken as 0 [-]


class Separation(NamedTuple):
    """Separation minima: separation is lost when both distances are below them."""

    horizontal: float = 50.0  # [m]
    vertical: float = 20.0  # [m]


@kernel
def _closest_point(d0: float, d1: float, e0: float, e1: float) -> tuple[float, float]:
    """Return the minimum length of the vector (d, e) on the line from 0 to 1, and the position of the minimum."""
    x, y = d1 - d0, e1 - e0
    square = x * x + y * y
    s = 0.0 if square <= 0.0 else min(max(-(d0 * x + e0 * y) / square, 0.0), 1.0)
    return sqrt((d0 + s * x) ** 2 + (e0 + s * y) ** 2), s


@kernel
def _violates(r0: np.ndarray, r1: np.ndarray, horizontal: float, vertical: float) -> bool:
    """Return whether a relative position is inside both limits anywhere on the line from r0 to r1, NED (3,) [m]."""
    low, top = 0.0, 1.0
    fall = r1[2] - r0[2]
    if abs(fall) < 1e-9:
        if abs(r0[2]) >= vertical:
            return False
    else:
        a, b = (-vertical - r0[2]) / fall, (vertical - r0[2]) / fall
        low, top = max(min(a, b), 0.0), min(max(a, b), 1.0)
        if low >= top:
            return False
    x, y = r1[0] - r0[0], r1[1] - r0[1]
    n0, n1 = r0[0] + low * x, r0[0] + top * x
    e0, e1 = r0[1] + low * y, r0[1] + top * y
    return _closest_point(n0, n1, e0, e1)[0] < horizontal


@kernel
def _sqrt_covariance(nn: float, ne: float, ee: float) -> tuple[float, float, float]:
    """Return the symmetric square root of a 2 x 2 covariance."""
    s = sqrt(max(nn * ee - ne * ne, 0.0))
    t = sqrt(nn + ee + 2.0 * s)
    return (nn + s) / t, ne / t, (ee + s) / t


@kernel
def screen(
    own: int,
    others: np.ndarray,
    first: np.ndarray,
    rows: np.ndarray,
    path: np.ndarray,
    covariance: np.ndarray,
    scale: np.ndarray,
    shift: np.ndarray,
    limits: np.ndarray,
    out: np.ndarray,
) -> None:
    """Find possible conflicts of one aircraft: the others, the time, and the closest approach of the mean paths.

    Args:
        own: slot of the aircraft
        others: slots of the others, (m,)
        first, rows: first instant and number of rows of every slot [steps since 1970, -]
        path: mean paths, NED from the origin of each prediction, (slots, n, 3) [m]
        covariance: nn, ne, ee, vertical, (slots, n, 4) [m2]
        scale, shift: other's NED to own NED, one row each of `others`, (m, 3) [-, m]
        limits: horizontal and vertical, (2,) [m]
        out: filled, one row each: first and last step of the encounter (-1: none), instant of the closest approach of
            the mean paths [steps since 1970, with its fraction], its distance, its height [m]; (m, 5)
    """
    horizontal, vertical = limits[0], limits[1]
    for j in range(len(others)):
        other = others[j]
        out[j, 0] = out[j, 1] = -1.0
        start = max(first[own], first[other])
        stop = min(first[own] + rows[own], first[other] + rows[other])
        smallest = np.inf
        n0 = e0 = d0 = 0.0
        for k in range(start, stop):
            i, l = k - first[own], k - first[other]
            n1 = path[other, l, 0] * scale[j, 0] + shift[j, 0] - path[own, i, 0]
            e1 = path[other, l, 1] * scale[j, 1] + shift[j, 1] - path[own, i, 1]
            d1 = path[other, l, 2] * scale[j, 2] + shift[j, 2] - path[own, i, 2]
            if k == start:
                n0, e0, d0 = n1, e1, d1
            distance, s = _closest_point(n0, n1, e0, e1)
            height = 0.0 if d0 * d1 <= 0.0 else min(abs(d0), abs(d1))
            ratio = max(distance / horizontal, abs(d0 + s * (d1 - d0)) / vertical)
            if ratio < smallest:
                smallest = ratio
                out[j, 2] = k - 1 + s if k > start else float(k)
                out[j, 3], out[j, 4] = distance, abs(d0 + s * (d1 - d0))
            nn = covariance[own, i, 0] + covariance[other, l, 0]
            ne = covariance[own, i, 1] + covariance[other, l, 1]
            ee = covariance[own, i, 2] + covariance[other, l, 2]
            n, e = n0 + s * (n1 - n0), e0 + s * (e1 - e0)
            sigma_horizontal = (
                sqrt(max(nn * n * n + 2.0 * ne * n * e + ee * e * e, 0.0)) / distance if distance > 1e-3 else 0.0
            )
            sigma_vertical = sqrt(covariance[own, i, 3] + covariance[other, l, 3])
            if (
                distance - horizontal < _CUTOFF_SIGMA * sigma_horizontal
                and height - vertical < _CUTOFF_SIGMA * sigma_vertical
            ):
                if out[j, 0] < 0.0:
                    out[j, 0] = max(k - 1, start)
                out[j, 1] = k
            n0, e0, d0 = n1, e1, d1


@kernel
def conflict_probability(
    separation: np.ndarray, covariance: np.ndarray, draws: np.ndarray, limits: np.ndarray
) -> float:
    """Compute the probability of a loss of separation.

    Args:
        separation: other minus own mean position on the common grid, NED, (n, 3) [m]
        covariance: sum of both, nn, ne, ee, vertical, (n, 4) [m2]
        draws: normal errors, (k, 3) [-]
        limits: horizontal and vertical, (2,) [m]
    """
    n = len(separation)
    root = np.empty((n, 4))
    for i in range(n):
        root[i, 0], root[i, 1], root[i, 2] = _sqrt_covariance(covariance[i, 0], covariance[i, 1], covariance[i, 2])
        root[i, 3] = sqrt(covariance[i, 3])
    r0, r1 = np.empty(3), np.empty(3)
    hits = 0
    for k in range(len(draws)):
        if k == _PILOT_DRAWS and hits == 0:
            break
        z = draws[k]
        for i in range(n):
            r1[0] = separation[i, 0] + root[i, 0] * z[0] + root[i, 1] * z[1]
            r1[1] = separation[i, 1] + root[i, 1] * z[0] + root[i, 2] * z[1]
            r1[2] = separation[i, 2] + root[i, 3] * z[2]
            if i == 0:
                assign(r0, r1)
            if _violates(r0, r1, limits[0], limits[1]):
                hits += 1
                break
            assign(r0, r1)
    return hits / len(draws)
