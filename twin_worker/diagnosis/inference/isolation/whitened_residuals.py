"""Whitened residuals of one flight with the nuisances profiled out: the cost function of all hypotheses."""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from twin_worker.diagnosis.data.fault_hypothesis import Guess
from twin_worker.diagnosis.inference.isolation.nuisance import (
    RELEASED,
    Nuisance,
    nuisances,
    wandering,
    wanders,
)
from twin_worker.diagnosis.model.baseline import CHANNELS, is_weather
from twin_worker.diagnosis.model.residual import Case

CLIP = 6.0  # clipping limit of whitened residuals [-]
_JUMPS = 100.0  # for the barometer: its noise drifts, so that a lasting jump is one large whitened residual
_WIDE = 3.0  # the limit is at least this multiple of the channel's scatter on this flight
_TIGHT = 1e14  # precision of a nuisance that is fixed at zero
_QUIETEST = 0.45  # least scatter relative to nominal flights
_SURGE = 1.3  # largest scatter of the axial force where wind is nominal
_LOUDEST = 3.0  # largest scatter of the air channels where wind is nominal
_AIR = [CHANNELS.index(name) for name in ("force_x", "side", "lift", "roll", "pitch", "yaw", "airspeed")]
_AIR += [CHANNELS.index(name) for name in ("gps_x", "gps_y", "gps_z")]


class Sight:
    """Whitened residuals of one flight, conditioned on hypotheses.

    Args:
        modelled: the flight with its baseline
        conditions: hypotheses included in all residuals
    """

    def __init__(self, case: Case, granted: tuple[Guess, ...] = ()) -> None:
        self.case, self.base = case, case.base
        ok = case.ok.copy()
        ok[2:] &= case.ok[1:-1] & case.ok[:-2]
        ok[:2] = False
        self.ok = ok
        self.noise = self._scaled()
        self.weather = is_weather(self.base)
        self.nuisances: tuple[Nuisance, ...] = nuisances(self.base.vane)
        self.wanders = wanders(self.nuisances, self.base.vane)
        self.clip = np.full(len(CHANNELS), CLIP)
        if self.base.vane:
            self.clip[CHANNELS.index("baro")] = _JUMPS
        self.granted = granted
        if self.ok.any():
            scatter = 1.4826 * np.median(np.abs(self.whitened(())[self.ok]), axis=0)
            self.clip = np.maximum(self.clip, _WIDE * scatter)
        self._lay()

    def part(self, span: np.ndarray) -> "Sight":
        """Return a copy restricted to the rows of `span`, (n,) bool."""
        out = copy(self)
        out.ok = self.ok & span
        out.raw, out.e = self.raw * out.ok[:, None], self.e * out.ok[:, None]
        out.Jn = self.Jn * out.ok[:, None, None]
        out._profile()
        return out

    def _scaled(self):  # type: ignore[no-untyped-def]
        """Scale the noise to the scatter of this flight: down for all channels, up only where wind is nominal."""
        noise = self.base.noise
        e = noise.whiten(self.case.residuals())[self.ok]
        if not len(e):
            return noise
        scatter = 1.4826 * np.median(np.abs(e - np.median(e, axis=0)), axis=0)
        highest = np.ones(len(CHANNELS))
        if is_weather(self.base):
            highest[_AIR] = _LOUDEST
            if self.base.vane:  # gusts hardly affect the axial force; engine surges do
                highest[CHANNELS.index("force_x")] = _SURGE
        return replace(noise, sigma=noise.sigma * np.clip(scatter, _QUIETEST, highest))

    def whitened(self, guesses: Sequence[Guess]) -> np.ndarray:
        """Return whitened residuals with the conditions and these hypotheses, zero on invalid rows, (n, c)."""
        return self._white(self.case, guesses)

    def _white(self, case: Case, guesses: Sequence[Guess]) -> np.ndarray:
        e = self.noise.whiten(case.residuals((*self.granted, *guesses)))
        e[~self.ok] = 0.0
        return e

    def clipped(self, guesses: Sequence[Guess]) -> np.ndarray:
        """Return `residuals` limited to `clip`, (n, c)."""
        return np.clip(self.whitened(guesses), -self.clip, self.clip)

    def grant(self, granted: tuple[Guess, ...]) -> None:
        """Set the hypotheses that all following residuals include."""
        if granted != self.granted:
            self.granted = granted
            self._lay()

    def _lay(self) -> None:
        """Compute residuals and nuisance slopes under the current conditions."""
        self.raw = self.whitened(())
        self.e = np.clip(self.raw, -self.clip, self.clip)
        steps = [self.whitened((n.guess(n.step),)) for n in self.nuisances]
        own = np.stack([(e - self.raw) / n.step for e, n in zip(steps, self.nuisances, strict=True)], axis=2)
        others = [self._varied(k)[:, :, None] - self.raw[:, :, None] for k in range(len(self.base.others))]
        self.Jn = np.concatenate([own, wandering(own, self.wanders, self.case.t), *others], axis=2)
        self._profile()

    def _varied(self, k: int) -> np.ndarray:
        """Return the whitened residuals under the k-th varied coefficients, (n, c)."""
        return self._white(Case(self.case.flight, self.base.varied(k), like=self.case), ())

    def _profile(self) -> None:
        """Estimate the nuisances; fix those beyond their spread at zero, so that hypotheses explain them."""
        more = np.ones(len(self.base.others))
        slow = np.array([self.base.spread.get(one.name, one.floor) for one in self.wanders])
        self.precision = np.array([*(1.0 / self._spread(n) ** 2 for n in self.nuisances), *slow**-2.0, *more])
        self.usual = self.precision.copy()
        free = np.array([n.scatter or (self.weather and n.weather) for n in self.nuisances])
        free = np.concatenate([free, np.zeros(len(slow) + len(more), bool)])
        flat = self.Jn.reshape(-1, self.Jn.shape[2])
        G, self.bn = flat.T @ flat, -flat.T @ self.e.ravel()
        for _ in range(6):
            self.Ann = G + np.diag(self.precision)
            self.xn = np.linalg.solve(self.Ann, self.bn)
            held = self.precision < 0.1 * _TIGHT
            past = np.abs(self.xn) * np.sqrt(self.precision) * held * ~free / self._bounds(len(more))
            worst = int(np.argmax(past))
            if past[worst] < 1.0:
                break
            self.precision[worst] = _TIGHT

    def held(self) -> "Sight":
        """Return a copy in which every nuisance has its prior spread and none is fixed at zero."""
        out = copy(self)
        out.Ann = self.Ann - np.diag(self.precision) + np.diag(self.usual)
        out.xn = np.linalg.solve(out.Ann, self.bn)
        return out

    def _bounds(self, more: int) -> np.ndarray:
        """Return the number of spreads at which each nuisance is released, (nuisances + drift modes + n_extra,)."""
        own = [n.released for n in self.nuisances]
        return np.array([*own, *(own[one.of] for one in self.wanders), *more * [RELEASED]])

    def _spread(self, n: Nuisance) -> float:
        spread = self.base.spread.get(n.name, n.floor)
        return max(spread, 2.5) if self.weather and n.effect.name == "wind_steady" else spread

    def cost(self, guesses: Sequence[Guess]) -> float:
        """Return the sum of squares with these hypotheses, the nuisances profiled out."""
        return self.cost_of(self.clipped(guesses))

    def cost_of(self, e: np.ndarray) -> float:
        """Return the sum of squares of whitened residuals, the nuisances profiled out."""
        b = -np.einsum("tci,tc->i", self.Jn, e)
        return float((e * e).sum() - b @ np.linalg.solve(self.Ann, b))

    def powers(self, guesses: Sequence[Guess]) -> np.ndarray:
        """Return the sum of squares of each channel with these hypotheses, the nuisances profiled out, (c,)."""
        e = self.clipped(guesses)
        left = e - self.Jn @ np.linalg.solve(self.Ann, np.einsum("tci,tc->i", self.Jn, e))
        return np.asarray((left * left).sum(axis=0))

    def slopes(self, guess: Guess, step: np.ndarray) -> np.ndarray:
        """Return the derivative of the whitened residuals with respect to the parameters of a hypothesis, (n, c, k)."""
        return self.whole(self.plain_slopes(guess, step))

    def whole(self, J: np.ndarray) -> np.ndarray:
        """Whiten slopes of the residuals, (n, c, k)."""
        return self.noise.whiten(J) * self.ok[:, None, None]

    def begun(self, J: np.ndarray) -> np.ndarray:
        """Whiten slopes, (n, c, k), as if the effect started at each row; return its first two rows, (2, n, c, k).

        Slowly drifting noise hides lasting changes: a step is then visible only in its first rows.
        """
        ar, sigma = self.noise.ar, self.noise.sigma[:, None]
        first, second = J / sigma, J / sigma
        second[1:] -= ar[:, :1] * J[:-1] / sigma
        return np.stack([first, second]) * self.ok[None, :, None, None]

    def plain_slopes(self, guess: Guess, step: np.ndarray) -> np.ndarray:
        """Return the derivative of the raw residuals with respect to the parameters of a hypothesis, (n, c, k)."""
        here = self.case.residuals((*self.granted, guess))
        out = []
        for k, h in enumerate(step):
            par = np.array(guess.par)
            moved = guess.at(par + h * np.eye(len(par))[k])
            h = moved.par[k] - par[k]
            if not h:  # at the upper bound
                moved = guess.at(par - step[k] * np.eye(len(par))[k])
                h = moved.par[k] - par[k]
            out.append((self.case.residuals((*self.granted, moved)) - here) / (h or 1.0))
        return np.stack(out, axis=2)

    def left(self) -> np.ndarray:
        """Return the mean square of each whitened channel, the nuisances profiled out, (c,)."""
        e = self.e + self.Jn @ self.xn
        return (e[self.ok] ** 2).mean(axis=0) if self.ok.any() else np.zeros(len(CHANNELS))
