"""Effects of multirotors: coordinates that each changes, channel, reported values and their prior scale."""

from dataclasses import dataclass
from math import degrees

import numpy as np

from fleet.effects import Effect, Onset, Parameter, Stage

_STEPS = (Onset.ALWAYS, Onset.STEP)


@dataclass(frozen=True)
class RotorEffect:
    """One candidate with its place.

    Attributes:
        effect: name, channel, equation and reported parameters
        target: motor or axis; empty if there is only one
        coordinates: names in `model.residuals`
        scale: prior standard deviation of each coordinate
        step: for numerical derivatives
        low: smallest physical value of the coordinates
        nominal: standard deviation within which a coordinate is nominal; 0: none
        in_forces: predicted specific force shows it
    """

    effect: Effect
    target: str
    coordinates: tuple[str, ...]
    scale: float
    step: float
    low: float = -np.inf
    nominal: float = 0.0
    in_forces: bool = True

    @property
    def label(self) -> str:
        """Return name and place."""
        return f"{self.effect.name}:{self.target}" if self.target else self.effect.name

    @property
    def group(self) -> str:
        """Return the name of effects that are alike on nominal flights: those of all motors, but of each axis apart."""
        return self.effect.name if self.target.startswith("motor") else self.label

    def reported(self, values: np.ndarray, tau: float) -> dict[str, float]:
        """Return the values of the coordinates in reporting units; a lag includes that of the healthy motors [s]."""
        factor = degrees(1.0) if "bias_d" in self.effect.parameters[0].name else 1.0
        names = [one.name for one in self.effect.parameters]
        added = tau if self.effect.name == "motor_lag" else 0.0
        return {name: float(factor * x + added) for name, x in zip(names, values, strict=True)}

    def reported_sigma(self, sigma: np.ndarray) -> dict[str, float]:
        """Return the standard deviations of `reported`."""
        return {name: abs(x) for name, x in self.reported(sigma, 0.0).items()}


def _effect(
    name: str, stage: Stage, channel: str, equation: str, parameters: tuple[tuple[str, str, str], ...]
) -> Effect:
    rows = tuple(Parameter(*row, step=0.01, low=-np.inf, high=np.inf) for row in parameters)
    source = "Beard & McLain 2012, ch. 14" if stage is not Stage.SENSOR else "sensor error model"
    return Effect(name, stage, channel, equation, source, rows, act=_unused, examples=((0.1,) * len(rows),) * 3)


def _unused(*_: object) -> None:
    raise NotImplementedError("effects of multirotors act in twin_worker.diagnosis.multirotor.model")


_MOTOR = _effect(
    *("motor_thrust_loss", Stage.WRENCH, "actuator", "T_i = (1 - loss) T_i,healthy"),
    (("loss", "-", "thrust and torque lost by one motor: worn or slipping propeller, ESC"),),
)
_THRUST = _effect(
    *("thrust_loss", Stage.WRENCH, "thrust", "T = (1 - loss) T_healthy of all rotors"),
    (("loss", "-", "thrust lost by all rotors at equal speed: worn propellers, thin air"),),
)
_LAG = _effect(
    *("motor_lag", Stage.DELTA, "actuator", "w' = (w_c - w) / tau_s"),
    (("tau_s", "s", "time constant of all motors"),),
)
_MASS = _effect(
    *("mass_change", Stage.MASS, "mass", "m = (1 + fraction) m_nominal"),
    (("fraction", "-", "mass added at the centre of gravity, share of the nominal mass"),),
)
_CG = _effect(
    *("cg_shift", Stage.MASS, "pitch", "M = -x_cg sum T, L = y_cg sum T"),
    (("forward", "arm", "centre of gravity moved forward, in arm lengths"), ("right", "arm", "moved right")),
)
_DRAG = _effect(
    *("drag_increase", Stage.WRENCH, "drag", "f = -(1 + fraction) c Va (u, v, w)"),
    (("fraction", "-", "quadratic drag of the frame added, share of the nominal one"),),
)
_LATENCY = _effect(
    *("gps_latency", Stage.SENSOR, "gps", "v(t) = v_true(t - latency_s)"),
    (("latency_s", "s", "age of velocity and position"),),
)
_HEADING = _effect(
    *("heading_bias", Stage.SENSOR, "heading", "psi = psi_true + bias"), (("bias_deg", "deg", "error of the heading"),)
)
_GYRO = _effect(
    *("gyro_bias", Stage.SENSOR, "gyro", "p = p_true + bias"), (("bias_dps", "deg/s", "error of one rate"),)
)
_ACCEL = _effect(
    *("accel_bias", Stage.SENSOR, "accel", "f = f_true + bias"), (("bias_mps2", "m/s2", "error of one axis"),)
)
_BARO = _effect(
    *("baro_bias", Stage.SENSOR, "baro", "h = h_true + bias"), (("bias_m", "m", "error of the pressure height"),)
)
_BARO = _BARO.__class__(**{**_BARO.__dict__, "onsets": (Onset.STEP,)})


def rotor_effects(motors: int) -> tuple[RotorEffect, ...]:
    """Return the catalogue for a number of motors."""
    return (
        *(RotorEffect(_MOTOR, f"motor{i + 1}", (f"motor{i + 1}",), 0.2, 0.02, low=0.0) for i in range(motors)),
        RotorEffect(_THRUST, "", ("thrust",), 0.15, 0.02, low=0.0),
        RotorEffect(_LAG, "", ("lag",), 0.06, 0.01, low=0.0, in_forces=False),
        RotorEffect(_MASS, "", ("mass",), 0.15, 0.02),
        RotorEffect(_CG, "", ("cg_forward", "cg_right"), 0.1, 0.01, in_forces=False),
        RotorEffect(_DRAG, "", ("drag",), 1.0, 0.1, low=0.0),
        RotorEffect(_LATENCY, "", ("latency",), 0.3, 0.02, low=0.0, in_forces=False),
        RotorEffect(_HEADING, "", ("heading",), 0.2, 0.02, nominal=0.02, in_forces=False),
        *(RotorEffect(_GYRO, axis, (f"gyro_{axis}",), 0.03, 0.005, nominal=0.002, in_forces=False) for axis in "pqr"),
        *(RotorEffect(_ACCEL, axis, (f"accel_{axis}",), 0.5, 0.05, nominal=0.06, in_forces=False) for axis in "xyz"),
        RotorEffect(_BARO, "", ("baro",), 10.0, 1.0, nominal=5.0, in_forces=False),
    )


def coordinate_steps(effects: tuple[RotorEffect, ...]) -> dict[str, float]:
    """Return the step of every coordinate for numerical derivatives."""
    return {name: one.step for one in effects for name in one.coordinates}
