"""`Window`: an equally sampled section of one flight, with a mask of measured rows."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fleet.frames import ned_to_body

STATES = ("u", "v", "w", "p", "q", "r", "phi", "theta", "psi")
INPUTS = ("delta_a", "delta_e", "delta_r", "delta_t")
LONGEST_GAP = {"attitude": 0.5, "velocity": 1.0, "servo": 0.5, "position": 1.0}
"""Longest gap that is filled in telemetry of usual rates, by field of `Sample` [s]."""
MAX_GAP_S = 2.5  # longest gap that is filled at any rate: telemetry of 1 Hz with a lost row [s]
_LOST_ROW = 2.5  # gap across one lost row with jitter, in usual intervals [-]


def longest_gap(limit: float, interval: float) -> float:
    """Return the longest gap that is filled [s]: at low rates a lost row is no longer gap than the rate itself.

    Args:
        limit: value of `LONGEST_GAP` [s]
        interval: usual interval between rows [s]
    """
    return max(limit, min(_LOST_ROW * interval, MAX_GAP_S))


@dataclass(frozen=True)
class Window:
    """States and inputs of one aircraft on one time grid.

    Attributes:
        t: fleet time, (n,) [s since 1970]
        x: states in the order of `STATES`, velocities air-relative in FRD, angles unwrapped, (n, 9) [m/s, rad/s, rad]
        u: inputs in the order of `INPUTS`, (n, 4) [-]
        p: position, NED from the twin's origin, (n, 3) [m]
        v: velocity over ground, NED, (n, 3) [m/s]
        ok: measured or interpolated across a short gap, (n,) bool; rows with False are invalid
        filled: interpolated across lost samples, (n,) bool
    """

    t: np.ndarray
    x: np.ndarray
    u: np.ndarray
    p: np.ndarray
    v: np.ndarray
    ok: np.ndarray
    filled: np.ndarray

    @cached_property
    def over_ground(self) -> np.ndarray:
        """Return the states with u v w over the ground, (n, 9)."""
        y = self.x.copy()
        y[:, :3] = ned_to_body(y[:, 6], y[:, 7], y[:, 8], self.v)
        return y

    @property
    def dt(self) -> float:
        """Return the sample time [s]."""
        return float(self.t[1] - self.t[0])

    @property
    def seconds(self) -> float:
        """Return the length [s]."""
        return float(self.t[-1] - self.t[0])

    def __len__(self) -> int:
        return len(self.t)

    def __str__(self) -> str:
        return (
            f"{self.seconds:.1f} s at {1 / self.dt:.0f} Hz, {self.ok.mean():.0%} good, {self.filled.mean():.1%} filled"
        )

    def columns(self, names: tuple[str, ...]) -> np.ndarray:
        """Select states or inputs by name, (n, k)."""
        if all(name in STATES for name in names):
            return self.x[:, [STATES.index(name) for name in names]]
        phi = np.clip(self.x[:, STATES.index("phi")], -1.3, 1.3)
        bank = np.tan(phi) * np.sin(phi)  # pitch rate of a level turn: q = g / V tan(phi) sin(phi)
        available, table = (*STATES, *INPUTS, "bank"), np.column_stack([self.x, self.u, bank])
        return table[:, [available.index(name) for name in names]]

    def part(self, start: int, stop: int) -> "Window":
        """Return rows `start` to `stop` as a window."""
        s = slice(start, stop)
        return Window(self.t[s], self.x[s], self.u[s], self.p[s], self.v[s], self.ok[s], self.filled[s])
