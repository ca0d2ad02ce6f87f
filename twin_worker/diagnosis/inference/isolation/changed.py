"""Test each channel for a changed equation: gain of freeing all its coefficients, or one, from an onset on."""

from collections.abc import Iterator
from copy import copy

import numpy as np
from scipy.signal import lfilter

from fleet.effects import Onset
from twin_worker.diagnosis.data.smooth import STEP_S
from twin_worker.diagnosis.inference.isolation.isolate import (
    MIN_R2,
    PARAMETER_COST,
    normal_equations,
    onset_gates,
    solve_onsets,
)
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals
from twin_worker.diagnosis.model import equations as eq
from twin_worker.diagnosis.model.baseline import CHANNEL_OF, CHANNELS
from twin_worker.diagnosis.model.residual import EquationTerms

_AIR_LAG_S = 4.0  # time constant of a partly blocked pressure line
_MIN_SIDE_S = 25.0  # least length of data before and after the onset
_UNCATALOGUED_TERMS = {  # terms without an effect: damping, stability, cross-coupled surface, moving loads
    "L": ("beta", "p", "r", "delta_r"),
    "M": ("q", "c_x"),
    "N": ("beta", "p", "r", "delta_a"),
}
_SLOW, _RATE = "lagging", "rate"  # sensor terms: delayed airspeed, gyro scale error
Gain = tuple[float, float]
"""Gain less the parameter cost, and onset [s]."""


class ChannelEquation:
    """Whitened regressors of one channel.

    Args:
        whitened: residuals of the flight
        channel: one of `CHANNELS`
        terms: name -> time series, (n,)
    """

    def __init__(self, whitened: WhitenedResiduals, channel: str, terms: dict[str, np.ndarray]) -> None:
        c = CHANNELS.index(channel)
        self.channel, self.names = channel, tuple(terms)
        slopes = np.zeros((len(whitened.modelled.t), len(CHANNELS), len(terms)))
        slopes[:, c] = np.transpose(list(terms.values()))
        white = whitened.noise.whiten(slopes)[:, c] * whitened.ok[:, None]
        self._J = (white / (np.linalg.norm(white, axis=0) + 1e-12))[:, None, :]
        self._whitened = copy(whitened)  # this channel alone; the nuisance information of the other channels stays
        self._whitened.e, self._whitened.Jn = whitened.e[:, [c]], whitened.Jn[:, [c]]

    def gain_of_all(self) -> Gain:
        """Return the gain of freeing all terms from the best onset."""
        return _step_gain(self._whitened, self._J)

    def gain_in_flight(self) -> Gain:
        """Return the gain of a step at the best onset with all terms free throughout, whatever the calibration."""
        return _step_gain(_with_free_terms(self._whitened, self._J), self._J, _MIN_SIDE_S)

    def gain_per_term(self) -> Iterator[tuple[str, Gain]]:
        """Yield the gain of freeing each single term that has no effect in the catalogue."""
        equation = next((name for name, channel in CHANNEL_OF.items() if channel == self.channel), "")
        for k, name in enumerate(self.names):
            if name in (*_UNCATALOGUED_TERMS.get(equation, ()), _SLOW, _RATE):
                yield name, _step_gain(self._whitened, self._J[:, :, [k]])


def channel_equations(whitened: WhitenedResiduals) -> Iterator[ChannelEquation]:
    """Yield every sufficiently calibrated channel with the terms that may change."""
    eq_terms = whitened.modelled.equation_terms(whitened.conditions)
    for equation, channel in CHANNEL_OF.items():
        if whitened.base.r2.get(equation, 1.0) > MIN_R2:
            own = eq_terms.regressors[equation] * eq_terms.scale.get(equation, 1.0)
            yield ChannelEquation(
                whitened, channel, dict(zip(eq.TERMS[equation], own, strict=False)) | _extra_terms(channel, eq_terms)
            )
    flow = eq_terms.flow
    constant = np.ones_like(flow.Va)
    if "Va" in whitened.modelled.flight.readings:
        late = _lagged(flow.Va, _AIR_LAG_S) - flow.Va
        yield ChannelEquation(whitened, "airspeed", {"1": constant, "Va": flow.Va, _SLOW: late})
    for channel, rate in (("gyro_roll", flow.p), ("gyro_pitch", flow.q), ("gyro_yaw", flow.r)):
        yield ChannelEquation(whitened, channel, {"1": constant, _RATE: rate})


def _step_gain(whitened: WhitenedResiduals, J: np.ndarray, margin_s: float = 0.0) -> Gain:
    """Return gain and onset of a step in terms, (n, 1, k), at least `margin_s` from both ends [s]."""
    t = whitened.modelled.t
    onset_rows, onsets = onset_gates(t, Onset.STEP)
    gain, _ = solve_onsets(whitened, *normal_equations(whitened, J, onset_rows, Onset.STEP))
    gain = np.where((t[onset_rows] > t[0] + margin_s) & (t[onset_rows] < t[-1] - margin_s), gain, 0.0)
    best = int(np.argmax(gain))
    return float(gain[best]) - PARAMETER_COST * J.shape[2], onsets[best].t0


def _with_free_terms(whitened: WhitenedResiduals, J: np.ndarray) -> WhitenedResiduals:
    """Return a copy with terms, (n, 1, k), added to the nuisances, free throughout the flight."""
    out = copy(whitened)
    out.Jn = np.concatenate([whitened.Jn, J], axis=2)
    cross = np.einsum("tci,tcj->ij", whitened.Jn, J)
    own = np.einsum("tci,tcj->ij", J, J) + 1e-6 * np.eye(J.shape[2])
    out.Ann = np.block([[whitened.Ann, cross], [cross.T, own]])
    out.bn = np.concatenate([whitened.bn, -np.einsum("tci,tc->i", J, whitened.e)])
    return out


def _extra_terms(channel: str, eq_terms: EquationTerms) -> dict[str, np.ndarray]:
    """Return non-aerodynamic terms of a channel: thrust, and loads that shift under specific force."""
    f_x, f_y, _ = eq_terms.intermediate["f"]
    extra = {"force_x": {"thrust": eq_terms.regressors["T"][0]}, "roll": {"f_y": f_y}, "pitch": {"f_x": f_x}}
    return extra.get(channel, {})


def _lagged(x: np.ndarray, tau: float) -> np.ndarray:
    """Filter x, (n,), by a first-order lag of time constant tau [s]."""
    decay = np.exp(-STEP_S / tau)
    out: np.ndarray = lfilter([1.0 - decay], [1.0, -decay], x, zi=[decay * x[0]])[0]
    return out
