"""One wind field for all simulated aircraft: log profile, and slow fluctuations coherent in space and time.

    u(z) = u_star / kappa ln(z / z_0)                                                                          mean
    f S(f) / u_star^2 = a n / (1 + b n)^(5/3),   n = f z_ref / U                                               spectrum
    coherence(f, d) = exp(-f / U sqrt((C_x d_x)^2 + (C_y d_y)^2 + (C_z d_z)^2))
    phase(f, d) = 2 pi f d_x / U                                                                               advection

with d_x along the mean wind. The fluctuations are a sum of random Fourier modes: frequencies are quantiles of the
spectrum below `CUTOFF_HZ`, and wave numbers are Cauchy distributed, whose characteristic function is the exponential
coherence. Turbulence above the cut-off is that of each aircraft alone, as JSBSim or RotorPy makes it.

Source: Kaimal et al. 1972, eq. 21 (spectra along and across); Davenport 1961 (exponential coherence); Solari and
Piccardo 2001, table 2 (decay constants); Taylor 1938 (advection); Shinozuka and Deodatis 1991, eq. 12 (spectral
representation).
"""

from math import cos, log, pi, sin
from typing import NamedTuple

import numpy as np

from fleet.frames import Origin, to_ned
from fleet.simulator.vehicle.weather import MIN_HEIGHT_M, REFERENCE_M, fleet_wind_direction

ROUGHNESS_M = 0.1  # z_0, farmland: about the profile of the exponent 1/7 at 100 m
KARMAN = 0.4
CUTOFF_HZ = 1 / 30
_MODES = 256  # of each component
_SPECTRA = ((105.0, 33.0), (17.0, 9.5))  # a, b along and across the mean wind
_DECAYS = ((3.0, 10.0, 10.0), (3.0, 6.5, 6.5))  # C_x, C_y, C_z of both


class _Modes(NamedTuple):
    """Random Fourier modes of one component: sum of amplitude cos(omega t + k r + phase)."""

    amplitude: float
    omega: np.ndarray  # (m,) [rad/s]
    k: np.ndarray  # along, across, up, (m, 3) [rad/m]
    phase: np.ndarray  # (m,) [rad]

    def at(self, t: float, r: np.ndarray) -> float:
        """Return the value at t [s] and r, (3,) [m], [m/s]."""
        return self.amplitude * float(np.cos(self.omega * t + self.k @ r + self.phase).sum())


class CoherentWind:
    """The wind of a fleet as a function of time and position."""

    def __init__(self, mean: float, towards: float, origin: Origin, rng: np.random.Generator) -> None:
        """Draw the field.

        Args:
            mean: wind speed at 100 m [m/s]
            towards: direction it blows to, clockwise from north [rad]
            origin: origin of the NED frame of `at`
            rng: random generator
        """
        self.origin = origin
        self._along = np.array([cos(towards), sin(towards)])
        self._friction_speed = KARMAN * mean / log(REFERENCE_M / ROUGHNESS_M)
        modes = zip(_SPECTRA, _DECAYS, strict=True) if mean > 0 else ()
        self._modes = [self._draw(mean, spectrum, np.array(decay), rng) for spectrum, decay in modes]

    @classmethod
    def of_fleet(cls, mean: float, seed: int, origin: Origin) -> "CoherentWind":
        """Draw the field of the fleet of a seed; arguments as of the constructor."""
        return cls(mean, fleet_wind_direction(seed), origin, np.random.default_rng((seed, 13)))

    def _draw(self, mean: float, spectrum: tuple[float, float], decay: np.ndarray, rng: np.random.Generator) -> _Modes:
        """Draw the modes of one component; the spectrum below f has the variance 1.5 a/b (1 - (1 + b n)^(-2/3))."""
        a, b = spectrum
        below = 1.0 - (1.0 + b * CUTOFF_HZ * REFERENCE_M / mean) ** (-2 / 3)
        quantile = below * (np.arange(_MODES) + rng.random(_MODES)) / _MODES
        f = ((1.0 - quantile) ** -1.5 - 1.0) / b * mean / REFERENCE_M
        cauchy = rng.standard_normal((_MODES, 3)) / np.abs(rng.standard_normal((_MODES, 1)))
        k = cauchy * decay * f[:, None] / mean
        k[:, 0] -= 2 * pi * f / mean
        variance = 1.5 * a / b * below * self._friction_speed**2
        return _Modes(float(np.sqrt(2 * variance / _MODES)), 2 * pi * f, k, rng.uniform(0, 2 * pi, _MODES))

    def at(self, t: float, p: np.ndarray) -> tuple[float, float]:
        """Return the wind, NED north and east, at t [s] since the start and p NED from `origin`, (3,) [m], [m/s]."""
        (c, s), height = self._along, max(-float(p[2]), MIN_HEIGHT_M)
        mean = self._friction_speed / KARMAN * log(height / ROUGHNESS_M)
        r = np.array([c * p[0] + s * p[1], c * p[1] - s * p[0], height])
        along, across = (modes.at(t, r) for modes in self._modes) if self._modes else (0.0, 0.0)
        return float(c * (mean + along) - s * across), float(s * (mean + along) + c * across)


class LocalWind:
    """The wind of the field where one aircraft is, with the interface of `weather.MeanWind`."""

    def __init__(self, field: CoherentWind, home: Origin, dt: float) -> None:
        """Set the field, the origin of the aircraft's NED frame, and the time between two calls of `step` [s]."""
        self._field, self._dt, self._t = field, dt, -dt
        offset = to_ned(field.origin, *(np.array([x], float) for x in home))[0]
        self._offset = np.array([offset[0], offset[1], 0.0])  # heights are those above the aircraft's own home

    def step(self, p: np.ndarray) -> tuple[float, float]:
        """Advance by dt and return the wind, NED north and east, at p NED from home, (3,) [m], [m/s]."""
        self._t += self._dt
        return self._field.at(self._t, p + self._offset)
