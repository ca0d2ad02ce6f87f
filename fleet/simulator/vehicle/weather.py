"""Weather of a simulated aircraft: mean wind with height profile and slow drift, turbulence intensity."""

from math import cos, pi, sin

import numpy as np

FT = 0.3048  # [m]
_W20_FPS = (0.0, 8.0, 16.0, 25.0, 50.0, 62.0, 75.0, 88.0)
REFERENCE_M = 100.0  # reference height of the mean wind
MIN_HEIGHT_M = 5.0  # height above ground below which the profiles of the mean wind are constant
HELLMANN = 0.143  # exponent of the mean wind over height, over open ground


class GaussMarkov:
    """A vector of independent first-order Gauss-Markov processes: x' = -x / tau + noise, with std sigma."""

    def __init__(self, rng: np.random.Generator, sigma: np.ndarray, tau: np.ndarray, dt: float):
        """Start in the stationary distribution.

        Args:
            rng: random generator
            sigma: standard deviation, (n,) [any]
            tau: correlation time, (n,) [s]; 0 makes white noise
            dt: step [s]
        """
        self._rng = rng
        decay = np.where(tau > 0, np.exp(-dt / np.where(tau > 0, tau, 1.0)), 0.0)
        self._decay, self._noise_std = decay, sigma * np.sqrt(1 - decay**2)
        self.x = sigma * rng.standard_normal(len(sigma))

    def step(self) -> np.ndarray:
        """Advance by dt; return the new values (n,)."""
        self.x = self._decay * self.x + self._noise_std * self._rng.standard_normal(len(self._noise_std))
        return self.x


class MeanWind:
    """Mean wind over height plus a slow horizontal drift.

    w(h) = w_100 (h / 100)^0.143, drift std 0.12 w_100 + 0.1 m/s with a correlation time of 90 s.
    Source: power law 1/7 (Hellmann exponent over open ground).
    """

    def __init__(
        self,
        mean: float,
        rng: np.random.Generator,
        dt: float,
        towards: float | None = None,
        *,
        exponent: float = HELLMANN,
        drift: float = 1.0,
    ):
        """Set the mean wind, and draw its direction if not given.

        Args:
            mean: wind speed at 100 m [m/s]
            rng: random generator
            dt: step of `step` [s]
            towards: direction it blows to, clockwise from north [rad]; None: random
            exponent: of the height profile; 0: uniform
            drift: factor of the drift above
        """
        self._mean = mean
        self._towards = rng.uniform(-pi, pi) if towards is None else towards
        self._exponent = exponent
        sigma = drift * (0.12 * mean + 0.1) if mean > 0 else 0.0
        self._drift = GaussMarkov(rng, np.full(2, sigma), np.full(2, 90.0), dt)

    def step(self, p: np.ndarray) -> tuple[float, float]:
        """Advance by dt and return the wind, NED north and east, at p NED from the ground, (3,) [m], [m/s]."""
        speed = self._mean * (max(-float(p[2]), MIN_HEIGHT_M) / REFERENCE_M) ** self._exponent
        d_n, d_e = self._drift.step()
        return speed * cos(self._towards) + d_n, speed * sin(self._towards) + d_e


def fleet_wind_direction(seed: int) -> float:
    """Return the direction to which the mean wind of all aircraft of a seed blows, clockwise from north [rad]."""
    return float(np.random.default_rng((seed, 5)).uniform(-pi, pi))


def turbulence_level(text: str) -> int:
    """Parse `--turbulence`: 0..7, or none, light (3), moderate (4), severe (6).

    Raises:
        ValueError: when it is none of these.
    """
    levels = {"none": 0, "light": 3, "moderate": 4, "severe": 6}
    level = levels.get(text, int(text) if text.isdecimal() else -1)
    if not 0 <= level <= 7:
        raise ValueError(f"turbulence: found {text!r}, expected 0..7 or none, light, moderate, severe; choose one")
    return level


def wind_at_20ft(level: int) -> float:
    """Return the MIL-F-8785C wind at 20 ft for a severity [ft/s]: light 15 kt, moderate 30 kt, severe 45 kt.

    Below 1000 ft only this wind sets the intensity, sigma_w = 0.1 w_20. Source: MIL-F-8785C sec. 3.7.3.4.
    """
    return _W20_FPS[level]
