"""A loopback router and a synthetic fleet on it, as gateway and workers would speak: started by the bench.

    python -m tests.bench.viewing.feeder tcp/127.0.0.1:17447 --uavs 1000 --hz 10

UAV 0 flies east at `PROBE_M_S` from `HOME`, where it is heard first of all: its place in the picture tells when it
was published. Everybody else circles. Prints the time it began, once everybody was heard.
"""

import argparse
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from fleet.bus.codec import EncodedMessage, Stamp, encode
from fleet.bus.session import Bus, connect, open_router
from fleet.contract import (
    Alert,
    AlertKind,
    Array,
    Cause,
    DiagnosisOutcome,
    FleetRow,
    FleetState,
    Mismatch,
    Model,
    Outcome,
    Prediction,
    Rows,
    Sample,
    Status,
    TwinState,
    Verdict,
)
from fleet.frames import Origin, to_geodetic

HOME = Origin(473977420, 85455940, 488_000)
PROBE_M_S = 20.0
STAMP = Stamp(1, 0xFEED)
AHEAD = np.concatenate([np.arange(0.0, 61.0), np.arange(64.0, 181.0, 4.0)])
PARTS = 10  # of a period: they are not heard all at once
WIDTHS = {"attitude": 6, "imu": 6, "velocity": 3, "air": 3, "servo": 8, "command": 5}


class World:
    """Where everybody is at any time: arrays of n."""

    def __init__(self, n: int, begin: float, rotor_share: float = 0.0) -> None:
        r = np.random.default_rng(10)
        self.n, self.begin = n, begin
        half = 250 * np.sqrt(n)
        self.centre = np.stack([r.uniform(-half, half, n), r.uniform(-half, half, n), -r.uniform(60, 220, n)], axis=-1)
        self.radius, self.speed = r.uniform(120, 420, n), r.uniform(12, 20, n)
        self.rotors = (np.arange(n) > 0) & (np.arange(n) % 10 < 10 * rotor_share)  # multirotors: slow, small circles
        self.radius, self.speed = (
            np.where(self.rotors, part * x, x) for part, x in ((0.2, self.radius), (0.4, self.speed))
        )
        self.rate, self.phase = self.speed / self.radius * r.choice([-1, 1], n), r.uniform(0, 2 * np.pi, n)
        luck = r.random(n)
        states = np.where(
            luck < 0.3, TwinState.VERIFIED, np.where(luck < 0.38, TwinState.IDENTIFYING, TwinState.PREDICTING)
        )
        self.states = [TwinState(state) for state in states]
        self.states[0] = TwinState.PREDICTING
        self.wrong = set(np.flatnonzero((luck > 0.975) & (np.arange(n) > 0)).tolist())  # a mismatch was named
        self.horizon = r.uniform(12, 58, n)

    def ned(self, who: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Give the places of some (k,) at times (m,): NED from HOME, (k, m, 3) [m]."""
        angle = self.phase[who, None] + self.rate[who, None] * t
        ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1) * self.radius[who, None, None]
        at = self.centre[who, None] + ring
        at[who == 0] = np.stack([0 * t, PROBE_M_S * (t - self.begin), 0 * t - 100.0], axis=-1)
        return at


def samples(world: World, who: np.ndarray, t: float) -> list[Sample]:
    """Make one message of each with one row of every kind."""
    at = world.ned(who, np.array([t - 0.05, t, t + 0.05]))
    place = to_geodetic(HOME, at[:, 1])
    v = (at[:, 2] - at[:, 0]) / 0.1
    psi = np.arctan2(v[:, 1], v[:, 0])
    when = Array.of([t], "<f8")
    told = {name: np.zeros((len(who), width)) for name, width in WIDTHS.items()}
    told["attitude"][:, 0], told["attitude"][:, 2] = np.arctan(world.speed[who] * world.rate[who] / 9.81), psi
    told["velocity"][:], told["air"][:, 0] = v, world.speed[who]
    found = []
    for k, uav in enumerate(who.tolist()):
        rows = {name: Rows(when, Array.of(values[k : k + 1])) for name, values in told.items()}
        position = Rows(when, Array.of(place[k : k + 1], "<i4"))
        leg = Rows(when, Array.of([[3.0]])) if int(t * 10) % 10 == uav % 10 else None
        found.append(Sample(uav=uav, t=t, position=position, leg=leg, **rows))
    return found


def slowly(world: World, who: np.ndarray, t: float) -> list[Status | Prediction | Model]:
    """Make what each says once a second, and its model every fifth."""
    paths = world.ned(who, t + AHEAD)
    cross = 1.5 + 0.55 * AHEAD**1.25
    ahead, tube = Array.of(AHEAD), Array.of(np.stack([1.6 * cross, cross, 0.4 * cross], axis=-1))
    found: list[Status | Prediction | Model] = []
    for k, uav in enumerate(who.tolist()):
        vehicle = "multirotor" if world.rotors[uav] else "fixed_wing"
        found.append(Status(uav=uav, t=t, mode="AUTO", armed=True, autopilot="ardupilot", vehicle=vehicle))
        state = world.states[uav]
        if state is not TwinState.IDENTIFYING:
            origin = tuple(to_geodetic(HOME, paths[k, 0]).tolist())
            path = Array.of(paths[k] - paths[k, 0])
            told = {
                "ahead": ahead,
                "path": path,
                "prediction_region_half_axes": tube,
                "horizon_s": float(world.horizon[uav]),
            }
            told |= {"method": "dynamics", "coverage": 0.91, "coverage_n": 412, "origin": origin, "seq": 3}
            found.append(Prediction(uav=uav, t=t, state=state, **told))
        if int(t) % 5 == uav % 5:
            found.append(_model(uav, t, well=state is not TwinState.IDENTIFYING))
    return found


def _model(uav: int, t: float, *, well: bool) -> Model:
    fit = dict.fromkeys(("u", "w", "q", "theta", "phi", "p", "r", "v"), 90.0 if well else 45.0)
    outcome = Outcome.VERIFIED if well else Outcome.INSUFFICIENT_DATA
    verdict = Verdict(outcome=outcome, sentence=f"uav-{uav}: mean fit {fit['u']:.0f} %", fit=fit, horizon_s=8.0)
    return Model(uav=uav, t=t, method="dynamics", verdict=verdict, active_verdict=verdict if well else None)


def begin(world: World, bus: Bus) -> None:
    """Say what is said once: the probe's place first, then mismatches and alerts."""
    for message in samples(world, np.array([0]), world.begin):
        bus.publish(message)
    for uav in sorted(world.wrong):
        spans = ((world.begin - 20.0, world.begin + 1e6),)
        cause = Cause(name="thrust_loss", channel="thrust", segments=spans)
        said = {"outcome": DiagnosisOutcome.NAMED, "causes": (cause,), "sentence": "thrust is lost", "adapted": True}
        bus.publish(Mismatch(uav=uav, t=world.begin, **said), STAMP)
        if uav % 3 == 0:
            bus.publish(Alert(uav=uav, t=world.begin, kind=AlertKind.SHORT_HORIZON, sentence="short"), STAMP)


def publish(world: World, bus: Bus, hz: float, stop: threading.Event) -> float:
    """Speak until told to stop; give how many samples of each were published per second."""
    parts = np.array_split(np.arange(world.n), PARTS)
    due, turn = time.time(), 0
    while not stop.is_set():
        who = parts[turn % PARTS]
        t = time.time()
        bus.put_all([EncodedMessage(Sample, one.uav, encode(one), one.t) for one in samples(world, who, t)])
        second = turn // PARTS % max(round(hz), 1)
        for message in slowly(world, who[who % max(round(hz), 1) == second], t):
            bus.publish(message, None if isinstance(message, Status) else STAMP)
        if turn % (PARTS * round(hz)) == 0:
            for part in np.array_split(np.arange(world.n), 4):
                rows = tuple(FleetRow(uav=u, state=world.states[u], verdict="", epoch=1) for u in part.tolist())
                bus.publish(FleetState(t=t, rows=rows), STAMP)
        turn, due = turn + 1, due + 1 / (hz * PARTS)
        stop.wait(max(due - time.time(), 0.0))
    return turn / PARTS / (time.time() - world.begin)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("router")
    parser.add_argument("--uavs", type=int, default=1000)
    parser.add_argument("--hz", type=float, default=10.0)
    parser.add_argument("--multirotors", type=float, default=0.0, metavar="SHARE", help="of the fleet (0)")
    args = parser.parse_args()
    stop = threading.Event()
    router = open_router(args.router)
    with connect(args.router) as bus:
        print("open", flush=True)
        sys.stdin.readline()  # the bench says when the feed begins
        world = World(args.uavs, time.time(), args.multirotors)
        begin(world, bus)
        print(world.begin, flush=True)
        with ThreadPoolExecutor(1) as pool:
            speaker = pool.submit(publish, world, bus, args.hz, stop)
            sys.stdin.readline()  # and when it ends
            stop.set()
            print(speaker.result(), flush=True)
    router.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
