"""Simulate the calibrated aircraft with active effects: parallel runs, commands recorded or from a pilot.

    m a = m g + R (X, Y, Z)      J omega' = moments, inertia coupling if the card is known      (NED, FRD)

Forces follow from the inverted equations of the calibration: c_z from alpha, c_y from beta.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fleet.effects import ALL_SURFACES, MEMORY, SURFACES, Flow, Onset, Stage
from fleet.frames import G, rotation
from twin_worker.diagnosis.data.card import FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.data.flight import DT
from twin_worker.diagnosis.model import equations as eq
from twin_worker.diagnosis.model.baseline import Baseline

STATE = ("v_n", "v_e", "v_d", "p", "q", "r", "phi", "theta", "psi", "h")
_MAX_PITCH = 1.45  # limit of the pitch angle [rad]
_MIN_AIRSPEED = 3.0  # least airspeed in the equations [m/s]
_MAX_RATE = 8.0  # body rate above which a run counts as diverged [rad/s]

Pilot = Callable[[int, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Runs:
    """Simulated series: states (n, 10, runs), force FRD (n, 3, runs), commands (n, 4, runs); Va, rho (n, runs)."""

    states: np.ndarray
    force: np.ndarray
    commands: np.ndarray
    Va: np.ndarray
    rho: np.ndarray


class Simulation:
    """Parallel runs of one aircraft, each with its own effects.

    Args:
        base: the calibrated simulation
        hypotheses: active effects of each run
        start_times: start time of each run, (runs,) [s]
        ground: height of the ground [m]
    """

    def __init__(
        self,
        base: Baseline,
        hypotheses: Sequence[Sequence[FaultHypothesis]],
        start_times: np.ndarray,
        ground: float = 0.0,
    ) -> None:
        self.base, self.start_times, self.ground = base, np.asarray(start_times, float), ground
        self.runs = len(hypotheses)
        acting = [(g, run) for run, run_hypotheses in enumerate(hypotheses) for g in run_hypotheses]
        groups: dict[str, list[tuple[FaultHypothesis, int]]] = {}
        for g, run in acting:
            if g.effect.stage in (Stage.AIR, Stage.WRENCH, Stage.MASS):
                groups.setdefault(f"{g.effect.stage}:{g.label}", []).append((g, run))
        self._groups = [_EffectGroup([g for g, _ in group], [run for _, run in group]) for group in groups.values()]
        self._servos = [(run, g) for g, run in acting if g.effect.stage is Stage.DELTA]
        self._zeros, self._no_wind = np.zeros(self.runs), np.zeros((3, self.runs))

    def simulate(self, start: np.ndarray, pilot: Pilot, n: int) -> Runs:
        """Simulate n steps of `DT`; commands are constant over a step, servos and engine follow with lag.

        Args:
            start: states in the order of `STATE`, (10, runs)
            pilot: `(step, states (10, runs))` to commands delta_a delta_e delta_r delta_t, (4, runs)
        """
        x, deflections = np.array(start, float), self.base.card.deflections
        states, force = np.empty((n, len(STATE), self.runs)), np.empty((n, 3, self.runs))
        commands, speed, rho = np.empty((n, 4, self.runs)), np.empty((n, self.runs)), np.empty((n, self.runs))
        memories: dict[tuple[int, int, int], np.ndarray] = {}  # run, input, effect -> servo memory
        actuated: np.ndarray | None = None
        used = np.zeros(self.runs)
        half_step, full_step = self._lag_share(0.5 * DT), self._lag_share(DT)
        for k in range(n):
            t = self.start_times + k * DT
            states[k], commands[k] = x, pilot(k, x)
            faulty = self._faulty_commands(commands[k], t, memories)
            actuated = faulty if actuated is None else actuated
            used += commands[k, 3] * DT
            self._gate(t)
            first, middle = deflections(actuated), deflections(actuated + half_step * (faulty - actuated))
            actuated = actuated + full_step * (faulty - actuated)
            k1, force[k], speed[k], rho[k] = self.derivatives(x, first, t, used)
            self._gate(t + 0.5 * DT)
            k2 = self.derivatives(x + 0.5 * DT * k1, middle, t + 0.5 * DT, used)[0]
            k3 = self.derivatives(x + 0.5 * DT * k2, middle, t + 0.5 * DT, used)[0]
            self._gate(t + DT)
            k4 = self.derivatives(x + DT * k3, deflections(actuated), t + DT, used)[0]
            x = x + DT / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
            diverged = ~(np.abs(x[3:6]).max(axis=0) < _MAX_RATE)
            x[:, diverged] = np.where(np.isfinite(states[k][:, diverged]), states[k][:, diverged], 0.0)
        return Runs(states, force, commands, speed, rho)

    def airspeed(self, x: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return true airspeed, (runs,) [m/s], of states (10, runs) at times (runs,) [s], as an input of the pilot."""
        flow = Flow(t, x[9], x[9] - self.ground, self.base.card.body)
        self._gate(t)
        return np.sqrt(((x[:3] - self._wind(self._increments(flow, (Stage.AIR,)))) ** 2).sum(axis=0))  # type: ignore[no-any-return]

    def _lag_share(self, dt: float) -> np.ndarray:
        """Return the share of a command step that servos and engine reach within dt, (4, runs)."""
        timing = self.base.timing
        tau = np.array([timing.servo + timing.delay] * 3 + [timing.engine])
        share = np.repeat((1.0 - np.exp(-dt / np.maximum(tau, 1e-3)))[:, None], self.runs, axis=1)
        for run, hypothesis in self._servos:
            for column, name in enumerate(SURFACES):
                if hypothesis.effect.takes_lag and hypothesis.target in (name, ALL_SURFACES):
                    share[column, run] = 1.0
        return share

    def _faulty_commands(
        self, commands: np.ndarray, t: np.ndarray, memories: dict[tuple[int, int, int], np.ndarray]
    ) -> np.ndarray:
        """Apply the servo faults to the commands, (4, runs)."""
        out = commands.copy()
        for run, hypothesis in self._servos:
            for column, name in enumerate(SURFACES):
                if hypothesis.target not in (name, ALL_SURFACES):
                    continue
                u = out[column, run : run + 1].copy()
                memory = memories.setdefault((run, column, id(hypothesis)), np.full(MEMORY, u[0]))
                par = hypothesis.parameters_at(t[run : run + 1])
                if hypothesis.effect.takes_lag:
                    par[0] += self.base.timing.servo + self.base.timing.delay
                hypothesis.effect.act(u, memory, DT, par)
                out[column, run] = u[0]
        return out

    def _gate(self, t: np.ndarray) -> None:
        """Set the parameters of all grouped effects at times t, (runs,) [s], from their onset profiles."""
        for group in self._groups:
            group.gate(t)

    def _increments(self, flow: Flow, stages: tuple[Stage, ...]) -> dict[str, np.ndarray]:
        total: dict[str, np.ndarray] = {}
        for group in self._groups:
            if group.stage not in stages:
                continue
            for name, x in group.act(flow).items():
                if name not in total:
                    total[name] = np.zeros(self.runs)
                total[name][group.run_index] += x
        return total

    def _wind(self, air: dict[str, np.ndarray]) -> np.ndarray:
        if not air:
            return self._no_wind
        return np.array([air.get(name, self._zeros) for name in ("w_n", "w_e", "w_d")])

    def derivatives(
        self, x: np.ndarray, delta: np.ndarray, t: np.ndarray, used: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return d state/dt (10, runs), specific force FRD (3, runs) [m/s2], airspeed [m/s], density [kg/m3], (runs,).

        Args:
            x: states, (10, runs)
            delta: surface angles [rad] and throttle, (4, runs)
            t: time [s]; used: throttle integrated over time [s]; each (runs,)
        """
        base, body = self.base, self.base.card.body
        v, (p, q, r), (phi, theta, psi), h = x[:3], x[3:6], x[6:9], x[9]
        theta = np.clip(theta, -_MAX_PITCH, _MAX_PITCH)
        d_a, d_e, d_r, d_t = delta
        flow = Flow(t, h, h - self.ground, body, p=p, q=q, r=r, delta_t=d_t, throttle_time=used)
        air = self._increments(flow, (Stage.AIR,))
        R = rotation(phi, theta, psi)
        flow.Va, flow.alpha, flow.beta, flow.rho, flow.q_bar = eq.air_data(
            R, v, self._wind(air), h, air.get("rho", self._zeros), _MIN_AIRSPEED
        )
        span, chord = body.b / (2 * flow.Va), body.c / (2 * flow.Va)
        p_hat, q_hat, r_hat, q_S = p * span, q * chord, r * span, flow.q_bar * body.S
        coef = base.coef
        flow.T = coef["T"] @ eq.thrust_terms(d_t, flow.Va, flow.rho / eq.RHO_0, base.speed)
        flow.C_m_elevator, flow.C_n_rudder = coef["M"][3] * d_e, coef["N"][5] * d_r
        A, B = coef["alpha"], coef["beta"]
        c_z = eq.solve_c_z(A, flow.alpha - A[0] - A[3] * q_hat - A[5] * d_e)
        c_y = (flow.beta - B[0] - B[2] * p_hat - B[3] * r_hat - B[4] * d_r) / B[1]
        flow.C_L = -c_z
        add = self._increments(flow, (Stage.WRENCH, Stage.MASS))
        increments, zero = eq.stack_increments(add, self.runs), self._zeros
        c_x = coef["X"] @ eq.force_terms(c_z, d_e, flow.beta)
        X, T = eq.axial_force(c_x, flow.T, flow.alpha, c_z, q_S, increments)
        lift = add.get("lift", zero) * -c_z + add.get("C_L", zero)
        force = np.array([X, q_S * (c_y + add.get("C_Y", zero)), q_S * (c_z - lift)])
        lateral = eq.lateral_terms(flow.beta, p_hat, r_hat, d_a, d_r, c_z)
        c_m = coef["M"][:-1] @ eq.pitch_terms(c_z, q_hat, d_e, zero, X / q_S)
        lengths = body.b, body.c, float(coef["M"][-1])
        moments = eq.body_moments(
            np.array([coef["L"] @ lateral, c_m, coef["N"] @ lateral]), T, force, q_S, lengths, increments
        )
        f = force / (body.mass * (1.0 + add.get("mass", zero)))
        acceleration = np.einsum("ijn,jn->in", R, f)
        acceleration[2] += G
        rates = np.concatenate([acceleration, self._rotation_derivatives(x, moments), -v[2:3]])
        return rates, f, flow.Va, flow.rho

    def _rotation_derivatives(self, x: np.ndarray, moments: np.ndarray) -> np.ndarray:
        (p, q, r), phi, card = x[3:6], x[6], self.base.card
        theta = np.clip(x[7], -_MAX_PITCH, _MAX_PITCH)
        sf, cf = np.sin(phi), np.cos(phi)
        turn = (q * sf + r * cf) / np.cos(theta)
        accelerations = eq.angular_accelerations(moments, x[3:6], card.inertia, card.known)
        return np.concatenate([accelerations, [p + np.sin(theta) * turn, q * cf - r * sf, turn]])


class _EffectGroup:
    """Hypotheses of one effect on one target, and the runs in which they are active."""

    def __init__(self, hypotheses: list[FaultHypothesis], runs: list[int]) -> None:
        self.stage, self._hypotheses, self._runs = hypotheses[0].effect.stage, hypotheses, np.array(runs)
        contiguous = np.array_equal(self._runs, np.arange(runs[0], runs[0] + len(runs)))
        self.run_index = slice(runs[0], runs[0] + len(runs)) if contiguous else self._runs  # a slice yields views
        self._par = np.array([hypothesis.par for hypothesis in hypotheses]).T
        self._full = self._par
        self._time_varying = any(hypothesis.onset.kind is not Onset.ALWAYS for hypothesis in hypotheses)
        self._onsets: dict[OnsetProfile, list[int]] = {}  # columns of each
        for column, hypothesis in enumerate(hypotheses):
            self._onsets.setdefault(hypothesis.onset, []).append(column)

    def gate(self, t: np.ndarray) -> None:
        """Set the parameters at times t, (runs,) of all runs."""
        if self._time_varying:
            share = np.empty(len(self._runs))
            for onset, columns in self._onsets.items():
                share[columns] = onset.gate(t[self._runs[columns]])
            self._par = self._full * share

    def act(self, flow: Flow) -> dict[str, np.ndarray]:
        """Return the increments of the active runs."""
        fields = {name: x[self.run_index] if isinstance(x, np.ndarray) else x for name, x in vars(flow).items()}
        part = Flow(**fields)  # type: ignore[arg-type]
        return self._hypotheses[0].act(part, self._par)
