"""Residuals of all channels, measured less simulated, with hypotheses active in the simulation."""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from math import exp
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from scipy.signal import lfilter

from fleet.effects import ALL_SURFACES, MEMORY, SURFACES, Flow, Stage
from fleet.frames import G, rotation
from twin_worker.diagnosis.data.card import FaultHypothesis
from twin_worker.diagnosis.data.flight import DT, STEP_S, FlightData, decimated, slope, slow, smooth, valid_decimated
from twin_worker.diagnosis.model import equations as eq
from twin_worker.diagnosis.model.baseline import CHANNELS, Baseline

_DIFFERENTIATED = ("v_n", "v_e", "v_d", "phi", "theta", "psi", "p", "q", "r")
_NOT_COMPARED = ("h", "Va", "baro", "gnss", "low", "slow")  # readings without influence on the channels gps and gyro
_FLOW_STAGES = (Stage.SENSOR, Stage.DELTA, Stage.AIR)
_ROLL_DAMPING = eq.LATERAL.index("p")
_N_RECENT = 6  # results stored for repeated evaluations
Signals = dict[str, np.ndarray]
Value = TypeVar("Value")


@dataclass
class EquationTerms:
    """Equation terms on the decimated grid: flow, regressors (k, n) and measured side (n,) by equation."""

    modelled: "ModelledFlight"
    flow: Flow
    add: Signals
    regressors: Signals
    measured: Signals
    intermediate: Signals
    scale: Signals


class FlowTerms(NamedTuple):
    """Terms that effects on forces, moments and mass leave unchanged; fields as in `EquationTerms`."""

    flow: Flow
    thrust: np.ndarray
    measured: Signals
    intermediate: Signals
    scale: Signals


class RecentValues(Generic[Value]):
    """Values of the last few sets of hypotheses, found by comparison: effects are not hashable."""

    def __init__(self, n: int = _N_RECENT) -> None:
        self._entries: deque[tuple[tuple[FaultHypothesis, ...], Value]] = deque(maxlen=n)

    def get(self, hypotheses: tuple[FaultHypothesis, ...], compute: Callable[[], Value]) -> Value:
        """Return the value of these hypotheses, computed if it is not among the last few."""
        for entry, value in self._entries:
            if entry is hypotheses or entry == hypotheses:
                return value
        value = compute()
        self._entries.appendleft((hypotheses, value))
        return value


class ModelledFlight:
    """One flight evaluated under one baseline."""

    def __init__(self, flight: FlightData, base: Baseline, template: "ModelledFlight | None" = None) -> None:
        self.flight, self.base = flight, base
        if template is not None:  # same flight: reuse the filtered series
            self._smooth, self._sensor_agreement = template._smooth, template._sensor_agreement
            if template.base.timing == base.timing:
                self._delta = template._delta
        self.t = decimated(flight.t)
        self.ok = valid_decimated(flight.ok)
        self.throttle_integral = decimated(np.cumsum(flight.commands[:, 3]) * DT)
        self._zeros = np.zeros(len(self.t))
        self._recent_flow: RecentValues[FlowTerms] = RecentValues()
        self._recent_residuals: RecentValues[np.ndarray] = RecentValues()

    def with_base(self, base: Baseline) -> "ModelledFlight":
        """Return the same flight under another baseline."""
        return ModelledFlight(self.flight, base, template=self)

    @cached_property
    def _smooth(self) -> Signals:
        return self._filtered(self.flight.readings)

    @cached_property
    def _sensor_agreement(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self._agreement(self._smooth)

    def _agreement(self, s: Signals) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the quantities that only sensor faults change: rotation to body axes (3, 3, n), dV/dt less gravity in
        body axes (3, n) [m/s2], and the difference between sensors, (n, 6), channels gps_x to gyro_yaw.
        """
        R = rotation(s["phi"], s["theta"], s["psi"])
        derived = np.einsum("ijn,in->jn", R, np.array([s["v_n_dot"], s["v_e_dot"], s["v_d_dot"] - G]))
        out = np.zeros((len(self.t), 6))
        if "a_x" in s:
            out[:, :3] = (derived - np.array([s["a_x"], s["a_y"], s["a_z"]])).T
        sf, cf, p, q, r = np.sin(s["phi"]), np.cos(s["phi"]), s["p"], s["q"], s["r"]
        turn = (q * sf + r * cf) / np.cos(s["theta"])
        out[:, 3] = s["phi_dot"] - p - np.sin(s["theta"]) * turn
        out[:, 4] = s["theta_dot"] - (q * cf - r * sf)
        out[:, 5] = s["psi_dot"] - turn
        return R, derived, slow(out)

    @cached_property
    def baro_offset(self) -> np.ndarray:
        """Fit the barometer offset from unknown sea level pressure and lapse rate, (n,) [m]."""
        h = self._smooth["h"]
        A = np.column_stack([np.ones_like(h), h - h.mean()])
        offset = self._smooth["baro"] - self._smooth.get("gnss", h)
        return A @ np.linalg.lstsq(A[self.ok], offset[self.ok], rcond=None)[0]

    @cached_property
    def _delta(self) -> np.ndarray:
        return np.stack([smooth(self.actuator_output(i, ())) for i in range(4)])

    @staticmethod
    def _filtered(readings: Signals) -> Signals:
        out = {name: smooth(x) for name, x in readings.items()}
        out |= {f"{name}_dot": slope(readings[name]) for name in _DIFFERENTIATED if name in readings}
        return out

    def actuator_output(self, column: int, acting: Iterable[FaultHypothesis]) -> np.ndarray:
        """Return one actuator output after servo faults, lag and delay: angle [rad] or throttle, on the flight grid."""
        timing = self.base.timing
        u = np.ascontiguousarray(self.flight.commands[:, column], float)
        tau = timing.engine if column == 3 else timing.servo
        for hypothesis in acting:
            u, memory = u.copy(), np.full(MEMORY, u[0])
            par = hypothesis.parameters_at(self.flight.t)
            if hypothesis.effect.takes_lag:
                par[0], tau = par[0] + tau, 0.0
            hypothesis.effect.act(u, memory, DT, np.ascontiguousarray(par))
        if tau > 1e-3:  # exact for linearly interpolated commands
            a = exp(-DT / tau)
            mean = (1 - a) * tau / DT
            b = [1 - mean, mean - a]
            u = lfilter(b, [1, -a], u, zi=[(1 - b[0]) * u[0]])[0]
        if timing.delay and column != 3:
            u = np.interp(self.flight.t - timing.delay, self.flight.t, u)
        return u if column == 3 else self.base.card.angle(column, u)

    def corrected_readings(self, hypotheses: tuple[FaultHypothesis, ...]) -> Signals:
        """Return the filtered readings, corrected for the hypothesised sensor faults."""
        faults = [hypothesis for hypothesis in hypotheses if hypothesis.effect.stage is Stage.SENSOR]
        if not faults:
            return self._smooth
        readings = {"t": self.flight.t, **self.flight.readings}
        for hypothesis in faults:
            par = -hypothesis.parameters_at(self.flight.t)
            try:
                undone = hypothesis.act(readings, par)
            except KeyError:  # the flight lacks this reading: the fault has no influence
                continue
            if "Va" in undone and self.base.vane:  # the raw noise scales with the reading
                faster = hypothesis.act({**readings, "Va": readings["Va"] + 1.0}, par)
                readings["Va_share"] = readings.get("Va_share", 1.0) * (faster["Va"] - undone["Va"])
            readings |= undone
        changed = {name: x for name, x in readings.items() if x is not self.flight.readings.get(name) and name != "t"}
        return {**self._smooth, **self._filtered(changed)}

    def inputs(self, hypotheses: tuple[FaultHypothesis, ...]) -> np.ndarray:
        """Return the actuator outputs, aileron, elevator, rudder angle [rad] and throttle, (4, n)."""
        acting = [hypothesis for hypothesis in hypotheses if hypothesis.effect.stage is Stage.DELTA]
        if not acting:
            return self._delta
        out = self._delta.copy()
        for column, name in enumerate(SURFACES):
            own = [hypothesis for hypothesis in acting if hypothesis.target in (name, ALL_SURFACES)]
            if own:
                out[column] = smooth(self.actuator_output(column, own))
        return out

    def _increments(self, flow: Flow, hypotheses: tuple[FaultHypothesis, ...], stages: tuple[Stage, ...]) -> Signals:
        total: Signals = {}
        for hypothesis in hypotheses:
            if hypothesis.effect.stage in stages:
                for name, x in hypothesis.act(flow, hypothesis.parameters_at(self.t)).items():
                    total[name] = total.get(name, self._zeros) + x
        return total

    def _flow_terms(self, hypotheses: tuple[FaultHypothesis, ...]) -> "FlowTerms":
        """Compute the terms that only sensor, servo and air effects change; recent results are reused.

        Effects on forces, moments and mass are compared by hundreds under the same flow.
        """
        acting = tuple(hypothesis for hypothesis in hypotheses if hypothesis.effect.stage in _FLOW_STAGES)
        return self._recent_flow.get(acting, lambda: self._compute_flow_terms(acting))

    def _compute_flow_terms(self, hypotheses: tuple[FaultHypothesis, ...]) -> "FlowTerms":
        base, body = self.base, self.base.card.body
        s, delta = self.corrected_readings(hypotheses), self.inputs(hypotheses)
        d_a, d_e, d_r, d_t = delta
        flow = Flow(
            self.t, s["h"], s["h"] - self.flight.ground, body, delta_t=d_t, throttle_time=self.throttle_integral
        )
        air = self._increments(flow, hypotheses, (Stage.AIR,))
        unchanged = all(s[name] is x for name, x in self._smooth.items() if name not in _NOT_COMPARED)
        R, derived, disagreement = self._sensor_agreement if unchanged else self._agreement(s)
        ground = np.array([s["v_n"], s["v_e"], s["v_d"]])
        wind = np.array([air.get(name, self._zeros) for name in ("w_n", "w_e", "w_d")])
        f = np.array([s["a_x"], s["a_y"], s["a_z"]]) if base.vane else derived
        flow.Va, flow.alpha, flow.beta, flow.rho, flow.q_bar = eq.air_data(
            R, ground, wind, s["h"], air.get("rho", self._zeros), 1.0
        )
        flow.p, flow.q, flow.r, Va = s["p"], s["q"], s["r"], flow.Va
        q_S = flow.q_bar * body.S
        thrust = eq.thrust_terms(d_t, Va, flow.rho / eq.RHO_0, base.speed)
        if "T" in base.coef:
            flow.T = base.coef["T"] @ thrust
            flow.C_m_elevator, flow.C_n_rudder = base.coef["M"][3] * d_e, base.coef["N"][5] * d_r
        flow.C_L = -body.mass * f[2] / q_S
        inertia = base.card.inertia, base.card.known
        L, M, N = eq.moments((s["p_dot"], s["q_dot"], s["r_dot"]), (flow.p, flow.q, flow.r), *inertia)
        measured = {
            "L": L,
            "M": M,
            "N": N,
            "alpha": flow.alpha,
            "beta": flow.beta,
            "airspeed": s.get("Va", np.zeros_like(Va)),
        }
        intermediate = {
            "apart": disagreement,
            "f": f,
            "delta": np.array([d_a, d_e, d_r, d_t]),
            "Va_share": s.get("Va_share", np.ones_like(Va)),
            "baro": s.get("baro", s["h"]) - s.get("gnss", s["h"]),
        }
        scale = {"X": q_S, "L": q_S * body.b, "N": q_S * body.b, "M": q_S * body.c}
        return FlowTerms(flow, thrust, measured, intermediate, scale)

    def equation_terms(self, hypotheses: tuple[FaultHypothesis, ...] = ()) -> EquationTerms:
        """Compute the terms of all equations with the hypotheses active."""
        base, body = self.base, self.base.card.body
        flow, thrust, of_flow, unaffected, scale = self._flow_terms(hypotheses)
        f, q_S, (d_a, d_e, d_r, _) = unaffected["f"], scale["X"], unaffected["delta"]
        span, chord = body.b / (2 * flow.Va), body.c / (2 * flow.Va)
        p_hat, q_hat, r_hat = flow.p * span, flow.q * chord, flow.r * span
        add = self._increments(flow, hypotheses, (Stage.WRENCH, Stage.MASS))
        mass, force, c_z, c_y = eq.body_coefficients(f, q_S, body.mass, eq.stack_increments(add, len(q_S)))
        c_z_dot = eq.gradient(c_z, STEP_S) * chord
        regressors = {
            "alpha": eq.alpha_terms(c_z, c_z_dot, q_hat, d_e),
            "beta": eq.beta_terms(c_y, p_hat, r_hat, d_r),
            "T": thrust,
        }
        beta = base.coef["beta"] @ regressors["beta"] if "beta" in base.coef else flow.beta
        regressors["X"] = eq.force_terms(c_z, d_e, beta)
        regressors["L"] = regressors["N"] = eq.lateral_terms(beta, p_hat, r_hat, d_a, d_r, c_z)
        regressors["M"] = eq.pitch_terms(c_z, q_hat, d_e, c_z_dot, force[0] / q_S)
        measured = {"X": force[0]} | of_flow
        intermediate = {"mass": mass, "force": force, "c_z": c_z} | unaffected
        return EquationTerms(self, flow, add, regressors, measured, intermediate, scale)

    def residuals(self, hypotheses: tuple[FaultHypothesis, ...] = ()) -> np.ndarray:
        """Return measured less simulated, (n, channels), read-only; recent results are reused."""
        return self._recent_residuals.get(hypotheses, lambda: self._compute_residuals(hypotheses))

    def _compute_residuals(self, hypotheses: tuple[FaultHypothesis, ...]) -> np.ndarray:
        terms = self.equation_terms(hypotheses)
        base, flow, add, measured = self.base, terms.flow, terms.add, terms.measured
        T, alpha, beta = (base.coef[name] @ terms.regressors[name] for name in ("T", "alpha", "beta"))
        coefficients = [evaluate_equation(base, add, name, terms.regressors[name]) for name in "XLMN"]
        increments, q_S = eq.stack_increments(add, len(self.t)), terms.scale["X"]
        X, T = eq.axial_force(coefficients[0], T, alpha, terms.intermediate["c_z"], q_S, increments)
        lengths = base.card.body.b, base.card.body.c, float(base.coef["M"][-1])
        L, M, N = eq.body_moments(np.array(coefficients[1:]), T, terms.intermediate["force"], q_S, lengths, increments)
        J_x, J_y, J_z, _ = base.card.inertia
        out = np.zeros((len(self.t), len(CHANNELS)))
        out[:, 0] = (measured["X"] - X) / terms.intermediate["mass"]
        out[:, 1] = np.degrees(measured["beta"] - beta)
        out[:, 2] = np.degrees(measured["alpha"] - alpha)
        out[:, 3] = (measured["L"] - L) / J_x
        out[:, 4] = (measured["M"] - M) / J_y
        out[:, 5] = (measured["N"] - N) / J_z
        if "C_l_p" in add:
            out[:, 3] = self._with_nominal_gusts(out[:, 3], add["C_l_p"], terms)
        if "Va" in self.flight.readings:
            out[:, 6] = measured["airspeed"] / base.airspeed - flow.Va * np.sqrt(flow.rho / eq.RHO_0)
            out[:, 6] /= terms.intermediate["Va_share"]  # in units of the faulty sensor
        out[:, 7:13] = terms.intermediate["apart"]
        if "baro" in self.flight.readings:
            out[:, 13] = terms.intermediate["baro"] - self.baro_offset - add.get("baro", 0.0)
        out.flags.writeable = False
        return out

    def _with_nominal_gusts(self, residual: np.ndarray, change: Any, terms: EquationTerms) -> np.ndarray:
        """Return the rolling residual under changed roll damping, with the noise that it has in nominal flight, (n,).

        Gusts p_g in roll, unlike those of the flow angles, are not measured. They turn the aircraft, p' = a (p_g - p):
        with the damping a the residual is p' + a p = a p_g, and a' p_g with the damping a'. The aircraft follows slow
        gusts either way, p = p_g, so that this is no evidence for either. The filter (s + a) / (s + a'), of unit gain
        at high frequency, gives the residual p' + a p of such gusts with any damping.

        Args:
            residual: measured less simulated, (n,) [rad/s2]
            change: of C_l_p, (n,) [1/rad]
            terms: terms of the equations
        """
        base, body = self.base, self.base.card.body
        per_derivative = terms.scale["L"] * body.b / (2 * terms.flow.Va) / base.card.inertia[0]
        a = np.maximum(-base.coef["L"][_ROLL_DAMPING] * per_derivative, 0.0)
        changed = np.maximum(a - change * per_derivative, 1e-3)
        pole = np.exp(-changed * STEP_S)
        new = (1.0 - (1.0 - pole) / (changed * STEP_S)) / changed  # share of the newest value, between two: a line
        old = (1.0 - pole) / changed - new
        lag, last, out = 0.0, float(residual[0]), []
        series = (x.tolist() for x in (residual, pole, old, new))
        for x, pole_k, old_k, new_k in zip(*series, strict=True):
            lag = pole_k * lag + old_k * last + new_k * x
            last = x
            out.append(lag)
        return residual - (changed - a) * np.array(out)


def evaluate_equation(base: Baseline, add: Signals, equation: str, terms: np.ndarray) -> np.ndarray:
    """Evaluate an equation, with relative errors of its derivatives from `add`, (n,)."""
    coef = base.coef[equation][: len(terms)]
    out = coef @ terms
    for name, share in add.items():
        if name.startswith(f"{equation}:"):
            k = eq.TERMS[equation].index(name[len(equation) + 1 :])
            out = out + share * coef[k] * terms[k]
    return out
