"""Test each channel for a changed equation: gain of freeing all its coefficients, or one, from an onset on."""

from collections.abc import Iterator
from copy import copy

import numpy as np
from scipy.signal import lfilter

from fleet.effects import Onset
from twin_worker.diagnosis.data.smooth import STEP_S
from twin_worker.diagnosis.inference.isolation.isolate import PRICE, WELL, gates_of, normals, solved
from twin_worker.diagnosis.inference.isolation.whitened_residuals import Sight
from twin_worker.diagnosis.model import equations as eq
from twin_worker.diagnosis.model.baseline import CHANNELS, SHOWN_BY
from twin_worker.diagnosis.model.residual import Terms

_AIR_LAG_S = 4.0  # time constant of a partly blocked pressure line
_APART_S = 25.0  # least length of data before and after the onset
_NOBODYS = {  # terms without an effect: damping, stability, cross-coupled surface, moving loads
    "L": ("beta", "p", "r", "delta_r"),
    "M": ("q", "c_x"),
    "N": ("beta", "p", "r", "delta_a"),
}
_SLOW, _RATE = "lagging", "rate"  # sensor terms: delayed airspeed, gyro scale error
Gain = tuple[float, float]
"""Gain less the parameter cost, and onset [s]."""


class Equation:
    """Whitened regressors of one channel.

    Args:
        whitened: residuals of the flight
        channel: one of `CHANNELS`
        terms: name -> time series, (n,)
    """

    def __init__(self, sight: Sight, channel: str, terms: dict[str, np.ndarray]) -> None:
        c = CHANNELS.index(channel)
        self.channel, self.names = channel, tuple(terms)
        laid = np.zeros((len(sight.case.t), len(CHANNELS), len(terms)))
        laid[:, c] = np.transpose(list(terms.values()))
        white = sight.noise.whiten(laid)[:, c] * sight.ok[:, None]
        self._J = (white / (np.linalg.norm(white, axis=0) + 1e-12))[:, None, :]
        self._sight = copy(sight)  # this channel alone; the nuisance information of the other channels stays
        self._sight.e, self._sight.Jn = sight.e[:, [c]], sight.Jn[:, [c]]

    def all_of_it(self) -> Gain:
        """Return the gain of freeing all terms from the best onset."""
        return _since(self._sight, self._J)

    def in_flight(self) -> Gain:
        """Return the gain of a step at the best onset with all terms free throughout, whatever the calibration."""
        return _since(_freed(self._sight, self._J), self._J, _APART_S)

    def one_by_one(self) -> Iterator[tuple[str, Gain]]:
        """Yield the gain of freeing each single term that has no effect in the catalogue."""
        equation = next((name for name, channel in SHOWN_BY.items() if channel == self.channel), "")
        for k, name in enumerate(self.names):
            if name in (*_NOBODYS.get(equation, ()), _SLOW, _RATE):
                yield name, _since(self._sight, self._J[:, :, [k]])


def equations_of(sight: Sight) -> Iterator[Equation]:
    """Yield every sufficiently calibrated channel with the terms that may change."""
    made = sight.case.terms(sight.granted)
    for equation, channel in SHOWN_BY.items():
        if sight.base.r2.get(equation, 1.0) > WELL:
            own = made.terms[equation] * made.scale.get(equation, 1.0)
            yield Equation(sight, channel, dict(zip(eq.TERMS[equation], own, strict=False)) | _more(channel, made))
    flow = made.flow
    even = np.ones_like(flow.Va)
    if "Va" in sight.case.flight.readings:
        late = _lagged(flow.Va, _AIR_LAG_S) - flow.Va
        yield Equation(sight, "airspeed", {"1": even, "Va": flow.Va, _SLOW: late})
    for channel, rate in (("gyro_roll", flow.p), ("gyro_pitch", flow.q), ("gyro_yaw", flow.r)):
        yield Equation(sight, channel, {"1": even, _RATE: rate})


def _since(sight: Sight, J: np.ndarray, apart_s: float = 0.0) -> Gain:
    """Return gain and onset of a step in terms, (n, 1, k), at least `margin_s` from both ends [s]."""
    t = sight.case.t
    rows, whens = gates_of(t, Onset.STEP)
    gain, _ = solved(sight, *normals(sight, J, rows, Onset.STEP))
    gain = np.where((t[rows] > t[0] + apart_s) & (t[rows] < t[-1] - apart_s), gain, 0.0)
    best = int(np.argmax(gain))
    return float(gain[best]) - PRICE * J.shape[2], whens[best].t0


def _freed(sight: Sight, J: np.ndarray) -> Sight:
    """Return a copy with terms, (n, 1, k), added to the nuisances, free throughout the flight."""
    out = copy(sight)
    out.Jn = np.concatenate([sight.Jn, J], axis=2)
    between = np.einsum("tci,tcj->ij", sight.Jn, J)
    own = np.einsum("tci,tcj->ij", J, J) + 1e-6 * np.eye(J.shape[2])
    out.Ann = np.block([[sight.Ann, between], [between.T, own]])
    out.bn = np.concatenate([sight.bn, -np.einsum("tci,tc->i", J, sight.e)])
    return out


def _more(channel: str, made: Terms) -> dict[str, np.ndarray]:
    """Return non-aerodynamic terms of a channel: thrust, and loads that shift under specific force."""
    f_x, f_y, _ = made.aside["f"]
    more = {"force_x": {"thrust": made.terms["T"][0]}, "roll": {"f_y": f_y}, "pitch": {"f_x": f_x}}
    return more.get(channel, {})


def _lagged(x: np.ndarray, tau: float) -> np.ndarray:
    """Filter x, (n,), by a first-order lag of time constant tau [s]."""
    kept = np.exp(-STEP_S / tau)
    out: np.ndarray = lfilter([1.0 - kept], [1.0, -kept], x, zi=[kept * x[0]])[0]
    return out
