"""Calibrated simulation: coefficients of all equations, actuator timing, noise, spread between flights."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from twin_worker.diagnosis.data.card import AircraftCard

CHANNELS = (
    *("force_x", "side", "lift", "roll", "pitch", "yaw", "airspeed"),
    *("gps_x", "gps_y", "gps_z", "gyro_roll", "gyro_pitch", "gyro_yaw", "baro"),
)
"""Residuals: fx [m/s2]; beta, alpha [deg]; p', q', r' [rad/s2]; airspeed [m/s]; dV/dt against the accelerometer
[m/s2]; Euler rates against the gyros [rad/s]; barometric height [m]."""
IGNORED_SIGMA = 1e6  # noise sigma of an ignored channel
WEATHER_MPS = 1.0  # larger wind spread between nominal flights: a mean wind is then nominal


@dataclass(frozen=True)
class ActuatorTiming:
    """Actuator dynamics: lag of servos and engine, transport delay [s]."""

    servo: float = 0.0
    engine: float = 0.25
    delay: float = 0.0


@dataclass(frozen=True)
class Noise:
    """Autoregressive noise of each residual: e(k) = x(k) - a1 x(k-1) - a2 x(k-2), std(e) = sigma; (c, 2), (c,)."""

    ar: np.ndarray
    sigma: np.ndarray

    def of_channel(self, c: int) -> "Noise":
        """Return the noise of one channel, (1, 2), (1,)."""
        return Noise(self.ar[[c]], self.sigma[[c]])

    def whiten(self, x: np.ndarray) -> np.ndarray:
        """Whiten residuals, (n, c), or their slopes, (n, c, k); the first two rows are zero."""
        a1, a2, sigma = (column.reshape(-1, *(1,) * (x.ndim - 2)) for column in (*self.ar.T, self.sigma))
        e = np.empty_like(x)
        e[:2], inner = 0.0, e[2:]
        np.multiply(x[1:-1], a1, out=inner)
        np.subtract(x[2:], inner, out=inner)
        inner -= a2 * x[:-2]
        inner /= sigma
        return e


def unit_noise() -> Noise:
    """Return unit white noise, with which `whiten` does not filter."""
    n = len(CHANNELS)
    return Noise(np.zeros((n, 2)), np.ones(n))


@dataclass(frozen=True)
class Envelope:
    """Conditions of the nominal flights. Outside them the baseline extrapolates, and its uncertainty grows.

    Attributes:
        ln_density: lowest and highest logarithm of the standard density at the flown heights, in kg/m3
        ln_speed: the same of the speed over ground, in m/s
        days: start of each flight [days since 1970]
        c_z: lowest and highest coefficient of the vertical body force
    """

    ln_density: tuple[float, float]
    ln_speed: tuple[float, float]
    days: tuple[float, ...]
    c_z: tuple[float, float] = (-np.inf, np.inf)


@dataclass(frozen=True)
class Baseline:
    """Simulation calibrated on nominal flights; the field names are the keys of the model file.

    Attributes:
        card: the aircraft
        coef: equation -> coefficients, in the order of `equations.TERMS`
        speed: usual airspeed [m/s]
        airspeed: reported over indicated airspeed of the healthy sensor [-]
        timing: of servos and engine
        vane: flow angles come from the accelerometer
        r2: equation -> share of variance explained on the nominal flights
        noise: of the residuals
        spread: nuisance -> standard deviation between flights, in its own unit
        chance: hypothesis and kind of onset -> largest gain on left-out nominal flights
        block_chance: the same with the largest gain in the means over 10 s
        others: coefficients with each nominal flight left out, less those of all flights: their uncertainty
        usual: mean square of each whitened residual on nominal flights, (c,)
        block_sigma: standard deviation of the raw residual's mean over 10 s on left-out nominal flights, (c,)
        flights: names of the nominal flights
        envelope: conditions of the nominal flights; None where the flight itself is its baseline
        undetermined: surfaces whose derivative the nominal flights do not determine
    """

    card: AircraftCard
    coef: dict[str, np.ndarray]
    speed: float
    airspeed: float = 1.0
    timing: ActuatorTiming = field(default_factory=ActuatorTiming)
    vane: bool = True
    r2: dict[str, float] = field(default_factory=dict)
    noise: Noise = field(default_factory=unit_noise)
    spread: dict[str, float] = field(default_factory=dict)
    chance: dict[str, float] = field(default_factory=dict)
    block_chance: dict[str, float] = field(default_factory=dict)
    others: tuple[dict[str, np.ndarray], ...] = ()
    usual: np.ndarray = field(default_factory=lambda: np.ones(len(CHANNELS)))
    block_sigma: np.ndarray = field(default_factory=lambda: np.full(len(CHANNELS), IGNORED_SIGMA))
    flights: tuple[str, ...] = ()
    envelope: Envelope | None = None
    undetermined: tuple[str, ...] = ()

    def varied(self, k: int) -> "Baseline":
        """Return the baseline with the coefficients of the k-th entry of `others`."""
        coef = {name: x + self.others[k][name] for name, x in self.coef.items()}
        return replace(self, coef=coef)


CHANNEL_OF = {"X": "force_x", "beta": "side", "alpha": "lift", "L": "roll", "M": "pitch", "N": "yaw"}
"""Equation -> channel of its residual."""


def exclude_equations(base: Baseline, equations: Iterable[str]) -> Baseline:
    """Return a baseline that ignores the residuals of some equations."""
    sigma, block_sigma, r2 = base.noise.sigma.copy(), base.block_sigma.copy(), dict(base.r2)
    for name in equations:
        channel = CHANNELS.index(CHANNEL_OF[name])
        sigma[channel] = block_sigma[channel] = IGNORED_SIGMA
        r2[name] = min(r2.get(name, 0.0), 0.0)
    return replace(base, noise=Noise(base.noise.ar, sigma), block_sigma=block_sigma, r2=r2)


def wind_is_nominal(base: Baseline) -> bool:
    """Return whether the nominal flights had wind, so that a mean wind is nominal."""
    return max(base.spread.get(f"wind_steady:{axis}", 0.0) for axis in ("w_n", "w_e")) > WEATHER_MPS
