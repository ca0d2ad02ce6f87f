"""A pretend gateway and worker on the bus: plausible messages of N UAVs, for working on the viewer and for its tests.

python -m tests.support.pretend_feed --uavs 8 --router tcp/127.0.0.1:7447
"""

import argparse
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from fleet.access.entry import ROUTER
from fleet.access.knock import accepts_connections
from fleet.bus.codec import Stamp
from fleet.bus.session import Bus, connect, open_router
from fleet.cli import stop_on_signal
from fleet.contract import (
    Alert,
    AlertKind,
    Array,
    Cause,
    Controller,
    DiagnosisOutcome,
    Event,
    FleetRow,
    FleetState,
    Item,
    Link,
    Mismatch,
    Mission,
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
from tests.support.memory_bus import MemoryBus
from viewer.store.store import FleetStore

HOME = Origin(473977420, 85455940, 488_000)
AHEAD = np.arange(0.0, 40.5, 0.5)
HOSTILE = "<img src=x onerror=window.pwned=1>"
STAMP = Stamp(1, 0xABCD)
T = 1_700_000_000.0


class PretendUav:
    """One aircraft on a closed smooth path; everything about it is a function of time."""

    def __init__(self, uav: int, *, hostile: bool = False) -> None:
        r = np.random.default_rng(100 + uav)
        self.uav, self.text = uav, HOSTILE if hostile else ""
        ring = 320.0 * np.sqrt(uav)
        self.centre = np.array([ring * np.cos(2.4 * uav), ring * np.sin(2.4 * uav), -r.uniform(90, 220)])
        self.a, self.b = r.uniform(180, 320), r.uniform(110, 200)
        self.turn, self.phase, self.rot = r.choice([-1, 1]), r.uniform(0, 2 * np.pi), r.uniform(0, np.pi)
        self.Va = r.uniform(13, 19)
        self.rate = self.turn * self.Va / np.sqrt((self.a**2 + self.b**2) / 2)
        self.horizon = r.uniform(12, 28)
        self.drift = r.normal(0, 0.02, 3)
        self.state = TwinState.PREDICTING if uav % 7 < 4 else TwinState.VERIFIED
        self.state = {1: TwinState.IDENTIFYING, 5: TwinState.LINK_LOST}.get(uav % 8, self.state)

    def ned(self, t: np.ndarray | float) -> np.ndarray:
        """Give positions at times (n,) [s]: NED from HOME, (n, 3) [m]."""
        angle = self.phase + self.rate * np.asarray(t, float)
        x, y = self.a * np.cos(angle), self.b * np.sin(angle)
        c, s = np.cos(self.rot), np.sin(self.rot)
        return self.centre + np.stack([c * x - s * y, s * x + c * y, -18 * np.sin(2 * angle)], axis=-1)

    def sample(self, t0: float, t: float) -> Sample:
        """Give the rows between two times, 10 Hz."""
        at = np.arange(np.floor(t0 * 10) + 1, np.floor(t * 10) + 1) / 10
        v = (self.ned(at + 0.05) - self.ned(at - 0.05)) / 0.1
        acc = (self.ned(at + 0.5) - 2 * self.ned(at) + self.ned(at - 0.5)) / 0.25
        psi = np.arctan2(v[:, 1], v[:, 0])
        phi = np.arctan((np.cos(psi) * acc[:, 1] - np.sin(psi) * acc[:, 0]) / 9.81)
        theta = np.arcsin(np.clip(-v[:, 2] / np.linalg.norm(v, axis=1), -1, 1))
        zero = np.zeros_like(psi)
        speed = self.Va + 0.4 * np.sin(at)
        return Sample(
            uav=self.uav,
            t=t,
            position=rows(at, to_geodetic(HOME, self.ned(at)), "<i8"),
            attitude=rows(at, np.stack([phi, theta, psi, zero, zero, zero], axis=-1)),
            velocity=rows(at, v),
            air=rows(at, np.stack([speed, 0.5 + zero, -v[:, 2]], axis=-1)),
        )

    def mission(self, t: float) -> Mission:
        """Give home, eight waypoints round the path, a loiter and a jump back."""
        angles = np.linspace(0, 2 * np.pi, 9)[:-1] / self.rate - self.phase / self.rate
        places = to_geodetic(HOME, self.ned(angles))
        alts = -self.ned(angles)[:, 2]
        items = [Item(seq=0, command=16, frame=0, lat_e7=HOME.lat_e7, lon_e7=HOME.lon_e7, alt_m=HOME.alt_mm * 1e-3)]
        items += [
            Item(seq=k + 1, command=16, lat_e7=int(p[0]), lon_e7=int(p[1]), alt_m=float(alts[k]))
            for k, p in enumerate(places)
        ]
        middle = to_geodetic(HOME, self.centre[None])[0]
        items.append(
            Item(
                seq=9, command=18, param3=70, lat_e7=int(middle[0]), lon_e7=int(middle[1]), alt_m=float(-self.centre[2])
            )
        )
        items.append(Item(seq=10, command=177, param1=1, param2=-1))
        return Mission(uav=self.uav, t=t, items=tuple(items), seq=3, complete=True, sentence=self.text)

    def status(self, t: float) -> Status:
        lost = self.state is TwinState.LINK_LOST
        return Status(
            uav=self.uav,
            t=t,
            link=Link.LOST if lost else Link.LIVE,
            mode=self.text or "AUTO",
            armed=True,
            autopilot="ardupilot",
            vehicle="fixed_wing",
            received=int(t % 1e5 * 120),
            missed=17,
            sentence=self.text,
        )

    def model(self, t: float) -> Model:
        names = ("u", "w", "q", "theta", "phi", "p", "r", "v")
        good = self.state is not TwinState.IDENTIFYING
        base = 88 if good else 45
        verdict = Verdict(
            outcome=Outcome.VERIFIED if good else Outcome.INSUFFICIENT_DATA,
            sentence=self.text
            or (
                f"uav-{self.uav}: mean fit {base} % over 8.0 s, threshold 75 %"
                if good
                else f"uav-{self.uav}: window has 41 samples, subspace order 8 needs 120; wait 1.6 s"
            ),
            fit={name: float(base + 5 * np.sin(t / 9 + k)) for k, name in enumerate(names)},
            fit_persistence={name: 20.0 + 3 * k for k, name in enumerate(names)},
            horizon_s=8.0,
            threshold=75.0,
            attempts=3,
        )
        force = verdict if good else None
        return Model(uav=self.uav, t=t, method="paper", verdict=verdict, active_verdict=force, window_s=40.0)

    def prediction(self, t: float, coast: float) -> Prediction | None:
        """Give the path ahead, a little wrong, the more the farther; None while identifying."""
        if self.state is TwinState.IDENTIFYING:
            return None
        error = self.drift * (AHEAD[:, None] ** 1.7) * np.array([1, 1, 0.3])
        cross = 1.5 + 0.55 * AHEAD**1.25
        tube = np.stack([1.6 * cross, cross, 0.4 * cross], axis=-1)
        return Prediction(
            uav=self.uav,
            t=t,
            state=self.state,
            method="paper",
            law=self.text or "arduplane: L1 + TECS",
            origin=tuple(HOME),
            ahead=Array.of(AHEAD),
            path=Array.of(self.ned(t + AHEAD) + error),
            prediction_region_half_axes=Array.of(tube),
            horizon_s=float(self.horizon + np.sin(t / 7)),
            coverage=0.91,
            coverage_n=412,
            coast_s=coast,
            seq=3,
            sentence=self.text,
            event=Event.PARAMETERS,
            event_t=t // 60 * 60,
            event_text=self.text or "the autopilot flies with other parameters",
            controller=Controller(
                law=self.text or "arduplane: L1 + TECS",
                received={self.text or "NAVL1_PERIOD": 17.0, "AIRSPEED_CRUISE": 22.0},
                identified={"WP_RADIUS": 83.5},
                default={"TECS_TIME_CONST": 5.0},
            ),
        )

    def alert(self, t: float) -> Alert | None:
        text = "horizon 4 s is shorter than the 10 s to the next leg"
        return Alert(uav=6, t=t, kind=AlertKind.SHORT_HORIZON, sentence=text) if self.uav == 6 else None

    def mismatch(self, t: float) -> Mismatch | None:
        """Give a named effect since a minute ago, of one UAV, and of a hostile one all its words."""
        if self.uav != 2 and not self.text:
            return None
        cause = Cause(
            name=self.text or "control_effectiveness_loss",
            channel=self.text or "actuator",
            surface=self.text or "aileron",
            segments=((t - 60.0, t),),
            parameters={self.text or "loss": 0.5},
            sigma={self.text or "loss": 0.03},
        )
        return Mismatch(
            uav=self.uav,
            t=t,
            outcome=DiagnosisOutcome.NAMED,
            causes=(cause,),
            fit_before=1.94,
            fit_after=1.07,
            force_before=0.41,
            force_after=0.22,
            adapted=True,
            sentence=self.text or "control_effectiveness_loss of the aileron after 120 s (loss 0.5 ± 0.03)",
        )

    def row(self) -> FleetRow:
        return FleetRow(
            uav=self.uav, state=self.state, verdict=self.text, worker="000000000000abcd", epoch=1, t10_s=17.5, t10_n=9
        )


def rows(t: np.ndarray, x: np.ndarray, dtype: str = "<f4") -> Rows:
    return Rows(t=Array.of(t, "<f8"), x=Array.of(x, dtype))


class PretendFleet:
    """Publishes what is due; answers queries as gateway and worker do."""

    def __init__(self, bus: Bus, uavs: int, *, hostile: int | None = None) -> None:
        self.uavs = [PretendUav(uav, hostile=uav == hostile) for uav in range(uavs)]
        self._bus, self._last, self._second, self._t = bus, 0.0, 0, 0.0
        for kind, make in {
            Mission: lambda uav: uav.mission(self._t),
            Status: lambda uav: uav.status(self._t),
            Model: lambda uav: uav.model(self._t),
            Prediction: lambda uav: uav.prediction(self._t, 0.0),
            Alert: lambda uav: uav.alert(self._t),
            Mismatch: lambda uav: uav.mismatch(self._t),
        }.items():
            bus.declare_queryable(kind, self._reply(make))

    def _reply(self, make: Any) -> Any:
        def reply(uav: int | None, *_: Any) -> Iterator[tuple[Any, Stamp]]:
            for one in self.uavs:
                if uav in (None, one.uav) and (message := make(one)) is not None:
                    yield message, STAMP

        return reply

    @staticmethod
    def _coast(one: PretendUav, t: float, lost_since: float) -> float:
        return max(t - lost_since, 0.0) if one.state is TwinState.LINK_LOST else 0.0

    def advance(self, t: float, *, lost_since: float = 1e18) -> None:
        """Publish what is due until `t`; link-lost UAVs fall silent at `lost_since`."""
        t0, self._last, self._t = self._last or t - 0.2, t, t
        for one in self.uavs:
            if one.state is not TwinState.LINK_LOST or t < lost_since:
                self._bus.publish(one.sample(t0, t))
        if int(t) == self._second:
            return
        first, self._second = self._second == 0, int(t)
        for one in self.uavs:
            self._bus.publish(one.status(t))
            if (message := one.prediction(t, self._coast(one, t, lost_since))) is not None:
                self._bus.publish(message, STAMP)
            if first or self._second % 5 == one.uav % 5:
                self._bus.publish(one.model(t), STAMP)
        if first:
            for one in self.uavs:
                self._bus.publish(one.mission(t))
                for found in (one.alert(t), one.mismatch(t)):
                    if found is not None:
                        self._bus.publish(found, STAMP)
        self._bus.publish(FleetState(t=t, rows=tuple(one.row() for one in self.uavs)), STAMP)


class Clock:
    """Monotonic time that only the test moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def feed_of(clock: Clock, uavs: int = 3, *, hostile: int | None = None) -> tuple[FleetStore, PretendFleet, MemoryBus]:
    bus = MemoryBus()
    feed = FleetStore(bus, clock)
    fleet = PretendFleet(bus, uavs, hostile=hostile)
    fleet.advance(T)
    return feed, fleet, bus


def fields(message: Prediction) -> dict:
    return {name: getattr(message, name) for name in message.__struct_fields__}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--uavs", type=int, default=8)
    parser.add_argument("--router", default=ROUTER)
    parser.add_argument("--hostile", type=int)
    args = parser.parse_args()
    stop = stop_on_signal()
    router = None if accepts_connections(args.router) else open_router(args.router)
    try:
        with connect(args.router) as bus:
            fleet = PretendFleet(bus, args.uavs, hostile=args.hostile)
            start = time.time()
            while not stop.wait(0.1):
                fleet.advance(time.time(), lost_since=start + 20)
    finally:
        if router is not None:
            router.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
