"""Battery of a multirotor: power by airspeed and climb, charge, and the remaining share after a predicted flight.

    P = P0 (c0 + c1 u^2 + c2 u^3 + c3 up + c4 down)      power, u airspeed / 10 m/s, up and down climb rates
    r' = -k I,   I = P / V,   V = V_now + b (r - r_now)   remaining share, charge k^-1, voltage

c1 has the induced power, which decreases in translational flight, and the profile power, c2 the parasite power. All
coefficients are posterior means of linear regressions, with the reported current times voltage and remaining share.
Source: Leishman 2006, "Principles of Helicopter Aerodynamics", 5.4 and 5.5 (power in climb and forward flight);
Traub 2011, J. Aircraft 48(2) (discharge at a voltage that falls); Gelman et al. 2013, 14.8 (regression with a prior).
"""

from collections.abc import Mapping
from math import isfinite, sqrt

import msgspec
import numpy as np

N_POWER = 5
_SPEED_SCALE = 10.0  # [m/s]
_PRIOR_STD = np.array([1.0, 0.3, 0.2, 0.1, 0.05])  # of the coefficients, over the power of hover [-, -, -, s/m, s/m]
_PRIOR_MEAN = np.array([1.0, 0.0, 0.0, 0.05, -0.02])
_SCATTER = 0.1  # of a power before its scatter is known, over the power of hover [-]
_CORRELATION_S = 10.0  # time of independent deviations of the power: gusts and manoeuvres [s]
_QUANTUM = 0.01  # of the reported remaining share [-]
_MIN_QUANTA = 2.0  # fall of the remaining share from which the charge is known [-]
_CHARGE_STD = 0.1  # relative, of a charge from parameters [-]
_SLOPE_SHARE = (0.15, 0.08)  # fall of the voltage from full to empty over the voltage: mean and standard deviation [-]
_MIN_POWER_SHARE = 0.3  # of the largest power: less is not in flight [-]
_MIN_ROWS = 20  # in flight before a forecast
_MAX_STEP_S = 5.0  # between rows, for the charge used [s]
_CAPACITY = ("BATT_CAPACITY", "BAT1_CAPACITY", "BAT_CAPACITY")  # [mAh]


class BatteryModel(msgspec.Struct):
    """Identified battery and power of one aircraft, updated with each row.

    Attributes:
        t: newest row [s since 1970]
        scale: first power in flight, over which all others are taken [W]; 0 before
        highest: largest power so far [W]
        information, weighted: of the power coefficients, (5, 5) and (5,)
        squares, n: sum of squared deviations of the power, and number of rows
        used: charge since the first row [A s]
        moments: count, sums of charge, remaining, charge^2, charge remaining, over rows
        voltage_moments: count, sums of remaining, voltage, remaining^2, remaining voltage, in flight
        newest: newest voltage, current and remaining share [V, A, -]
        first: first remaining share
    """

    t: float = -np.inf
    scale: float = 0.0
    highest: float = 0.0
    information: np.ndarray = msgspec.field(default_factory=lambda: np.diag(_PRIOR_STD**-2.0))
    weighted: np.ndarray = msgspec.field(default_factory=lambda: _PRIOR_MEAN * _PRIOR_STD**-2.0)
    squares: float = 0.0
    n: int = 0
    used: float = 0.0
    moments: np.ndarray = msgspec.field(default_factory=lambda: np.zeros(5))
    voltage_moments: np.ndarray = msgspec.field(default_factory=lambda: np.zeros(5))
    newest: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    first: float = np.nan

    def update(self, t: np.ndarray, rows: np.ndarray, v: np.ndarray, wind: np.ndarray) -> None:
        """Update with new rows.

        Args:
            t: their times, rising, (n,) [s since 1970]
            rows: voltage, current, remaining share, (n, 3); the latter two nan where not reported
            v: ground velocity at these times, NED, (n, 3) [m/s]; nan: unknown
            wind: north and east, (2,) [m/s]
        """
        for time, (voltage, current, remaining), velocity in zip(t.tolist(), rows.tolist(), v, strict=True):
            step = time - self.t
            if not step > 0.0 or not (isfinite(current) and isfinite(remaining) and voltage > 0.0):
                continue
            if isfinite(self.first) and remaining > self.newest[2] + 3 * _QUANTUM:  # another battery
                self.used, self.first = 0.0, np.nan
                self.moments[:], self.voltage_moments[:] = 0.0, 0.0
            if not isfinite(self.first):
                self.first = remaining
            elif step < _MAX_STEP_S:
                self.used += current * step
            self.t, self.newest = time, (voltage, current, remaining)
            self.moments += (1.0, self.used, remaining, self.used**2, self.used * remaining)
            self._add_power(voltage * current, velocity, wind)
            if voltage * current > _MIN_POWER_SHARE * self.highest:
                self.voltage_moments += (1.0, remaining, voltage, remaining**2, remaining * voltage)

    def _add_power(self, power: float, v: np.ndarray, wind: np.ndarray) -> None:
        self.highest = max(self.highest, power)
        if not (power > _MIN_POWER_SHARE * self.highest and np.isfinite(v).all()):
            return
        self.scale = self.scale or power
        x = power_features(v[None], wind)[0]
        y = power / self.scale
        deviation = y - float(x @ self.coefficients)
        self.information += np.outer(x, x) / _SCATTER**2
        self.weighted += x * y / _SCATTER**2
        self.squares, self.n = self.squares + min(deviation**2, 1.0), self.n + 1

    @property
    def coefficients(self) -> np.ndarray:
        """Return the coefficients of the power over `scale`, (5,)."""
        return np.linalg.solve(self.information, self.weighted)

    @property
    def scatter(self) -> float:
        """Return the standard deviation of one power over `scale` [-]."""
        return sqrt((self.squares + _SCATTER**2) / (self.n + 1))

    def charge(self, params: Mapping[str, float]) -> tuple[float, float]:
        """Return the share used by one ampere second and its standard deviation [1/A s]; nan unknown."""
        count, q, r, qq, qr = self.moments.tolist()
        spread = qq - q * q / count if count else 0.0
        mean, variance = np.nan, np.inf
        if count and self.first - self.newest[2] >= _MIN_QUANTA * _QUANTUM and spread > 0.0:
            mean = -(qr - q * r / count) / spread
            steps = (self.first - self.newest[2]) / _QUANTUM
            variance = (_QUANTUM**2 / 12.0) * count / spread / steps
        capacity = next((params[name] for name in _CAPACITY if params.get(name, 0.0) > 0.0), np.nan)
        if isfinite(capacity):
            prior = 1.0 / (3.6 * capacity)
            weight = (_CHARGE_STD * prior) ** -2.0
            own = 1.0 / variance
            mean = (weight * prior + own * (mean if own else 0.0)) / (weight + own)
            variance = 1.0 / (weight + own)
        return (mean, sqrt(variance)) if mean > 0.0 else (np.nan, np.nan)

    @property
    def voltage_slope(self) -> float:
        """Return the fall of the voltage from full to empty, at the same load [V]."""
        count, r, voltage, rr, r_voltage = self.voltage_moments.tolist()
        prior, std = (share * self.newest[0] for share in _SLOPE_SHARE)
        if not count:
            return prior
        noise = (0.02 * self.newest[0]) ** 2  # of a voltage by its load [V2]
        own = max(rr - r * r / count, 0.0) / noise / _CORRELATION_S
        mean = (r_voltage - r * voltage / count) / max(rr - r * r / count, 1e-9)
        return max((own * mean + prior * std**-2) / (own + std**-2), 0.0)

    def mean_voltage(self) -> float:
        """Return the voltage in flight at the newest remaining share [V]."""
        count, r, voltage = self.voltage_moments[:3].tolist()
        if not count:
            return self.newest[0]
        return float(voltage / count + self.voltage_slope * (self.newest[2] - r / count))

    def remaining_after(
        self, v: np.ndarray, dt: np.ndarray, wind: np.ndarray, params: Mapping[str, float]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the remaining share after each part of a flight and its standard deviation, (n,) each; nan unknown.

        Args:
            v: ground velocity of each part, NED, (n, 3) [m/s]
            dt: its duration, (n,) [s]
            wind: north and east, (2,) [m/s]
            params: autopilot parameters, of which the capacity is used
        """
        k, k_std = self.charge(params)
        if not isfinite(k) or self.n < _MIN_ROWS:
            return np.full(len(v), np.nan), np.full(len(v), np.nan)
        x, coefficients = power_features(v, wind), self.coefficients
        power = self.scale * np.maximum(x @ coefficients, 0.1)
        voltage, slope = self.mean_voltage(), self.voltage_slope
        remaining, share = np.empty(len(v)), self.newest[2]
        for i, (watts, time) in enumerate(zip(power.tolist(), dt.tolist(), strict=True)):
            share -= k * time * watts / max(voltage + slope * (share - self.newest[2]), 0.5 * voltage)
            remaining[i] = share
        used = self.newest[2] - remaining
        mean_x = np.cumsum(x * dt[:, None], axis=0)
        time = np.cumsum(dt)
        effective = np.linalg.inv(self.information) * (self.scatter / _SCATTER) ** 2 * _CORRELATION_S
        energy_variance = np.einsum("ni,ij,nj->n", mean_x, effective, mean_x)
        energy_variance += self.scatter**2 * 2.0 * _CORRELATION_S * time
        by_power = k * self.scale / voltage * np.sqrt(energy_variance)
        std = np.sqrt(by_power**2 + (k_std / k * used) ** 2 + _QUANTUM**2 / 6.0)  # both shares are reported in steps
        return remaining, std


def power_features(v: np.ndarray, wind: np.ndarray) -> np.ndarray:
    """Return the factors of the power coefficients at ground velocities (n, 3) in a wind (2,), (n, 5)."""
    u = np.hypot(v[:, 0] - wind[0], v[:, 1] - wind[1]) / _SPEED_SCALE
    climb = -v[:, 2]
    return np.column_stack([np.ones(len(v)), u**2, u**3, np.maximum(climb, 0.0), np.maximum(-climb, 0.0)])
