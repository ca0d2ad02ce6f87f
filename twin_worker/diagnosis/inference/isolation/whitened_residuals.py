"""Whitened residuals of one flight with the nuisances profiled out: the cost function of all hypotheses."""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from twin_worker.diagnosis.data.card import FaultHypothesis
from twin_worker.diagnosis.inference.isolation.nuisance import (
    MAX_SPREAD_RATIO,
    RELEASE_SIGMAS,
    Nuisance,
    drift_modes,
    drift_slopes,
    list_nuisances,
)
from twin_worker.diagnosis.model.baseline import CHANNELS, Noise, wind_is_nominal
from twin_worker.diagnosis.model.envelope import TRIM, extrapolation_sigma, is_other_day
from twin_worker.diagnosis.model.residual import ModelledFlight, RecentValues

CLIP = 6.0  # clipping limit of whitened residuals [-]
_BARO_CLIP = 100.0  # for the barometer: its noise drifts, so that a lasting jump is one large whitened residual
_SCATTER_CLIP = 3.0  # the limit is at least this multiple of the channel's scatter on this flight
_N_LINEARISED = 3  # linearisations stored, shared with the parts of the flight
_MAX_RELEASED = 5  # nuisances that may be beyond their spread
_FIXED_PRECISION = 1e14  # precision of a nuisance that is fixed at zero
_MIN_SCATTER = 0.45  # least scatter relative to nominal flights
_MAX_AXIAL_SCATTER = 1.3  # largest scatter of the axial force where wind is nominal
_MAX_SCATTER = 3.0  # largest scatter of the air channels where wind is nominal
_AIR_CHANNELS = [CHANNELS.index(name) for name in ("force_x", "side", "lift", "roll", "pitch", "yaw", "airspeed")]
_AIR_CHANNELS += [CHANNELS.index(name) for name in ("gps_x", "gps_y", "gps_z")]


def project(J: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the products of slopes J, (n, c, k), and series x, (n, c) or (n, c, m), over rows and channels."""
    return J.reshape(-1, J.shape[2]).T @ x.reshape(-1, *x.shape[2:])  # type: ignore[no-any-return]


def whiten_onset_slopes(noise: Noise, J: np.ndarray, ok: np.ndarray) -> np.ndarray:
    """Whiten slopes, (n, c, k), as if the effect started at each row; return its first two rows, (2, n, c, k).

    Slowly drifting noise hides lasting changes: a step is then visible only in its first rows.

    Args:
        noise: of the channels, (c,)
        J: slopes of the residuals, (n, c, k)
        ok: valid rows, (n,); zero elsewhere
    """
    ar, sigma = noise.ar, noise.sigma[:, None]
    out = np.empty((2, *J.shape))
    out[0] = J / sigma
    out[1] = out[0]
    out[1, 1:] -= ar[:, :1] * J[:-1] / sigma
    return out * ok[None, :, None, None]


class Linearisation(NamedTuple):
    """Residuals under some conditions, and their derivatives with respect to the nuisances.

    Attributes:
        slopes: derivatives of the residuals, (n, c, nuisances)
        raw: whitened residuals, zero on rows invalid in the whole flight, (n, c)
        white_slopes: whitened derivatives, zero on the same rows, (n, c, nuisances)
    """

    slopes: np.ndarray
    raw: np.ndarray
    white_slopes: np.ndarray


class WhitenedResiduals:
    """Whitened residuals of one flight, conditioned on hypotheses.

    Args:
        modelled: the flight with its baseline
        conditions: hypotheses included in all residuals
    """

    def __init__(self, modelled: ModelledFlight, conditions: tuple[FaultHypothesis, ...] = ()) -> None:
        self.modelled, self.base = modelled, modelled.base
        ok = modelled.ok.copy()
        ok[2:] &= modelled.ok[1:-1] & modelled.ok[:-2]
        ok[:2] = False
        self.ok = ok
        self.noise = self._scaled_noise()
        self.wind_nominal = wind_is_nominal(self.base)
        self.nuisances: tuple[Nuisance, ...] = list_nuisances(self.base.vane)
        self._extrapolation = extrapolation_sigma(self.base, modelled.flight)
        self._other_day = is_other_day(self.base, modelled.flight)
        self.drift_modes = drift_modes(self.base.vane)
        self.clip = np.full(len(CHANNELS), CLIP)
        if self.base.vane:
            self.clip[CHANNELS.index("baro")] = _BARO_CLIP
        self.conditions = conditions
        self._flight_ok = ok
        self._linearisations: RecentValues[Linearisation] = RecentValues(_N_LINEARISED)
        self._varied = [modelled.with_base(self.base.varied(k)) for k in range(len(self.base.others))]
        if self.ok.any():
            scatter = 1.4826 * np.median(np.abs(self.residuals(())[self.ok]), axis=0)
            self.clip = np.maximum(self.clip, _SCATTER_CLIP * scatter)
        self._inverse: tuple[np.ndarray, np.ndarray] | None = None  # a normal matrix and its inverse
        self._by_channel: tuple[np.ndarray, np.ndarray] | None = None  # slopes, (n, c, k), and the same, (c, n, k)
        self._update()

    @property
    def nuisance_covariance(self) -> np.ndarray:
        """Return the inverse of the normal matrix of the nuisances, computed once per matrix."""
        if self._inverse is None or self._inverse[0] is not self.Ann:
            self._inverse = self.Ann, np.linalg.inv(self.Ann)
        return self._inverse[1]

    def project_nuisances(self, e: np.ndarray) -> np.ndarray:
        """Return the products of the nuisance slopes and whitened residuals, (n, c), over rows and channels, (k,).

        A hypothesis changes few channels, and those only after its onset: the products of the others are known.
        """
        if self._by_channel is None or self._by_channel[0] is not self.Jn:
            self._by_channel = self.Jn, np.ascontiguousarray(np.swapaxes(self.Jn, 0, 1))
        slopes, change = self._by_channel[1], np.ascontiguousarray((e - self.e).T)
        out = -self.bn
        for c in np.flatnonzero(change.any(axis=1)):
            first = int((change[c] != 0.0).argmax())
            out += change[c, first:] @ slopes[c, first:]
        return np.asarray(out)

    def part(self, span: np.ndarray) -> "WhitenedResiduals":
        """Return a copy restricted to the rows of `span`, (n,) bool."""
        out = copy(self)
        out.ok = self.ok & span
        out.raw, out.e = self.raw * out.ok[:, None], self.e * out.ok[:, None]
        out.Jn = self.Jn * out.ok[:, None, None]
        out._profile()
        return out

    def _scaled_noise(self) -> Noise:
        """Scale the noise to the scatter of this flight: down for all channels, up only where wind is nominal."""
        noise = self.base.noise
        e = noise.whiten(self.modelled.residuals())[self.ok]
        if not len(e):
            return noise
        scatter = 1.4826 * np.median(np.abs(e - np.median(e, axis=0)), axis=0)
        highest = np.ones(len(CHANNELS))
        if wind_is_nominal(self.base):
            highest[_AIR_CHANNELS] = _MAX_SCATTER
            if self.base.vane:  # gusts hardly affect the axial force; engine surges do
                highest[CHANNELS.index("force_x")] = _MAX_AXIAL_SCATTER
        return replace(noise, sigma=noise.sigma * np.clip(scatter, _MIN_SCATTER, highest))

    def residuals(self, hypotheses: Sequence[FaultHypothesis], modelled: ModelledFlight | None = None) -> np.ndarray:
        """Return whitened residuals with the conditions and these hypotheses, zero on invalid rows, (n, c)."""
        e = self.noise.whiten((modelled or self.modelled).residuals((*self.conditions, *hypotheses)))
        e[~self.ok] = 0.0
        return e

    def clipped(self, hypotheses: Sequence[FaultHypothesis]) -> np.ndarray:
        """Return `residuals` limited to `clip`, (n, c)."""
        e = self.residuals(hypotheses)
        return np.minimum(np.maximum(e, -self.clip, out=e), self.clip, out=e)

    def condition_on(self, conditions: tuple[FaultHypothesis, ...]) -> None:
        """Set the hypotheses that all following residuals include."""
        if conditions != self.conditions:
            self.conditions = conditions
            self._update()

    def conditioned(self, conditions: tuple[FaultHypothesis, ...]) -> "WhitenedResiduals":
        """Return a copy with further conditions, with the slopes and the precision of the nuisances as they are."""
        out = copy(self)
        out.conditions = (*self.conditions, *conditions)
        out.raw = out.residuals(())
        out.e = np.clip(out.raw, -out.clip, out.clip)
        out.bn = -self.project_nuisances(out.e)
        out.xn = np.linalg.solve(out.Ann, out.bn)
        return out

    def _update(self) -> None:
        """Compute residuals and nuisance slopes under the current conditions."""
        _, raw, white_slopes = self.linearisation()
        if self.ok is self._flight_ok:
            self.raw, self.Jn = raw, white_slopes
        else:
            self.raw, self.Jn = raw * self.ok[:, None], white_slopes * self.ok[:, None, None]
        self.e = np.clip(self.raw, -self.clip, self.clip)
        self._profile()

    def linearisation(self) -> Linearisation:
        """Return the linearisation of the whole flight under the current conditions; recent ones are reused."""
        return self._linearisations.get(self.conditions, self._linearise)

    def _linearise(self) -> Linearisation:
        modelled, conditions = self.modelled, self.conditions
        reference = modelled.residuals(conditions)
        moved = [(modelled.residuals((*conditions, n.hypothesis(n.step))), n.step) for n in self.nuisances]
        own = np.stack([(x - reference) / step for x, step in moved], axis=2)
        changes = [varied.residuals(conditions) - reference for varied in self._varied]
        others = np.stack(changes, axis=2) if changes else np.empty((*reference.shape, 0))
        raw, ok = self.noise.whiten(reference), self._flight_ok
        raw[~ok] = 0.0
        slopes, white_slopes = (
            np.concatenate([x, drift_slopes(x, self.drift_modes, modelled.t), y], axis=2)
            for x, y in ((own, others), (self.noise.whiten(own), self.noise.whiten(others)))
        )
        white_slopes[~ok] = 0.0
        return Linearisation(slopes, raw, white_slopes)

    def _profile(self) -> None:
        """Estimate the nuisances; fix those beyond their spread at zero, so that hypotheses explain them."""
        extra = np.ones(len(self.base.others))
        drift_spreads = np.array([self.base.spread.get(mode.name, mode.floor) for mode in self.drift_modes])
        self.precision = np.array([*(1.0 / self.spread(n) ** 2 for n in self.nuisances), *drift_spreads**-2.0, *extra])
        self.prior_precision = self.precision.copy()
        free = np.array([n.is_unbounded or (self.wind_nominal and n.is_wind) for n in self.nuisances])
        free = np.concatenate([free, np.zeros(len(drift_spreads) + len(extra), bool)])
        limits = [n.release_sigmas for n in self.nuisances]  # in spreads
        limits += [limits[mode.nuisance_index] for mode in self.drift_modes] + len(extra) * [RELEASE_SIGMAS]
        flat = self.Jn.reshape(-1, self.Jn.shape[2])
        G, self.bn = flat.T @ flat, -flat.T @ self.e.ravel()
        self.Ann = G + np.diag(self.precision)
        self.xn = np.linalg.solve(self.Ann, self.bn)
        for _ in range(_MAX_RELEASED):
            unreleased = self.precision < 0.1 * _FIXED_PRECISION
            excess = np.abs(self.xn) * np.sqrt(self.precision) * unreleased * ~free / np.array(limits)
            worst = int(np.argmax(excess))
            if excess[worst] < 1.0:
                break
            self.precision[worst] = _FIXED_PRECISION
            self.Ann = G + np.diag(self.precision)
            self.xn = np.linalg.solve(self.Ann, self.bn)

    def with_nuisance_priors(self) -> "WhitenedResiduals":
        """Return a copy in which every nuisance has its prior spread and none is fixed at zero."""
        out = copy(self)
        out.Ann = self.Ann - np.diag(self.precision) + np.diag(self.prior_precision)
        out.xn = np.linalg.solve(out.Ann, self.bn)
        return out

    def spread(self, n: Nuisance) -> float:
        """Return the standard deviation of a nuisance on this flight, wider outside the calibrated envelope."""
        spread = self.base.spread.get(n.name, n.floor)
        if self.wind_nominal and n.effect.name == "wind_steady":
            spread = max(spread, 2.5)
        if self._other_day and n.name in TRIM:
            spread = max(spread, MAX_SPREAD_RATIO * n.floor)
        return float(np.hypot(spread, self._extrapolation.get(n.name, 0.0)))

    def cost(self, hypotheses: Sequence[FaultHypothesis]) -> float:
        """Return the sum of squares with these hypotheses, the nuisances profiled out."""
        e = self.clipped(hypotheses)
        b = self.project_nuisances(e)
        return float((e * e).sum() - b @ self.nuisance_covariance @ b)

    def channel_cost(self, hypotheses: Sequence[FaultHypothesis]) -> np.ndarray:
        """Return the sum of squares of each channel with these hypotheses, the nuisances profiled out, (c,)."""
        e = self.clipped(hypotheses)
        profiled = e - self.Jn @ (self.nuisance_covariance @ self.project_nuisances(e))
        return np.asarray((profiled * profiled).sum(axis=0))

    def slopes(self, hypothesis: FaultHypothesis, step: np.ndarray) -> np.ndarray:
        """Return the derivative of the whitened residuals with respect to the parameters of a hypothesis, (n, c, k)."""
        return self.whiten_slopes(self.residual_slopes(hypothesis, step))

    def whiten_slopes(self, J: np.ndarray) -> np.ndarray:
        """Whiten slopes of the residuals, (n, c, k)."""
        return self.noise.whiten(J) * self.ok[:, None, None]

    def whiten_onset_slopes(self, J: np.ndarray) -> np.ndarray:
        """Return `whiten_onset_slopes` of slopes of the residuals, (n, c, k), on the valid rows, (2, n, c, k)."""
        return whiten_onset_slopes(self.noise, J, self.ok)

    def residual_slopes(self, hypothesis: FaultHypothesis, step: np.ndarray) -> np.ndarray:
        """Return the derivative of the raw residuals with respect to the parameters of a hypothesis, (n, c, k)."""
        acting = any(hypothesis.par) or hypothesis.effect.takes_lag  # otherwise it changes nothing
        reference = self.modelled.residuals((*self.conditions, hypothesis) if acting else self.conditions)
        out = []
        for k, h in enumerate(step):
            par = np.array(hypothesis.par)
            moved = hypothesis.with_parameters(par + h * np.eye(len(par))[k])
            h = moved.par[k] - par[k]
            if not h:  # at the upper bound
                moved = hypothesis.with_parameters(par - step[k] * np.eye(len(par))[k])
                h = moved.par[k] - par[k]
            out.append((self.modelled.residuals((*self.conditions, moved)) - reference) / (h or 1.0))
        return np.stack(out, axis=2)

    def mean_square(self) -> np.ndarray:
        """Return the mean square of each whitened channel, the nuisances profiled out, (c,)."""
        e = self.e + self.Jn @ self.xn
        return (e[self.ok] ** 2).mean(axis=0) if self.ok.any() else np.zeros(len(CHANNELS))
