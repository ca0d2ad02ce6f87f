"""Detect anomalies that no effect in the catalogue explains: a changed equation or a tone.

For each channel all coefficients of its equation are freed, from any onset on, and from any onset relative to the time
before it. A correctly named effect leaves no gain; a wrong one that only resembles the cause leaves much. Single
coefficients without an effect in the catalogue compete with the named effects directly (`decision`).
"""

from collections.abc import Iterator
from copy import copy
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter

from fleet.effects import Effect, Onset, Parameter, Stage
from twin_worker.diagnosis.data.card import FaultHypothesis
from twin_worker.diagnosis.data.flight import STEP_S
from twin_worker.diagnosis.inference.isolation.isolate import (
    MIN_R2,
    PARAMETER_COST,
    Scanner,
    normal_equations,
    onset_gates,
    solve_onsets,
    with_onset_slopes,
)
from twin_worker.diagnosis.inference.isolation.refine import refine
from twin_worker.diagnosis.inference.isolation.whitened_residuals import (
    WhitenedResiduals,
    project,
    whiten_onset_slopes,
)
from twin_worker.diagnosis.model import equations as eq
from twin_worker.diagnosis.model.baseline import CHANNEL_OF, CHANNELS

_AIR_LAG_S = 4.0  # time constant of a partly blocked pressure line
_MIN_SIDE_S = 25.0  # least length of data before and after the onset
_UNCATALOGUED_TERMS = {  # terms without an effect: stability, cross damping, cross-coupled surface, moving loads
    "L": ("beta", "r", "delta_r"),
    "M": ("c_x",),
    "N": ("beta", "p", "delta_a"),
}
_SLOW, _RATE, _FORCE = "lagging", "rate", "force"  # terms of sensors: lagging pressures, scale errors
_SCALED = {  # readings of gyros and accelerometers: channel and term of their scale error
    **{f"a_{axis}": (f"gps_{axis}", _FORCE) for axis in "xyz"},
    **dict(zip("pqr", ((f"gyro_{axis}", _RATE) for axis in ("roll", "pitch", "yaw")), strict=True)),
}


def _scale(readings: dict[str, Any], share: Any, of: str) -> dict[str, Any]:
    return {of: readings[of] * (1.0 + share)}


SENSOR_SCALE = Effect(
    name="sensor_scale",
    stage=Stage.SENSOR,
    channel="imu",
    equation="reading (1 + x)",
    source="Beard & McLain 2012, section 7.1 (accelerometers and gyros)",
    parameters=(Parameter("x", "-", "relative error", step=0.05, low=-0.9, high=0.9),),
    act=_scale,
    examples=((0.1,),),
    targets=tuple(_SCALED),
)
"""Scale error of one axis: an effect outside the catalogue that changes all channels of the simulation."""


class Gain(NamedTuple):
    """Gain less the parameter cost, onset [s], and what is added to the raw residual, (n,)."""

    net: float
    t0: float
    series: np.ndarray


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
        slopes = np.transpose(list(terms.values()))
        noise = whitened.noise.of_channel(c)
        white = noise.whiten(slopes[:, None, :])[:, 0] * whitened.ok[:, None]
        norm = np.linalg.norm(white, axis=0) + 1e-12
        self._J, self._raw = (white / norm)[:, None, :], slopes / norm
        self._onset_slopes = whiten_onset_slopes(noise, slopes[:, None, :], whitened.ok) / norm
        self._whitened = copy(whitened)  # this channel alone; the nuisance information of the other channels stays
        self._whitened.e, self._whitened.Jn = whitened.e[:, [c]], whitened.Jn[:, [c]]

    def gain_of_all(self) -> Gain:
        """Return the gain of freeing all terms from the best onset."""
        return _step_gain(self._whitened, self._J, self._onset_slopes, self._raw)

    def gain_in_flight(self) -> Gain:
        """Return the gain of a step at the best onset with all terms free throughout, whatever the calibration."""
        free = _with_free_terms(self._whitened, self._J)
        return _step_gain(free, self._J, self._onset_slopes, self._raw, _MIN_SIDE_S)

    def gain_per_term(self) -> Iterator[tuple[str, Gain]]:
        """Yield the gain of freeing each single term that has no effect in the catalogue."""
        equation = next((name for name, channel in CHANNEL_OF.items() if channel == self.channel), "")
        for k, name in enumerate(self.names):
            if name in (*_UNCATALOGUED_TERMS.get(equation, ()), _SLOW):
                one = [k]
                yield (
                    name,
                    _step_gain(self._whitened, self._J[..., one], self._onset_slopes[..., one], self._raw[:, one]),
                )


def channel_equations(whitened: WhitenedResiduals) -> Iterator[ChannelEquation]:
    """Yield every sufficiently calibrated channel with the terms that may change.

    No coefficient changes where the lift is outside that of the nominal flights: the equations extrapolate there.
    """
    eq_terms = whitened.modelled.equation_terms(whitened.conditions)
    c_z, envelope = eq_terms.intermediate["c_z"], whitened.base.envelope
    inside = 1.0 if envelope is None else ((c_z >= envelope.c_z[0]) & (c_z <= envelope.c_z[1])).astype(float)
    f_x, f_y, _ = eq_terms.intermediate["f"]
    # thrust, and loads that shift under specific force
    extra_terms = {"force_x": {"thrust": eq_terms.regressors["T"][0]}, "roll": {"f_y": f_y}, "pitch": {"f_x": f_x}}
    for equation, channel in CHANNEL_OF.items():
        if whitened.base.r2.get(equation, 1.0) > MIN_R2:
            own = eq_terms.regressors[equation] * eq_terms.scale.get(equation, 1.0)
            terms = dict(zip(eq.TERMS[equation], own, strict=False)) | extra_terms.get(channel, {})
            yield ChannelEquation(whitened, channel, {name: x * inside for name, x in terms.items()})
    flow = eq_terms.flow
    constant = np.ones_like(flow.Va)
    if "Va" in whitened.modelled.flight.readings:
        yield ChannelEquation(whitened, "airspeed", {"1": constant, "Va": flow.Va, _SLOW: _lag(flow.Va)})
    if "baro" in whitened.modelled.flight.readings:
        yield ChannelEquation(whitened, "baro", {_SLOW: _lag(np.asarray(flow.h))})
    for channel, force in zip(("gps_x", "gps_y", "gps_z"), eq_terms.intermediate["f"], strict=True):
        yield ChannelEquation(whitened, channel, {"1": constant, _FORCE: force})
    for channel, rate in (("gyro_roll", flow.p), ("gyro_pitch", flow.q), ("gyro_yaw", flow.r)):
        yield ChannelEquation(whitened, channel, {"1": constant, _RATE: rate})


def _lag(x: np.ndarray) -> np.ndarray:
    """Return the difference that a first-order lag in a pressure line makes."""
    decay = np.exp(-STEP_S / _AIR_LAG_S)
    return np.asarray(lfilter([1.0 - decay], [1.0, -decay], x, zi=[decay * x[0]])[0] - x)


def _step_gain(
    whitened: WhitenedResiduals, J: np.ndarray, onset_slopes: np.ndarray, raw: np.ndarray, margin_s: float = 0.0
) -> Gain:
    """Return the gain of a step in terms, (n, 1, k), at least `margin_s` from both ends [s].

    Args:
        whitened: residuals of one channel
        J: whitened slopes of the terms; onset_slopes: the first rows of a step, (2, n, 1, k); raw: before whitening
        margin_s: least time before and after the onset [s]
    """
    t = whitened.modelled.t
    onset_rows, onsets = onset_gates(t, Onset.STEP, 1)
    sums = normal_equations(whitened, J, onset_rows, Onset.STEP)
    gain, x = solve_onsets(whitened, *with_onset_slopes(whitened, J, onset_slopes, onset_rows, sums))
    gain = np.where((t[onset_rows] > t[0] + margin_s) & (t[onset_rows] < t[-1] - margin_s), gain, 0.0)
    best = int(np.argmax(gain))
    series = raw @ x[best] * onsets[best].gate(t)
    return Gain(float(gain[best]) - PARAMETER_COST * J.shape[2], onsets[best].t0, series)


def _with_free_terms(whitened: WhitenedResiduals, J: np.ndarray) -> WhitenedResiduals:
    """Return a copy with terms, (n, 1, k), added to the nuisances, free throughout the flight."""
    out = copy(whitened)
    out.Jn = np.concatenate([whitened.Jn, J], axis=2)
    cross = project(whitened.Jn, J)
    own = project(J, J) + 1e-6 * np.eye(J.shape[2])
    out.Ann = np.block([[whitened.Ann, cross], [cross.T, own]])
    out.bn = np.concatenate([whitened.bn, -project(J, whitened.e)])
    return out


_BAND_HZ = 0.1, 1.45  # the mission is slower, the filter removes what is faster
_TONE_PARAMETERS = 3  # amplitude, phase, frequency
_OVERSAMPLING = 2.0  # oversampling of the frequency resolution
_BLOCKS, _MIN_BLOCKS = 12, 4  # tested starts; least blocks after a start


def find_tones(whitened: WhitenedResiduals) -> Iterator["Anomaly"]:
    """Yield the strongest tone of each calibrated channel, with the nuisances profiled out.

    Its gain is the peak of the periodogram, the drop of the sum of squares, less the peak that white noise of the
    remaining variance would have: 2 sigma^2 ln(tested frequencies and starts).
    """
    t = whitened.modelled.t
    ok = whitened.ok.astype(float)
    profiled = (whitened.e + np.einsum("tck,k->tc", whitened.Jn, whitened.xn)) * whitened.ok[:, None]
    frequencies = np.arange(*_BAND_HZ, 1.0 / (_OVERSAMPLING * (t[-1] - t[0])))
    starts = np.linspace(0, len(t), _BLOCKS, endpoint=False).astype(int)
    waves = np.exp(-2j * np.pi * np.outer(t, frequencies))
    for equation, channel in CHANNEL_OF.items():
        if whitened.base.r2.get(equation, 1.0) > MIN_R2:
            x = profiled[:, CHANNELS.index(channel)]
            rows = np.maximum(_tail_sums(ok, starts), 1.0)[:, None]
            drop = 2.0 * np.abs(_tail_sums(waves * x[:, None], starts)) ** 2 / rows
            rest = np.maximum(_tail_sums(x * x, starts)[:, None] - drop, 0.0) / rows
            gain = (drop - 2.0 * rest * np.log(drop.size))[:-_MIN_BLOCKS]
            start, peak = np.unravel_index(int(np.argmax(gain)), gain.shape)
            yield Anomaly(
                float(gain[start, peak]), channel, float(t[starts[start]]), "tone", parameters=_TONE_PARAMETERS
            )


def _tail_sums(x: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Sum x, (n, …), from each start to the end."""
    return np.cumsum(np.add.reduceat(x, starts, axis=0)[::-1], axis=0)[::-1]


class Anomaly(NamedTuple):
    """Gain of a change less its cost, with channel, onset [s], kind, term, and number of parameters.

    It either adds a series to the residual of its channel, or acts in the simulation like an effect, as a hypothesis.
    """

    net_gain: float
    channel: str
    t0: float
    change: str = "odd"
    term: str = ""
    series: np.ndarray | None = None
    parameters: int = 1
    hypothesis: FaultHypothesis | None = None

    @property
    def kind(self) -> str:
        """Return `change:channel:term`, the key of `Baseline.chance`."""
        return ":".join(filter(None, (self.change, self.channel, self.term)))


def find_anomalies(whitened: WhitenedResiduals) -> list[Anomaly]:
    """Return a tone, the change of the whole equation (`odd`) and its change in flight (`shift`) of every channel.

    Without a fast accelerometer the equations are too uncertain: the list is empty.

    Args:
        whitened: residuals conditioned on the effects that act beside the anomaly
    """
    if not whitened.base.vane:
        return []
    bounded = whitened.with_nuisance_priors()  # no nuisance released
    out = list(find_tones(bounded))
    for equation in channel_equations(bounded):
        for change, gain in (("odd", equation.gain_of_all()), ("shift", equation.gain_in_flight())):
            n = len(equation.names)
            out.append(Anomaly(gain.net, equation.channel, gain.t0, change, series=gain.series, parameters=n))
    return out


def find_changed_coefficients(whitened: WhitenedResiduals) -> list[Anomaly]:
    """Return the change of each single coefficient without an effect in the catalogue (`one`); empty as above."""
    if not whitened.base.vane:
        return []
    out = [
        Anomaly(gain.net, equation.channel, gain.t0, "one", name, gain.series)
        for equation in channel_equations(whitened)
        for name, gain in equation.gain_per_term()
    ]
    return [*out, *_scaled_sensors(whitened)]


def _scaled_sensors(whitened: WhitenedResiduals) -> Iterator[Anomaly]:
    """Yield the scale error of every gyro and accelerometer; the best one refined, as effects are."""
    scanned = Scanner(whitened, [(SENSOR_SCALE, reading) for reading in _SCALED]).scan(whitened)
    for scored in (*scanned, *(refine(whitened, one.hypothesis) for one in scanned[:1])):
        channel, term = _SCALED[scored.hypothesis.target]
        onset = scored.hypothesis.onset
        yield Anomaly(scored.net_gain, channel, onset.t0, "one", term, None, 1, scored.hypothesis)
