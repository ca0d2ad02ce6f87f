"""Made-up flights with known answers: telemetry rows, linear closed-loop flights, pretend flights as messages."""

from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import msgspec
import numpy as np

from fleet.bus.codec import decode, encode
from fleet.contract import COLUMNS, Array, Item, Message, Prediction, Rows, Sample, Status
from fleet.frames import Origin, to_geodetic, wrap
from fleet.simulator.flight.drive import to_tlog
from fleet.simulator.flight.uav import SimulatedUav
from fleet.telemetry.recording.recordings import replay_messages
from fleet.window import Window
from twin_worker.evaluation.replay import run_offline
from twin_worker.identification.linear.linear_model import AXES, INPUTS, STATES, AxisModel, prior
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.twin.step import Twin, advance

T0 = 1_700_000_000.0
DT = 0.04
HERE = Origin(470_000_000, 80_000_000, 500_000)
HZ = {"attitude": 25.0, "servo": 20.0, "velocity": 10.0, "position": 10.0, "air": 10.0, "command": 5.0, "leg": 1.0}
ROUTE = ("dynamics", "hybrid", "both")  # methods that fly a route with an identified model
SPEED = 22.0  # trim of the linear flights [m/s]
Laid = dict[str, tuple[np.ndarray, np.ndarray]]


def rows(t, x, dtype: str = "<f8") -> Rows:
    return Rows(t=Array.of(t, "<f8"), x=Array.of(x, dtype))


def sample(uav: int = 1, t: float | None = None, **kinds) -> Sample:
    """One message, as new as its newest row; each kind is a pair of times and values."""
    if t is None:
        t = max([at for times, _ in kinds.values() for at in times if np.isfinite(at) and at < 1e12], default=T0)
    return Sample(uav=uav, t=t, **{name: rows(*pair) for name, pair in kinds.items()})


def turn(seconds: float, *, rate: float = 0.2, Va: float = 20.0, wind=(0.0, 0.0), psi: float = 2.0, bank: float = 0.3):
    """Rows of a level turn at a constant rate: everything about it is known. Kind -> (t, x)."""
    t = {name: T0 + np.arange(0, seconds, 1 / hz) for name, hz in HZ.items()}

    def heading(at: np.ndarray) -> np.ndarray:
        return psi + rate * (at - T0)

    def track(at: np.ndarray) -> np.ndarray:
        s, h = at - T0, heading(at)
        if rate == 0.0:
            n, e = Va * s * np.cos(psi), Va * s * np.sin(psi)
        else:
            n, e = Va / rate * (np.sin(h) - np.sin(psi)), -Va / rate * (np.cos(h) - np.cos(psi))
        return np.column_stack([n + wind[0] * s, e + wind[1] * s, np.full(len(s), -100.0)])

    def ground(at: np.ndarray) -> np.ndarray:
        h = heading(at)
        return np.column_stack([Va * np.cos(h) + wind[0], Va * np.sin(h) + wind[1], np.zeros(len(h))])

    still, wide = {name: np.zeros(len(at)) for name, at in t.items()}, np.full(len(t["servo"]), 1500.0)
    angles = [still["attitude"] + bank, still["attitude"], wrap(heading(t["attitude"]))]
    x = {
        "attitude": np.column_stack([*angles, still["attitude"], still["attitude"], still["attitude"] + rate]),
        "servo": np.column_stack([wide] * 8),
        "velocity": ground(t["velocity"]),
        "position": to_geodetic(HERE, track(t["position"])),
        "air": np.column_stack([Va + 1e-3 * np.sin(7.0 * t["air"]), still["air"] + 0.5, still["air"]]),  # not frozen
        "command": np.column_stack([still["command"] + bank, *[still["command"]] * 4]),
        "leg": np.ones((len(t["leg"]), 1)),
    }
    return {name: (t[name], x[name]) for name in HZ}


def without(laid: Laid, name: str, start: float, stop: float) -> Laid:
    """Lose the rows of one kind between two times since T0."""
    t, x = laid[name]
    keep = (t - T0 < start) | (t - T0 > stop)
    return laid | {name: (t[keep], x[keep])}


def messages(laid: Laid, uav: int = 1, every: float = 0.1) -> list[Sample]:
    """Cut rows into messages as the gateway would send them."""
    end = max(t[-1] for t, _ in laid.values())
    out = []
    for at in np.arange(T0, end + every, every):
        kinds = {name: (t >= at) & (t < at + every) for name, (t, _) in laid.items()}
        news = {name: (laid[name][0][k], laid[name][1][k]) for name, k in kinds.items() if k.any()}
        out += [sample(uav, float(at + every), **news)] if news else []
    return out


def remembered(heard: Iterable[Message]) -> TelemetryHistory:
    history = TelemetryHistory()
    for message in heard:
        assert isinstance(message, Sample)
        history.add(message)
    return history


def truth(U0: float = SPEED, W0: float = 1.0, grow: float = 0.0) -> tuple[AxisModel, AxisModel]:
    """Both axes of a made-up aircraft; `grow` pushes its poles outwards."""
    axes = []
    for name in AXES:
        D = prior(name, U0, W0, DT)[0]
        n, m = len(STATES[name]), len(INPUTS[name])
        D[:, :n] += grow * np.eye(n)
        trim = {"u": U0, "w": W0, "delta_t": 0.5}
        y_mean, u_mean = (np.array([trim.get(k, 0.0) for k in names[name]]) for names in (STATES, INPUTS))
        axes.append(AxisModel(STATES[name], INPUTS[name], D, y_mean, np.ones(n), u_mean, np.ones(m), DT))
    return axes[0], axes[1]


def standstill(axes: tuple[AxisModel, AxisModel]) -> tuple[AxisModel, AxisModel]:
    """Models that say nothing ever changes."""
    still = [np.hstack([np.eye(len(a.D)), np.zeros((len(a.D), a.D.shape[1] - len(a.D)))]) for a in axes]
    lon, lat = (
        AxisModel(a.states, a.inputs, D, a.y_mean, a.y_scale, a.u_mean, a.u_scale, a.dt)
        for a, D in zip(axes, still, strict=True)
    )
    return lon, lat


def linear_flight(seconds: float, *, seed: int = 0, lively: float = 1.0, noise: float = 0.0) -> Window:
    """Fly `truth()` under feedback with random commands; without noise its model is perfect."""
    rng = np.random.default_rng(seed)
    n = round(seconds / DT) + 1
    lon, lat = truth()
    x_lon, x_lat = np.zeros(4), np.zeros(5)
    x, u = np.zeros((n, 9)), np.zeros((n, 4))
    ask = np.zeros(4)
    for k in range(n):
        if k % 40 == 0:
            ask = lively * rng.standard_normal(4) * [0.4, 0.1, 0.1, 0.15]
        phi, theta = x_lat[0], x_lon[3]
        u[k] = [0.6 * (ask[0] - phi), 0.6 * (ask[1] - theta), ask[2], 0.5 + ask[3]]
        x[k] = [SPEED + x_lon[0], x_lat[4], 1.0 + x_lon[1], x_lat[2], x_lon[2], x_lat[3], phi, theta, x_lat[1]]
        bank = np.tan(phi) * np.sin(phi)
        x_lon = lon.D @ np.array([*x_lon, u[k, 1], u[k, 3] - 0.5, bank, 1.0])
        x_lat = lat.D @ np.array([*x_lat, u[k, 0], u[k, 2], 1.0])
    x += noise * rng.standard_normal(x.shape) * [1.0, 1.0, 1.0, 0.1, 0.1, 0.1, 0.03, 0.03, 0.03]
    t = T0 + DT * np.arange(n)
    v = np.column_stack([SPEED * np.cos(x[:, 8]), SPEED * np.sin(x[:, 8]), np.zeros(n)])
    return Window(t, x, u, np.cumsum(v * DT, axis=0), v, np.ones(n, bool), np.zeros(n, bool))


def item(seq: int, command: int = 16, north: float = 0.0, east: float = 0.0, **more) -> Item:
    """A mission item so many metres from HERE, 100 m above home."""
    lat, lon, _ = to_geodetic(HERE, np.array([north, east, 0.0]))
    what = {"alt_m": 500.0 if seq == 0 else 100.0, "frame": 0 if seq == 0 else 3} | more
    return Item(seq=seq, command=command, lat_e7=int(lat), lon_e7=int(lon), **what)


@lru_cache(maxsize=1)
def pretend(folder: Path, seconds: int = 100) -> tuple[Message, ...]:
    """One pretend aircraft over a lossy link, as the gateway would publish it: uav 1."""
    path = folder / "flight.tlog"
    to_tlog(path, [SimulatedUav(0, 3, wind=3.0, turbulence=2)], seconds=seconds, loss=0.01, seed=3)
    return tuple(replay_messages(path))


@lru_cache(maxsize=1)
def learnt(folder: Path) -> tuple[Twin, list[Message]]:
    """The twin at the end of that flight, and everything it published."""
    twins: dict[int, Twin] = {}
    results = list(run_offline(pretend(folder), twins))
    assert list(twins) == [1]
    return twins[1], results


def predictions(results: Iterable[Message]) -> list[Prediction]:
    return [r for r in results if isinstance(r, Prediction)]


def published(results: Iterable[Message]) -> list[Message]:
    """What reaches the bus: decoded from its bytes, every number finite (`held` is nan before any)."""
    out = []
    for result in results:
        back = decode(type(result), encode(result))
        assert numbers(msgspec.to_builtins(result, builtin_types=(bytes,))), result
        out.append(back)
    return out


def numbers(thing: object) -> bool:
    """Tell whether every number is finite."""
    if isinstance(thing, dict):
        if set(thing) == {"dtype", "shape", "data"}:
            return bool(np.isfinite(Array(**thing).numpy()).all())
        return all(numbers(value) for name, value in thing.items() if name != "coverage")
    if isinstance(thing, list | tuple):
        return all(map(numbers, thing))
    return not isinstance(thing, float) or np.isfinite(thing)


def drive(twin: Twin, heard: Iterable[Message]) -> list[Message]:
    return published(result for m in heard for result in advance(twin, (m,), max(m.t, twin.telemetry.history.newest)))


def shifted(heard: Iterable[Message], by: float, seconds: float) -> list[Message]:
    """The first seconds of the flight's samples, as if flown later."""
    out: list[Message] = []
    for m in heard:
        if isinstance(m, Sample) and m.t < T0 + seconds:
            rows = {n: getattr(m, n) for n in m.__struct_fields__ if n not in ("uav", "t")}
            moved = {n: r and msgspec.structs.replace(r, t=Array.of(r.t.numpy() + by, "<f8")) for n, r in rows.items()}
            out.append(Sample(uav=m.uav, t=m.t + by, **moved))
    return out


def columns(name: str) -> int:
    return len(COLUMNS[name])


def status(twin: Twin, **changes) -> Status:
    """What the gateway would say of the twin's aircraft now, changed."""
    assert twin.onboard.status is not None
    return msgspec.structs.replace(twin.onboard.status, t=twin.telemetry.history.newest, **changes)
