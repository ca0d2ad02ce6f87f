"""Residuals of all channels, measured less simulated, with hypotheses active in the simulation."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from math import exp
from typing import Any

import numpy as np
from scipy.signal import lfilter

from fleet.effects import ALL_SURFACES, MEMORY, SURFACES, Flow, Stage
from fleet.frames import G, rotation
from twin_worker.diagnosis.data.fault_hypothesis import Guess
from twin_worker.diagnosis.data.flight import Flight
from twin_worker.diagnosis.data.smooth import DT, STEP_S, slope, slow, smooth, thinned, whole
from twin_worker.diagnosis.model import equations as eq
from twin_worker.diagnosis.model.baseline import CHANNELS, Baseline

RHO_0 = 1.225  # [kg/m3]
_COLUMN = {"aileron": 0, "elevator": 1, "rudder": 2}
_SLOPED = ("v_n", "v_e", "v_d", "phi", "theta", "psi", "p", "q", "r")
Series = dict[str, np.ndarray]


def density(h: Any) -> Any:
    """Return the density of the standard atmosphere at height h [m], [kg/m3]."""
    return RHO_0 * np.clip(1.0 - 2.25577e-5 * h, 0.1, 2.0) ** 4.2559  # a free run may leave the atmosphere


@dataclass
class Terms:
    """Equation terms on the decimated grid: flow, regressors (k, n) and measured side (n,) by equation."""

    flow: Flow
    add: Series
    terms: Series
    measured: Series
    aside: Series
    scale: Series


class Case:
    """One flight evaluated under one baseline."""

    def __init__(self, flight: Flight, base: Baseline, like: "Case | None" = None) -> None:
        self.flight, self.base = flight, base
        if like is not None:  # same flight: reuse the filtered series
            self._smooth, self._still = like._smooth, like._still
            if like.base.timing == base.timing:
                self._delta = like._delta
        self.t = thinned(flight.t)
        self.ok = whole(flight.ok)
        self.used = thinned(np.cumsum(flight.commands[:, 3]) * DT)

    @cached_property
    def _smooth(self) -> Series:
        return self._filtered(self.flight.readings)

    @cached_property
    def _still(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self._agreement(self._smooth)

    def agreement(self, s: Series) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the quantities that only sensor faults change: rotation to body axes (3, 3, n), dV/dt less gravity in
        body axes (3, n) [m/s2], and the difference between sensors, (n, 6), channels gps_x to gyro_yaw.
        """
        return self._still if s is self._smooth else self._agreement(s)

    def _agreement(self, s: Series) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        R = rotation(s["phi"], s["theta"], s["psi"])
        derived = np.einsum("ijn,in->jn", R, np.array([s["v_n_dot"], s["v_e_dot"], s["v_d_dot"] - G]))
        out = np.zeros((len(self.t), 6))
        if "a_x" in s:
            out[:, :3] = (derived - np.array([s["a_x"], s["a_y"], s["a_z"]])).T
        out[:, 3:] = _turning(s)
        return R, derived, slow(out)

    @cached_property
    def trend(self) -> np.ndarray:
        """Fit the barometer offset from unknown sea level pressure and lapse rate, (n,) [m]."""
        h = self._smooth["h"]
        A = np.column_stack([np.ones_like(h), h - h.mean()])
        off = self._smooth["baro"] - self._smooth.get("gnss", h)
        return A @ np.linalg.lstsq(A[self.ok], off[self.ok], rcond=None)[0]

    @cached_property
    def _delta(self) -> np.ndarray:
        return np.stack([smooth(self.surface(i, ())) for i in range(4)])

    @staticmethod
    def _filtered(readings: Series) -> Series:
        out = {name: smooth(x) for name, x in readings.items()}
        out |= {f"{name}_dot": slope(readings[name]) for name in _SLOPED if name in readings}
        return out

    def surface(self, column: int, acting: Iterable[Guess]) -> np.ndarray:
        """Return one actuator output after servo faults, lag and delay: angle [rad] or throttle, on the flight grid."""
        timing = self.base.timing
        u = np.ascontiguousarray(self.flight.commands[:, column], float)
        tau = timing.engine if column == 3 else timing.servo
        for guess in acting:
            u, memory = u.copy(), np.full(MEMORY, u[0])
            par = np.asarray(guess.par)[:, None] * guess.when.gate(self.flight.t)
            if guess.effect.takes_lag:
                par[0], tau = par[0] + tau, 0.0
            guess.effect.act(u, memory, DT, np.ascontiguousarray(par))
        if tau > 1e-3:  # exact for linearly interpolated commands
            a = exp(-DT / tau)
            mean = (1 - a) * tau / DT
            b = [1 - mean, mean - a]
            u = lfilter(b, [1, -a], u, zi=[(1 - b[0]) * u[0]])[0]
        if timing.delay and column != 3:
            u = np.interp(self.flight.t - timing.delay, self.flight.t, u)
        return u if column == 3 else self.base.card.angles(column)(u)

    def sensed(self, guesses: tuple[Guess, ...]) -> Series:
        """Return the filtered readings, corrected for the hypothesised sensor faults."""
        faults = [guess for guess in guesses if guess.effect.stage is Stage.SENSOR]
        if not faults:
            return self._smooth
        readings = {"t": self.flight.t, **self.flight.readings}
        for guess in faults:
            par = [-x * guess.when.gate(self.flight.t) for x in guess.par]
            try:
                undone = guess.effect.act(readings, *par, **_of(guess))
            except KeyError:  # the flight lacks this reading: the fault has no influence
                continue
            if "Va" in undone and self.base.vane:  # the raw noise scales with the reading
                faster = guess.effect.act({**readings, "Va": readings["Va"] + 1.0}, *par, **_of(guess))
                readings["Va_share"] = readings.get("Va_share", 1.0) * (faster["Va"] - undone["Va"])
            readings |= undone
        changed = {name: x for name, x in readings.items() if x is not self.flight.readings.get(name) and name != "t"}
        return {**self._smooth, **self._filtered(changed)}

    def inputs(self, guesses: tuple[Guess, ...]) -> np.ndarray:
        """Return the actuator outputs, aileron, elevator, rudder angle [rad] and throttle, (4, n)."""
        acting = [guess for guess in guesses if guess.effect.stage is Stage.DELTA]
        if not acting:
            return self._delta
        out = self._delta.copy()
        for name in SURFACES:
            mine = [guess for guess in acting if guess.of in (name, ALL_SURFACES)]
            if mine:
                out[_COLUMN[name]] = smooth(self.surface(_COLUMN[name], mine))
        return out

    def _increments(self, flow: Flow, guesses: tuple[Guess, ...], stages: tuple[Stage, ...]) -> Series:
        total: Series = {}
        for guess in guesses:
            if guess.effect.stage in stages:
                gate = guess.when.gate(self.t)
                for name, x in guess.effect.act(flow, *(x * gate for x in guess.par), **_of(guess)).items():
                    total[name] = total.get(name, 0.0) + x
        return total

    def terms(self, guesses: tuple[Guess, ...] = ()) -> Terms:
        """Compute the terms of all equations with the hypotheses active."""
        base, body = self.base, self.base.card.body
        s, (d_a, d_e, d_r, d_t) = self.sensed(guesses), self.inputs(guesses)
        flow = Flow(self.t, s["h"], s["h"] - self.flight.ground, body, delta_t=d_t, used=self.used)
        air = self._increments(flow, guesses, (Stage.AIR,))
        R, derived, apart = self.agreement(s)
        ground = np.array(
            [s["v_n"] - air.get("w_n", 0.0), s["v_e"] - air.get("w_e", 0.0), s["v_d"] - air.get("w_d", 0.0)]
        )
        u, v, w = np.einsum("ijn,in->jn", R, ground)
        f = np.array([s["a_x"], s["a_y"], s["a_z"]]) if base.vane else derived
        Va = np.maximum(np.sqrt(u * u + v * v + w * w), 1.0)
        flow.Va, flow.alpha, flow.beta = Va, np.arctan2(w, u), np.arcsin(np.clip(v / Va, -1, 1))
        flow.p, flow.q, flow.r = s["p"], s["q"], s["r"]
        flow.rho = density(s["h"]) * (1.0 + air.get("rho", 0.0))
        flow.q_bar = 0.5 * flow.rho * Va * Va
        span, chord = body.b / (2 * Va), body.c / (2 * Va)
        p_hat, q_hat, r_hat = flow.p * span, flow.q * chord, flow.r * span
        q_S = flow.q_bar * body.S
        thrust = eq.thrust_terms(d_t, Va, flow.rho / RHO_0, base.speed)
        if "T" in base.coef:
            flow.T = base.coef["T"] @ thrust
            flow.pitch, flow.yaw = base.coef["M"][3] * d_e, base.coef["N"][5] * d_r
        c_z0 = body.mass * f[2] / q_S
        flow.C_L = -c_z0
        add = self._increments(flow, guesses, (Stage.WRENCH, Stage.MASS))
        mass = body.mass * (1.0 + add.get("mass", 0.0))
        force = mass * f
        # coefficients of the clean aircraft: remove the scaling and increments of effects first
        c_z = (force[2] / q_S + add.get("C_L", 0.0)) / (1.0 + add.get("lift", 0.0))
        c_y = (force[1] / q_S - add.get("C_Y", 0.0)) * (1.0 + add.get("side", 0.0))
        c_z_dot = np.gradient(c_z, STEP_S) * chord
        terms = {
            "alpha": eq.alpha_terms(c_z, c_z_dot, q_hat, d_e),
            "beta": eq.beta_terms(c_y, p_hat, r_hat, d_r),
            "T": thrust,
        }
        beta = base.coef["beta"] @ terms["beta"] if "beta" in base.coef else flow.beta
        terms["X"] = eq.force_terms(c_z, d_e, beta)
        terms["L"] = terms["N"] = eq.lateral_terms(beta, (p_hat, r_hat), (d_a, d_r), c_z)
        terms["M"] = eq.pitch_terms(c_z, q_hat, d_e, c_z_dot, force[0] / q_S)
        J_x, J_y, J_z, _ = base.card.inertia
        coupled = base.card.known
        measured = {
            "X": force[0],
            "L": J_x * s["p_dot"] + coupled * (J_z - J_y) * flow.q * flow.r,
            "M": J_y * s["q_dot"] + coupled * (J_x - J_z) * flow.p * flow.r,
            "N": J_z * s["r_dot"] + coupled * (J_y - J_x) * flow.p * flow.q,
            "alpha": flow.alpha,
            "beta": flow.beta,
            "airspeed": s.get("Va", np.zeros_like(Va)),
        }
        aside = {"mass": mass, "force": force, "c_z": c_z, "apart": apart, "f": f}
        aside["delta"] = np.array([d_a, d_e, d_r, d_t])
        aside["Va_share"] = s.get("Va_share", np.ones_like(Va))
        aside["baro"] = s.get("baro", s["h"]) - s.get("gnss", s["h"])
        scale = {"X": q_S, "L": q_S * body.b, "N": q_S * body.b, "M": q_S * body.c}
        return Terms(flow, add, terms, measured, aside, scale)

    def residuals(self, guesses: tuple[Guess, ...] = ()) -> np.ndarray:
        """Return measured less simulated, (n, channels)."""
        made = self.terms(guesses)
        return channels(self, made)


def channels(case: Case, made: Terms) -> np.ndarray:
    """Return the residuals of all channels from the equation terms, (n, channels)."""
    base, flow, add, aside = case.base, made.flow, made.add, made.aside
    q_S = made.scale["X"]
    T = (base.coef["T"] @ made.terms["T"]) * (1.0 + add.get("thrust", 0.0))
    alpha, beta = base.coef["alpha"] @ made.terms["alpha"], base.coef["beta"] @ made.terms["beta"]
    c_z = aside["c_z"]
    lift = add.get("lift", 0.0) * -c_z + add.get("C_L", 0.0)  # increment of effects over the clean lift coefficient
    X = q_S * (valued(base, add, "X", made.terms["X"]) + lift * np.sin(alpha) - add.get("C_D", 0.0) * np.cos(alpha)) + T
    L = made.scale["L"] * (valued(base, add, "L", made.terms["L"]) + add.get("C_l", 0.0)) + add.get("L", 0.0)
    N = made.scale["N"] * (valued(base, add, "N", made.terms["N"]) + add.get("C_n", 0.0)) + add.get("N", 0.0)
    M = (
        made.scale["M"] * (valued(base, add, "M", made.terms["M"]) + add.get("C_m", 0.0))
        + T * base.coef["M"][-1]
        + add.get("M", 0.0)
    )
    if "x_cg" in add or "y_cg" in add:
        x, y, force = add.get("x_cg", 0.0), add.get("y_cg", 0.0), aside["force"]
        # gravity acts at the centre of gravity, the aerodynamic force at an offset from it
        M, N, L = M + x * force[2], N - x * force[1] + y * force[0], L - y * force[2]
    J_x, J_y, J_z, _ = base.card.inertia
    out = np.zeros((len(case.t), len(CHANNELS)))
    out[:, 0] = (made.measured["X"] - X) / aside["mass"]
    out[:, 1] = np.degrees(made.measured["beta"] - beta)
    out[:, 2] = np.degrees(made.measured["alpha"] - alpha)
    out[:, 3] = (made.measured["L"] - L) / J_x
    out[:, 4] = (made.measured["M"] - M) / J_y
    out[:, 5] = (made.measured["N"] - N) / J_z
    readings = case.flight.readings
    if "Va" in readings:
        out[:, 6] = made.measured["airspeed"] / base.airspeed - flow.Va * np.sqrt(flow.rho / RHO_0)
        out[:, 6] /= aside["Va_share"]  # in units of the faulty sensor
    out[:, 7:13] = aside["apart"]
    if "baro" in readings:
        out[:, 13] = aside["baro"] - case.trend - add.get("baro", 0.0)
    return out


def valued(base: Baseline, add: Series, equation: str, terms: np.ndarray) -> np.ndarray:
    """Evaluate an equation, with relative errors of its derivatives from `add`, (n,)."""
    coef = base.coef[equation][: len(terms)]
    out = coef @ terms
    for k, name in enumerate(eq.TERMS[equation][: len(terms)]):
        if (share := add.get(f"{equation}:{name}")) is not None:
            out = out + share * coef[k] * terms[k]
    return out


def _turning(s: Series) -> np.ndarray:
    """Return Euler rates less those computed from the gyros, (n, 3) [rad/s]."""
    sf, cf, p, q, r = np.sin(s["phi"]), np.cos(s["phi"]), s["p"], s["q"], s["r"]
    turn = (q * sf + r * cf) / np.cos(s["theta"])
    rates = (s["phi_dot"] - p - np.sin(s["theta"]) * turn, s["theta_dot"] - (q * cf - r * sf), s["psi_dot"] - turn)
    return np.array(rates).T


def _of(guess: Guess) -> dict[str, str]:
    return {"of": guess.of} if guess.of else {}
