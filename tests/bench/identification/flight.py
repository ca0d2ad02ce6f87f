"""`Flight`: what every method is given, whatever the aircraft and wherever it was recorded."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from fleet.window import INPUTS, STATES

AXES = {"lon": ("u", "w", "q", "theta"), "lat": ("phi", "psi", "p", "r", "v")}
AXIS_INPUTS = {"lon": ("delta_e", "delta_t"), "lat": ("delta_a", "delta_r")}
STATE_COLUMNS = {axis: [STATES.index(name) for name in names] for axis, names in AXES.items()}
INPUT_COLUMNS = {axis: [INPUTS.index(name) for name in names] for axis, names in AXIS_INPUTS.items()}
ANGLES = tuple(STATES.index(name) for name in ("phi", "theta", "psi"))
SEA_LEVEL_RHO = 1.225  # [kg/m3]


@dataclass(frozen=True)
class Flight:
    """One flight on one grid.

    Attributes:
        name: what it is called, unique
        uav: number of the aircraft
        dt: sample time [s]
        t: time, (n,) [s]
        x: u v w p q r phi theta psi as measured; u v w the velocity over *ground* turned into the body (FRD), angles
            unwrapped, (n, 9) [m/s, rad/s, rad]
        u: delta_a delta_e delta_r delta_t as commanded, -1..1 of full throw and 0..1; positive aileron rolls right,
            positive elevator pitches up, positive rudder yaws right, (n, 4) [-]
        Va: true airspeed as measured, nan without, (n,) [m/s]
        ok: really measured, (n,) bool
        b: wing span [m]
    """

    name: str
    uav: int
    dt: float
    t: np.ndarray
    x: np.ndarray
    u: np.ndarray
    Va: np.ndarray
    ok: np.ndarray
    b: float

    def __len__(self) -> int:
        return len(self.t)

    def part(self, start: int, stop: int) -> "Flight":
        """Cut rows `start` to `stop`; the rest is not there for whoever gets it."""
        s = slice(start, stop)
        return replace(self, t=self.t[s], x=self.x[s], u=self.u[s], Va=self.Va[s], ok=self.ok[s])


class Model(Protocol):
    """What identification gives: both axes at once."""

    def forecast(self, known: Flight, u: np.ndarray) -> np.ndarray:
        """Run free from the end of `known` under the inputs u (n, 4): rows (n, 9), the first right after `known`."""
        ...

    def kstep(self, flight: Flight, k: int) -> np.ndarray:
        """Predict row i + k from rows up to i and inputs up to i + k, for every i: (n - k, 9), aligned with x[k:]."""
        ...


class Method(Protocol):
    """One way to identify, made anew for every flight, so that it may remember within it."""

    def identify(self, known: Flight, start: int) -> Model:
        """Identify on the rows from `start` to the end of `known`; earlier rows are the past of the same flight."""
        ...


@dataclass(frozen=True)
class Case:
    """One flight, and what the truth would have predicted, where the truth is known."""

    flight: Flight
    oracle: "Oracle | None" = None


class Oracle(Protocol):
    """The true airframe from the true state through the mean wind: the ceiling for every method."""

    def forecast(self, at: int, n: int) -> np.ndarray:
        """Fly rows at .. at + n under the recorded inputs without gusts, (n, 9)."""
        ...

    def kstep(self, start: int, stop: int, k: int) -> np.ndarray:
        """Do the same for k rows from every start, as `Model.kstep`; nan where nothing is said."""
        ...


def true_airspeed(indicated: np.ndarray, altitude: np.ndarray) -> np.ndarray:
    """Give true airspeed from what a pitot tube feels, Va sqrt(1.225 / rho(h)), h above sea level [m].

    Source: ISO 2533, rho = 1.225 (1 - 2.25577e-5 h)^4.2559.
    """
    return indicated * (1 - 2.25577e-5 * np.asarray(altitude)) ** (-4.2559 / 2)


def unwrapped(euler: np.ndarray) -> np.ndarray:
    """Unwrap angles (n, 3) [rad]."""
    return np.unwrap(euler, axis=0)
