"""Confidence horizon: the look-ahead at which the error ratio times a calibrated factor exceeds 10 % of the path.

The factor is chosen so that at most 1 - `NOMINAL_COVERAGE` of predictions exceed 10 % before their horizon. The
critical factor of a prediction is the smallest that ends its horizon before its first passage; the calibrated factor
is a quantile of the critical factors. Most predictions never exceed 10 %, so only an upper bound of theirs is known.

Source: Angelopoulos et al. 2024, "Conformal risk control" (the loss falls as the factor grows); Candes, Lei & Ren
2023, "Conformalized survival analysis" (censored predictions).
"""

import numpy as np

from twin_worker.numerics.prediction_errors import AHEAD, ERROR_LIMIT

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
