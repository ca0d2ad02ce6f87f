"""Quantiles of weighted scores, some left-censored (known only by an upper bound); and the risk-controlled horizon.

Source: Tibshirani et al. 2019, "Conformal prediction under covariate shift" (weights); Kaplan & Meier 1958.
"""

from collections.abc import Sequence

import numpy as np

from twin_worker.numerics.prediction_errors import AHEAD, ERROR_LIMIT


def weighted_quantile(x: np.ndarray, weight: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return a quantile of each row, interpolated between the midpoints of the cumulative weights.

    Args:
        x: values, (r, n); values of zero weight are ignored
        weight: not negative, (r, n)
        level: wanted quantiles, (r,) 0..1
    Returns:
        (r,)
    """
    order = np.argsort(np.where(weight > 0, x, np.inf), axis=1)
    x, weight = np.take_along_axis(x, order, 1), np.take_along_axis(weight, order, 1)
    total = np.cumsum(weight, axis=1)
    position = (total - 0.5 * weight) / total[:, -1:]
    n = np.maximum((weight > 0).sum(axis=1), 1)  # values of zero weight are sorted last
    right = np.clip((position < level[:, None]).sum(axis=1), 1, np.maximum(n - 1, 1))
    left, row = np.minimum(right - 1, n - 1), np.arange(len(x))
    right = np.minimum(right, n - 1)
    gap = np.maximum(position[row, right] - position[row, left], 1e-12)
    share = np.clip((level - position[row, left]) / gap, 0.0, 1.0)
    return x[row, left] + share * (x[row, right] - x[row, left])


def kaplan_meier_masses(x: np.ndarray, weight: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Return the probability mass of each exact value; the others are upper bounds (left-censored).

    Kaplan-Meier estimator from above: the weight of a bound is distributed over the values below it.

    Args:
        x: values, or upper bounds, (n,)
        weight: not negative, (n,)
        exact: whether each is a value, (n,) bool
    Returns:
        masses, 0 for bounds, (n,); if their sum is below one, the rest lies below every value
    """
    order = np.lexsort((~exact, -x))  # descending, a value before a bound of the same size
    sorted_weight, sorted_exact = weight[order], exact[order]
    at_risk = np.cumsum(sorted_weight[::-1])[::-1]
    survival_step = 1.0 - np.divide(
        sorted_weight * sorted_exact, at_risk, out=np.zeros(len(sorted_weight)), where=at_risk > 0
    )
    remaining = np.cumprod(survival_step)
    out = np.empty(len(x))
    out[order] = np.concatenate([[1.0], remaining[:-1]]) - remaining
    return out


def censored_distribution(x: np.ndarray, weight: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Return left-censored values and the probability of each, (2, n + 1); 0 has what lies below every value."""
    mass = kaplan_meier_masses(x, weight, exact)
    return np.array([np.append(x, 0.0), np.append(mass, max(1.0 - float(mass.sum()), 0.0))])


def censored_quantile(x: np.ndarray, weight: np.ndarray, exact: np.ndarray, level: float) -> float:
    """Return a quantile of left-censored values; 0 where the quantile lies below every value."""
    values, mass = censored_distribution(x, weight, exact)
    return float(weighted_quantile(values[None], mass[None], np.array([level]))[0])


Passages = Sequence[tuple[float, bool]]  # first passage of 10 % or censoring time [s], whether it is censored


def survival_curve(passages: Passages) -> tuple[np.ndarray, np.ndarray]:
    """Return times, rising, and the share still within 10 % after each of them."""
    times, censored = (np.array(column) for column in zip(*passages, strict=True))
    order = np.lexsort((censored, times))
    at_risk = len(times) - np.arange(len(times))
    return times[order], np.cumprod(1.0 - ~censored[order] / at_risk)


def survival(passages: Passages, t: float) -> float:
    """Return the share of predictions still within 10 % at `t` [s]; nan without predictions."""
    if not passages:
        return float("nan")
    times, share = survival_curve(passages)
    index = int(np.searchsorted(times, t))
    return float(share[index - 1]) if index else 1.0


def median_passage(passages: Passages) -> float:
    """Return the time at which half have exceeded 10 % [s]; the longest follow-up time where fewer did."""
    times, share = survival_curve(passages)
    half = np.flatnonzero(share <= 0.5)
    return float(times[half[0]] if len(half) else times[-1])


_POWER = 8.0  # a higher power approximates the maximum more closely
_STEP = np.gradient(np.log1p(AHEAD))


def running_max_error_ratio(half_axes: np.ndarray, predicted_length: np.ndarray) -> np.ndarray:
    """Return the running maximum of half-axes (..., n, 3) over path length (..., n), strictly rising, (..., n) [-].

    A power mean over log time approximates the running maximum without its constant stretches, on which the horizon
    would jump by minutes.
    """
    ratio = np.linalg.norm(half_axes, axis=-1) / predicted_length
    largest = np.maximum(ratio.max(axis=-1, keepdims=True), 1e-30)
    power_sum = np.cumsum((ratio / largest) ** _POWER * _STEP[: ratio.shape[-1]], axis=-1)
    return largest * power_sum ** (1.0 / _POWER)


def critical_factor(ratio: np.ndarray, followed: np.ndarray) -> np.ndarray:
    """Return the critical factor of each prediction, (m,): exact after a first passage, else an upper bound.

    A prediction that stayed within 10 % needs at most the factor that ends its horizon at the end of its follow-up. As
    a bound it carries no information on smaller factors, which are determined by difficult flights alone.

    Args:
        ratio: `running_max_error_ratio` of each prediction over `AHEAD`, (m, n) [-]
        followed: time of first passage, or follow-up time within 10 %, (m,) [s]
    """
    column = np.clip(np.searchsorted(AHEAD, followed, side="right") - 1, 0, len(AHEAD) - 2)
    fraction = np.clip((followed - AHEAD[column]) / (AHEAD[column + 1] - AHEAD[column]), 0.0, 1.0)
    row = np.arange(len(ratio))
    ratio_at_passage = ratio[row, column] + fraction * (ratio[row, column + 1] - ratio[row, column])
    return ERROR_LIMIT / np.maximum(ratio_at_passage, 1e-9)
