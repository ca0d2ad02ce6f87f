"""Flights of the yardstick: what is asked of the aircraft, what blows at it, and what the truth would have foretold."""

from dataclasses import dataclass

import numpy as np

from .flight import Case, Flight
from .yardstick import CRUISE, DT, SUB, Airframe, built, fly, replay, replay_each, trimmed

AIRCRAFT = 14
SECONDS, SETTLE_S = 240.0, 20.0
SIGMA = np.array([1.06, 1.06, 0.7])  # Dryden at low altitude [m/s]; Beard & McLain (2012) table 4.1


@dataclass(frozen=True)
class Weather:
    """One scenario.

    Attributes:
        gusts: share of SIGMA
        wind: mean wind [m/s]
        manoeuvres: course, height and airspeed are changed on the way
        doublets: so are the surfaces
    """

    gusts: float
    wind: float
    manoeuvres: bool = True
    doublets: bool = False


WEATHER = {
    "gust": Weather(1.0, 4.0),
    "calm": Weather(0.25, 0.0),
    "doublets": Weather(1.0, 4.0, doublets=True),
    "cruise": Weather(0.5, 3.0, manoeuvres=False),
}
_STEPS = (
    (7.0, 16.0, 0.7),
    (9.0, 20.0, 12.0),
    (9.0, 20.0, 2.0),
)  # of course, height, airspeed: every s .. s, by how much
_PULSES = ((0.16, 0.4), (0.12, 0.4), (0.16, 0.5), (0.15, 1.2))  # of each surface: height [-], length [s]


class Truth:
    """The true airframe of one flight: it knows the state, the surfaces and the mean wind, but no gust."""

    def __init__(self, airframe: Airframe, state: np.ndarray, moved: np.ndarray, u: np.ndarray, wind: np.ndarray):
        self._airframe, self._state, self._moved, self._u, self._wind = airframe, state, moved, u, wind

    def forecast(self, at: int, n: int) -> np.ndarray:
        u = self._u[at : at + n]
        return replay(self._airframe, self._state[at], self._moved[at], u, self._wind)[:, :9]

    def kstep(self, start: int, stop: int, k: int) -> np.ndarray:
        rows = slice(start, stop)
        state, moved, u = self._state[rows], self._moved[rows], self._u[rows]
        return replay_each(self._airframe, state, moved, u, self._wind, k)[:, :9]


def cases(scenario: str, seed: int) -> list[Case]:
    """Fly every aircraft of one scenario; aircraft k of one seed is the same in every scenario."""
    return [_case(scenario, seed, k) for k in range(AIRCRAFT)]


def _case(scenario: str, seed: int, k: int) -> Case:
    weather, rng = WEATHER[scenario], np.random.default_rng((seed, k))
    airframe = built(rng)
    n = int((SECONDS + SETTLE_S) / DT)
    x, trim = trimmed(airframe)
    commands, pushed = _commands(rng, n, weather.manoeuvres), _pushed(rng, n, weather.doublets)
    towards = rng.uniform(-np.pi, np.pi)
    wind = weather.wind * np.array([np.cos(towards), np.sin(towards)])
    x[:2] += wind  # it flies north, level
    noise, white = rng.standard_normal((n, 11)), rng.standard_normal((n * SUB, 3))
    flown = fly(airframe, x, trim, commands, pushed, wind, weather.gusts * SIGMA, noise, white)
    state, seen, u, moved = (values[int(SETTLE_S / DT) :] for values in flown)
    t = DT * np.arange(len(u))
    flight = Flight(
        name=f"{scenario}-{k}",
        uav=k,
        dt=DT,
        t=t,
        x=np.ascontiguousarray(seen[:, :9]),
        u=u,
        Va=seen[:, 9].copy(),
        ok=np.ones(len(u), bool),
        b=airframe.b,
    )
    return Case(flight, Truth(airframe, state, moved, u, wind))


def _commands(rng: np.random.Generator, n: int, manoeuvres: bool) -> np.ndarray:
    """Draw course, height and airspeed wanted, (n, 3); the course wanders, the others return."""
    out = np.tile([0.0, 100.0, CRUISE], (n, 1))
    for column, (soon, late, step) in enumerate(_STEPS if manoeuvres else ()):
        t, base = rng.uniform(0, 6), out[0, column]
        while t < n * DT:
            start = base if column else out[int(t / DT), column]
            out[int(t / DT) :, column] = start + step * rng.standard_normal()
            t += rng.uniform(soon, late)
    return out


def _pushed(rng: np.random.Generator, n: int, doublets: bool) -> np.ndarray:
    """Draw what is added to every surface, (n, 4)."""
    out = np.zeros((n, 4))
    for column, (height, length) in enumerate(_PULSES if doublets else ()):
        t = rng.uniform(1, 8)
        while t < n * DT - 5:
            i, width = int(t / DT), int(length / DT * rng.uniform(0.7, 1.5))
            push = height * rng.choice([-1, 1])
            out[i : i + width, column] += push
            out[i + width : i + 2 * width, column] -= push
            t += rng.uniform(8, 14)
    return out
