"""A made-up aircraft flown by our own simulation, with any effects at work: many flights side by side, all seeded."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet.effects import Body, Effect, Flow, Parameter, Stage
from twin_worker.diagnosis.data.card import AircraftCard, FaultHypothesis
from twin_worker.diagnosis.data.flight import DT, FlightData
from twin_worker.diagnosis.model.baseline import ActuatorTiming, Baseline
from twin_worker.diagnosis.model.equations import RHO_0
from twin_worker.diagnosis.model.simulate import STATE, Runs, Simulation

LONG_S = 80.0
CARD = AircraftCard(
    name="made up",
    body=Body(mass=115.0, S=4.0, b=5.5, c=0.75, D=0.95),
    inertia=(65.0, 59.0, 107.0, 0.0),
    throw=((0.3, 0.3), (0.45, 0.45), (0.3, 0.3)),
)
COEF = {  # of a light aircraft at half its size
    "alpha": (-0.067, -0.24, -0.03, 0.08, 0.0, -0.015),
    "beta": (0.0, -2.4, -0.25, 0.45, 0.45),
    "X": (-0.1, -0.15, -0.02, 0.12, -0.15),
    "T": (100.0, 500.0, 0.0, 0.0, -250.0, 0.0),
    "M": (0.18, 0.35, -9.5, -0.8, 0.0, 0.05, 0.09, 0.04),
    "L": (0.0, -0.09, -0.45, 0.02, 0.2, 0.025, -0.2, -0.04, 0.0),
    "N": (0.0, 0.048, -0.024, -0.073, -0.002, -0.044, 0.005, 0.019, 0.0),
}
CRAFT = Baseline(
    CARD, {k: np.array(x) for k, x in COEF.items()}, speed=33.0, timing=ActuatorTiming(servo=0.06, engine=0.25)
)

# from when [s]: bank [deg], height [m], airspeed [m/s]; hops off the ground, a climbing turn, slow, slower, a descent
COURSE = np.array(
    [
        *((0, 0, 0, 27), (4, 10, 4, 26), (7, -10, 0, 26), (12, 10, 4, 26), (15, -10, 0, 26), (21, 0, 10, 28)),
        *((24, 0, 25, 30), (26, 35, 45, 30), (34, -35, 50, 31), (43, 0, 50, 25), (48, 25, 50, 22.5)),
        *((56, -15, 45, 21.5), (60, 0, 20, 27), (63, 40, 12, 32), (69, -30, 0, 33), (72, 10, 0, 32), (76, 0, 4, 32)),
    ],
    float,
)

GUSTS_MPS = 0.15
DAYS = 256
_SINES = 14
_DRAWN = np.random.default_rng(6).uniform(0.0, 1.0, (2, DAYS, 3, _SINES))
_OMEGA = np.tan(0.5 * np.pi * (np.arange(_SINES) + 0.1 + 0.8 * _DRAWN[0]) / _SINES) / 4.0
_PHASE = 2 * np.pi * _DRAWN[1]


def _gusts(flow: Flow, sigma: np.ndarray, day: np.ndarray) -> dict[str, np.ndarray]:
    """Add gusts of a Dryden spectrum, other ones every day."""
    day = day.astype(int)
    w = np.sin(_OMEGA[day] * np.asarray(flow.t)[:, None, None] + _PHASE[day]).sum(axis=2)
    return dict(zip(("w_n", "w_e", "w_d"), sigma * np.sqrt(2.0 / _SINES) * w.T, strict=True))


GUSTS = Effect(
    name="gusts_of_the_day",
    stage=Stage.AIR,
    channel="air",
    equation="as turbulence, but other ones every day",
    source="MIL-F-8785C 1980, section 3.7",
    parameters=(
        Parameter("sigma_mps", "m/s", "standard deviation", step=0.1, low=0.0, high=5.0),
        Parameter("day", "-", "which of the days", step=1.0, low=0.0, high=DAYS - 1.0),
    ),
    act=_gusts,
    examples=((0.1, 1.0), (0.2, 2.0), (0.3, 3.0)),
)


@dataclass(frozen=True)
class Plan:
    """One flight: its name, its seed, what is at work in it."""

    name: str
    seed: int
    guesses: tuple[FaultHypothesis, ...] = ()


class Hand:
    """Hold bank, height and airspeed along `COURSE` in all runs, and shake every control gently all the while."""

    def __init__(self, plans: Sequence[Plan], simulation: Simulation) -> None:
        self._simulation = simulation
        rng = [np.random.default_rng(plan.seed) for plan in plans]
        hertz = np.geomspace(0.1, 1.3, 9)
        self._omega = 2 * np.pi * hertz[:, None, None] * np.stack([r.uniform(0.93, 1.07, (9, 4)) for r in rng], axis=2)
        self._phase = np.stack([r.uniform(0, 2 * np.pi, (9, 4)) for r in rng], axis=2)
        self._size = np.array([0.07, 0.05, 0.08, 0.06])[:, None] * np.sqrt(2 / 9)
        self._mirror = np.array([1.0 if plan.seed % 2 else -1.0 for plan in plans])
        self._trim = np.tile([[0.07], [0.1]], len(plans))  # pitch [rad], elevator [-]
        self._throttle = np.full(len(plans), 0.5)

    def __call__(self, k: int, x: np.ndarray) -> np.ndarray:
        """Give commands, (4, runs)."""
        t = k * DT
        row = COURSE[np.searchsorted(COURSE[:, 0], t, side="right") - 1]
        Va = self._simulation.airspeed(x, self._simulation.start_times + t)
        phi, theta, h, up = x[6], x[7], x[9], -x[2]
        climb = np.clip(0.8 * (row[2] - h), -5.0, 4.0) - up
        self._trim[0] = np.clip(self._trim[0] + 0.02 * climb * DT, -0.2, 0.35)
        wrong = np.clip(self._trim[0] + 0.03 * climb, -0.3, 0.4) - theta
        self._trim[1] = np.clip(self._trim[1] - 0.8 * wrong * DT, -0.7, 0.5)
        slow = row[3] - Va
        self._throttle = np.clip(self._throttle + 0.02 * slow * DT, 0.35, 0.7)
        steady = np.stack(
            [
                0.8 * (self._mirror * np.radians(row[1]) - phi) - 0.15 * x[3],
                self._trim[1] - 1.2 * wrong + 0.3 * x[4],
                0.3 * x[5] - 0.3 * 9.81 / np.maximum(Va, 10.0) * np.sin(phi),
                self._throttle + 0.12 * slow,
            ]
        )
        u = steady + self._size * np.sin(self._omega * t + self._phase).sum(axis=0)
        return np.stack([*np.clip(u[:3], -1, 1), np.clip(u[3], 0.0, 1.0)])


def flown(plans: Sequence[Plan], base: Baseline = CRAFT, seconds: float = LONG_S) -> list[FlightData]:
    """Fly all plans side by side and give what was recorded of them."""
    day = [FaultHypothesis(GUSTS, "", (GUSTS_MPS, float(plan.seed))) for plan in plans]
    acting = [(gusts, *plan.guesses) for gusts, plan in zip(day, plans, strict=True)]
    simulation = Simulation(base, acting, np.zeros(len(plans)))
    start = np.zeros((len(STATE), len(plans)))
    start[0], start[7], start[9] = 29.0, 0.07, 1.0
    runs = simulation.simulate(start, Hand(plans, simulation), int(seconds / DT))
    return [recorded(plan, runs, i) for i, plan in enumerate(plans)]


def recorded(plan: Plan, runs: Runs, i: int) -> FlightData:
    """Give run i as an ordinary set of sensors tells it, faulty ones as the plan says."""
    x, f = runs.states[:, :, i], runs.force[:, :, i]
    n = len(x)
    t = np.arange(n) * DT
    rng = np.random.default_rng([plan.seed, 1])
    readings = dict(zip(STATE, x.T, strict=True)) | dict(zip(("a_x", "a_y", "a_z"), f.T, strict=True))
    readings["psi"] = np.unwrap(readings["psi"])
    readings["Va"] = runs.Va[:, i] * np.sqrt(runs.rho[:, i] / RHO_0)
    readings["baro"] = readings["h"].copy()
    noise = {"v_n": 0.05, "v_e": 0.05, "v_d": 0.05, "p": 0.002, "q": 0.002, "r": 0.002, "h": 0.05}
    noise |= {"a_x": 0.05, "a_y": 0.05, "a_z": 0.05, "Va": 0.25, "baro": 0.3}
    place = np.cumsum(x[:, :2], axis=0) * DT
    readings = {name: y + noise.get(name, 0.0) * rng.standard_normal(n) for name, y in readings.items()}
    for name in ("phi", "theta", "psi"):  # an estimator's attitude wanders by about 0.2 deg
        wander = np.sin(2 * np.pi * np.outer(t, rng.uniform(0.005, 0.02, 2)) + rng.uniform(0, 2 * np.pi, 2)).sum(axis=1)
        readings[name] = readings[name] + np.radians(0.1) * wander
    for guess in plan.guesses:
        if guess.effect.stage is Stage.SENSOR:
            par = [value * guess.onset.gate(t) for value in guess.par]
            readings |= guess.effect.act({"t": t, **readings}, *par, **({"of": guess.target} if guess.target else {}))
    ok = (t > 2.0) & (t < t[-1] - 1.5)
    return FlightData(plan.name, t, 0.0, readings, runs.commands[:, :, i], place, 0.0, ok, vane=True)
