"""Fresh flights of the project's own pretend aircraft in gusty wind, and its true airframe without the gusts.

JSBSim flies, the pretend autopilot steers by the errors of its sensors; no byte is sent. Flights take a while, so they
are kept in the folder that PARAUAV_BENCH_CACHE names, else in the user's cache folder.
"""

import hashlib
import os
from math import atan2, degrees, hypot
from pathlib import Path

import numpy as np

from fleet.frames import body_to_ned, ned_to_body
from fleet.process import private_files
from fleet.simulator.flight.uav import DT as TICK_S
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.jsbsim import Aircraft, Truth
from fleet.simulator.vehicle.missions import HOME
from fleet.simulator.vehicle.sensors import servo_commands
from fleet.simulator.vehicle.weather import FT, wind_at_20ft
from fleet.window import STATES

from .flight import Case, Flight, true_airspeed, unwrapped

UAVS = 10
SECONDS, SETTLE_S = 300.0, 15.0
WIND, TURBULENCE = 4.0, 2  # mean [m/s], severity: the weather that pretend aircraft usually fly in
_SPAN = 2.9  # [m]
_ROW = 4  # ticks per row
_EVERY = 10  # rows between two starts of the short horizons


def cases(seed: int) -> list[Case]:
    """Fly every aircraft, or read what was flown before with the same sources."""
    return [_case(seed, k) for k in range(UAVS)]


def _case(seed: int, k: int) -> Case:
    path = _folder() / f"pretend-{_sources()}-{seed}-{k}.npz"
    if path.is_file():
        with np.load(path) as file:
            kept = dict(file)
    else:
        kept = _fly(seed, k)
        np.savez(path, **kept)
    x, n = kept["measured"], len(kept["measured"])
    flight = Flight(
        name=f"pretend-{k}",
        uav=k,
        dt=_ROW * TICK_S,
        t=_ROW * TICK_S * np.arange(n),
        x=np.hstack([ned_to_body(*x[:, 3:6].T, x[:, :3]), x[:, 6:9], unwrapped(x[:, 3:6])]),
        u=np.array([servo_commands(tuple(pulses)) for pulses in kept["pulses"]]),
        Va=true_airspeed(x[:, 9], HOME.alt_mm * 1e-3 - kept["p"][:, 2]),
        ok=np.ones(n, bool),
        b=_SPAN,
    )
    return Case(flight, Replay(_own(seed, k), kept, flight))


def _own(seed: int, k: int) -> int:
    """Give the seed that the pretend aircraft draws its airframe from."""
    return int(np.random.SeedSequence((seed, k)).generate_state(1)[0])


def _fly(seed: int, k: int) -> dict[str, np.ndarray]:
    """Fly one aircraft; keep a row every 0.04 s: measured, pulses, truth, wind."""
    uav = SimulatedUav(k, seed, wind=WIND, turbulence=TURBULENCE)
    kept: dict[str, list] = {name: [] for name in ("measured", "pulses", "p", "v", "euler", "rates", "wind")}
    first = int(SETTLE_S / TICK_S)
    for tick in range(first, first + int(SECONDS / TICK_S), _ROW):
        uav.step(tick * TICK_S)
        truth = uav.aircraft.truth()
        uav.step((tick + 1) * TICK_S)  # in this tick it measures that, and answers
        if uav.crashed:
            raise ValueError(f"pretend-{k}: came down after {tick * TICK_S:.0f} s, expected it to fly; choose a seed")
        now = uav.estimate
        kept["measured"].append(np.concatenate([now.v, now.euler, now.rates, [now.Va]]))
        kept["pulses"].append(uav.pulses)
        for name in ("p", "v", "euler", "rates"):
            kept[name].append(getattr(truth, name))
        kept["wind"].append([uav.aircraft[f"atmosphere/wind-{way}-fps"] * FT for way in ("north", "east")])
    return {name: np.array(rows) for name, rows in kept.items()}


def _folder() -> Path:
    given = os.environ.get("PARAUAV_BENCH_CACHE")
    return private_files.ensure_private_folder(
        Path(given).absolute() if given else private_files.cache_folder() / "bench", "PARAUAV_BENCH_CACHE"
    )


def _sources() -> str:
    """Hash what makes a flight, so that an edit flies anew."""
    import fleet

    root = Path(fleet.__file__).parent
    digest = hashlib.sha256(Path(__file__).read_bytes())
    for folder in ("simulator", "autopilots"):
        for path in sorted((root / folder).rglob("*.*")):
            if path.suffix in (".py", ".xml"):
                digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


class Replay(Aircraft):
    """The true airframe of one flight, put into its true state and flown by the recorded pulses without gusts."""

    def __init__(self, own: int, kept: dict[str, np.ndarray], flight: Flight) -> None:
        super().__init__(HOME, own)
        self._kept, self._flight = kept, flight

    def forecast(self, at: int, n: int) -> np.ndarray:
        return self.fly(at, n, self.mean_wind(at, n))

    def mean_wind(self, at: int, n: int) -> np.ndarray:
        """Return the true mean wind of rows at .. at + n, north and east, without gusts, (2,) [m/s]."""
        return np.asarray(self._kept["wind"][at : at + n].mean(axis=0))

    def fly(
        self, at: int, n: int, wind: np.ndarray, start: np.ndarray | None = None, gusts: int | None = None
    ) -> np.ndarray:
        """Fly rows at .. at + n under the recorded inputs, (n, 9).

        Args:
            at, n: first row and number of rows
            wind: north and east, the direction it blows to, (2,) [m/s]
            start: state at the first row, u v w over the ground, (9,); None: the true one
            gusts: seed of gusts like those of the flight, which start at those of the run before; None: no gusts
        """
        self._place(at, wind, start, gusts)
        told = []
        for k in range(at, at + n):
            told.append(self.truth())
            self.set_controls(*self._flight.u[k])
            for _ in range(_ROW):
                self.set_wind(*wind)
                self.step()
        return self._rows(told, self._flight.x[at, 8])

    def kstep(self, start: int, stop: int, k: int) -> np.ndarray:
        """Predict row i + k from the truth of row i, for every 10th i; the rest is nan."""
        out = np.full((stop - start - k, len(STATES)), np.nan)
        for i in range(0, len(out), _EVERY):
            out[i] = self.forecast(start + i, k + 1)[k]
        return out

    def _place(self, at: int, wind: np.ndarray, start: np.ndarray | None, gusts: int | None) -> None:
        """Put it into a state at row `at`, its servos and motor where the commands before have left them."""
        kept, fdm = self._kept, self._fdm
        p, v, euler, rates = (kept[name][at] for name in ("p", "v", "euler", "rates"))
        if start is not None:
            rates, euler = start[3:6], start[6:9]
            v = body_to_ned(*euler[:, None], start[None, :3])[0]
        fdm["simulation/randomseed"] = gusts or 0
        fdm["atmosphere/turb-type"] = 0 if gusts is None else 3
        fdm["atmosphere/turbulence/milspec/windspeed_at_20ft_AGL-fps"] = wind_at_20ft(TURBULENCE)
        fdm["atmosphere/turbulence/milspec/severity"] = float(TURBULENCE)
        fdm["ic/terrain-elevation-ft"] = HOME.alt_mm * 1e-3 / FT
        fdm["ic/lat-geod-deg"] = HOME.lat_e7 * 1e-7 + degrees(p[0] / self._per_rad[0])
        fdm["ic/long-gc-deg"] = HOME.lon_e7 * 1e-7 + degrees(p[1] / self._per_rad[1])
        fdm["ic/h-sl-ft"] = (HOME.alt_mm * 1e-3 - p[2]) / FT
        fdm["ic/vw-mag-fps"] = hypot(*wind) / FT
        fdm["ic/vw-dir-deg"] = degrees(atan2(wind[1], wind[0])) % 360
        for name, value in zip(("phi", "theta", "psi-true"), (*euler[:2], euler[2] % (2 * np.pi)), strict=True):
            fdm[f"ic/{name}-rad"] = value
        for name, value in zip("ned", v, strict=True):
            fdm[f"ic/v{name}-fps"] = value / FT
        for name, value in zip("pqr", rates, strict=True):
            fdm[f"ic/{name}-rad_sec"] = value
        self.set_controls(*self._flight.u[max(at - 2, 0)])  # about one lag of the servos ago
        fdm.set_trim_status(True)  # lags pass through
        fdm.run_ic()
        fdm.set_trim_status(False)
        self.set_wind(*wind)

    def _rows(self, told: list[Truth], psi: float) -> np.ndarray:
        """Lay the truth as a flight's states, the heading unwrapped next to `psi` [rad]."""
        euler = unwrapped(np.array([truth.euler for truth in told]))
        euler[:, 2] += 2 * np.pi * np.round((psi - euler[0, 2]) / (2 * np.pi))
        body = ned_to_body(*euler.T, np.array([truth.v for truth in told]))
        return np.hstack([body, np.array([truth.rates for truth in told]), euler])
