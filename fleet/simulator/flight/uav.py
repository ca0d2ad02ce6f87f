"""One simulated aircraft: flight dynamics, sensors, autopilot and MAVLink interface."""

from collections.abc import Mapping, Sequence
from math import pi, sin
from types import MappingProxyType

import numpy as np

from fleet import mission as legs_of
from fleet.autopilots import laws
from fleet.autopilots.common import controller_state as memory
from fleet.autopilots.common.parameter_vector import W_E, W_N
from fleet.contract import Item
from fleet.frames import G, Origin, to_geodetic
from fleet.simulator.faults.carried import Carried
from fleet.simulator.faults.fault import Fault
from fleet.simulator.flight.mavlink import MOST_AIRCRAFT, TICK_HZ, Ground, Voice
from fleet.simulator.flight.mavlink_messages import DIALECTS, RECORDED, Flight
from fleet.simulator.flight.tuning import tuned
from fleet.simulator.vehicle.altered import altered
from fleet.simulator.vehicle.jsbsim import Aircraft, Gusts
from fleet.simulator.vehicle.missions import HOME, Start, mission
from fleet.simulator.vehicle.sensors import Estimate, Heights, Sensors, Servos, WindEstimate
from fleet.simulator.vehicle.situation import Situation, Weather
from fleet.simulator.vehicle.types import TYPES

DT = 1 / TICK_HZ
_INNER, _OUTER = 2, 10  # attitude loop at 50 Hz, guidance at 10 Hz [ticks]
_LEGS_AHEAD = 200
_LAWS = {"ardupilot": "arduplane", "px4": "px4"}
JITTER_S = 0.001  # jitter of onboard time stamps [s]
_GROUND_M = 3.0  # height above home below which the flight ends


class PretendUav:
    """Simulated aircraft on a mission; `step` advances it and returns telemetry, `receive` returns replies."""

    def __init__(
        self,
        uav_id: int,
        seed: int,
        *,
        wind: float = 4.0,
        turbulence: int = 2,
        origin: Origin = HOME,
        autopilot: str = "ardupilot",
        aircraft: str = "small",
        plan: tuple[tuple[Item, ...], Start] | None = None,
        more: Mapping[str, float] = MappingProxyType({}),
        faults: Sequence[Fault] = (),
        situation: Situation | None = None,
    ):
        """Initialise one aircraft in flight.

        Args:
            uav_id: from 0; the MAVLink system id is `uav_id` + 1
            seed: with `uav_id` the seed of all random draws; aircraft of one seed share the mean wind
            wind: mean wind at 100 m [m/s]
            turbulence: MIL-F-8785C severity, 0..7
            origin: home, origin of the NED frame
            autopilot: control law and MAVLink dialect, ardupilot or px4
            aircraft: name in `types.TYPES`
            plan: mission and start state; None: random
            extra_params: autopilot parameters that override its own
            faults: faults of the aircraft
            setup: conditions of the flight; None: drawn from the seed
        Raises:
            ValueError: when `uav_id` is outside the MAVLink range.
        """
        if not 0 <= uav_id < MOST_AIRCRAFT:
            most = MOST_AIRCRAFT - 1
            raise ValueError(f"uav-{uav_id}: found id {uav_id}, expected 0..{most} (MAVLink ids); fly fewer aircraft")
        own = int(np.random.SeedSequence((seed, uav_id)).generate_state(1)[0])
        if situation is None:
            kind = altered(aircraft) if faults else TYPES[aircraft]
            weather = Weather(wind, np.random.default_rng((seed, 5)).uniform(-pi, pi), turbulence)
            plan = plan or mission(own, kind.cruise, origin, kind.field, autopilot)
            situation = Situation(own, kind, plan, weather)
        rng = np.random.default_rng((situation.flight, 4))
        self.uav_id, self.origin, self.situation = uav_id, origin, situation
        self._law = _LAWS[autopilot]
        self._first = legs_of.FIRST.get(autopilot, 1)
        self.items, start = situation.plan
        self.params = {**tuned(own, autopilot, aircraft), **more}
        self.boot_s = float(rng.uniform(60, 600))  # time since boot at simulation start [s]
        self.tick = 0
        self.down = False  # reached the ground
        self._wind = situation.weather.wind(rng, DT * _OUTER)
        examined = situation.examined
        self._sensors = Sensors(rng, DT * _INNER, np.random.default_rng((own, 9)) if examined else None)
        self._wind_hat = WindEstimate(np.random.default_rng((situation.flight, 8)), DT * _OUTER)
        self._heights = Heights(np.random.default_rng((situation.flight, 10)), DT * _INNER) if examined else None
        self._jitter = np.random.default_rng((situation.flight, 11)) if examined else None
        self._voice = Voice(uav_id + 1, self.items, self.params, RECORDED if examined else DIALECTS[autopilot])
        gusts = Gusts(situation.flight, situation.weather.w20_fps)
        self.aircraft = Aircraft(origin, own, situation.weather.severity, situation.kind, gusts)
        blowing = self._wind.step(-start.p[2])
        self._believed = self._wind_hat.measure(blowing)
        self._phi_c = 0.0
        self._theta_c, delta_e, self._delta_t = self.aircraft.start(start.p, start.psi, situation.kind.cruise, blowing)
        self.carried = Carried(faults, self.aircraft, DT, DT * _INNER) if faults else None
        self.pulses = Servos.pulses(0.0, delta_e, 0.0, self._delta_t)
        self.now: Estimate = self._measure()
        self._engage(start.seq)

    def _engage(self, seq: int) -> None:
        """Initialise the autopilot on item `seq`."""
        par, _ = laws.parameters(self._law, self.params, self.origin.alt_mm * 1e-3 - self.now.p[2])
        self._par = laws.blown(par, *self._believed)
        self._legs, start = self._route(seq)
        e = self.now
        self._ctl = laws.init(self._par, self._legs, 0, start, e.p, e.v, e.euler, e.Va, self._theta_c, self._delta_t)

    def _route(self, seq: int) -> tuple[np.ndarray, np.ndarray]:
        """Convert the mission from item `seq` to legs; return them and the start of the first."""
        more = {"params": self.params, "limit": _LEGS_AHEAD, "first": self._first}
        way = legs_of.route(self.items, seq=seq, origin=self.origin, **more)  # type: ignore[arg-type]
        return way.legs, way.start

    def step(self, t: float) -> list[bytes]:
        """Advance to `t` [s] since simulation start and return the frames sent meanwhile."""
        frames: list[bytes] = []
        while self.tick < round(t * TICK_HZ) and not self.down:
            frames += self._tick()
        return frames

    def hear(self, data: bytes) -> list[bytes]:
        """Process bytes from the ground and return the replies."""
        return self._voice.hear(data, self.boot_s + self.tick * DT)

    def introduce(self) -> list[bytes]:
        """Return the frames for the start of a recording: version, mission, parameters."""
        questions = Ground(self.uav_id + 1).questions(len(self.items))
        answers = [frame for question in questions for frame in self.hear(question)]
        return answers + self._voice.stream(len(self.params))

    @property
    def leg(self) -> np.ndarray:
        """Current leg, columns as in `fleet.mission`."""
        return self._legs[int(self._ctl[memory.LEG])]

    def _tick(self) -> list[bytes]:
        if self.tick % _OUTER == 0:
            self._weather()
        if self.tick % _INNER == 0:
            self._control()
        if self.carried is not None:
            self.carried.press(self.tick * DT)
            self.aircraft.drive(*self.carried.move(self.tick * DT, Servos.commands(self.pulses)))
        frames = self._voice.telemetry(self.tick, self._flight)
        self.aircraft.step()
        self.tick += 1
        return frames

    def _weather(self) -> None:
        """Update the wind and its estimate."""
        height = -float(self.now.p[2])
        blowing = (*self._wind.step(height), 0.0)
        if self.carried is not None:
            w_n, w_e, w_d = blowing + self.carried.wind(self.tick * DT, height)
            blowing = float(w_n), float(w_e), float(w_d)
        self._believed = self._wind_hat.measure(blowing[:2])
        self.aircraft.blow(*blowing)

    def _measure(self) -> Estimate:
        """Return the state estimate including faults."""
        truth = self.aircraft.truth()
        e = self._sensors.measure(truth)
        if self._heights is not None:
            e = self._heights.measure(e, truth)
        return e if self.carried is None else self.carried.sense(self.tick * DT, e)

    def _control(self) -> None:
        """Measure, run the autopilot, set the servos."""
        e = self.now = self._measure()
        self.down = not -e.p[2] > _GROUND_M
        if self.tick % _OUTER == 0:
            Va_dot = float(e.force[0]) - G * sin(e.euler[1])
            self._par[[W_N, W_E]] = self._believed
            self._phi_c, self._theta_c, self._delta_t = laws.guide(
                self._ctl, self._par, self._legs, e.p, e.v, e.euler, e.Va, Va_dot, DT * _OUTER
            )
            if self._ctl[memory.LEG] >= len(self._legs) - 2:
                self._renew()
        delta_a, delta_e, delta_r = laws.stabilise(
            self._ctl, self._par, self._phi_c, self._theta_c, e.euler, e.rates, e.Va, DT * _INNER
        )
        commands = (delta_a, delta_e, delta_r, self._delta_t)
        if self.situation.pilot is not None:
            more = self.situation.pilot(self.tick * DT)
            commands = (delta_a + more[0], delta_e + more[1], delta_r + more[2], self._delta_t + more[3])
        self.pulses = Servos.pulses(*commands)
        self.aircraft.drive(*Servos.commands(self.pulses))

    def _renew(self) -> None:
        """Extend the legs of the endless mission without changing the controller state."""
        self._legs, _ = self._route(int(self.leg[legs_of.SEQ]))
        self._ctl[memory.LEG] = 0

    def _flight(self) -> Flight:
        e, leg = self.now, self.leg
        target = leg[legs_of.P_N : legs_of.P_D + 1] - e.p
        commanded = leg[legs_of.VA_C] if leg[legs_of.VA_C] > 0 else self.situation.kind.cruise
        place = to_geodetic(self.origin, e.p)
        late = 0.0 if self._jitter is None else float(self._jitter.uniform(-JITTER_S, JITTER_S))
        return Flight(
            t=self.boot_s + self.tick * DT + late,
            now=e,
            place=(int(place[0]), int(place[1]), int(place[2])),
            height=float(-e.p[2]),
            pulses=self.pulses,
            delta_t=self._delta_t,
            phi_c=self._phi_c,
            theta_c=self._theta_c,
            target=(float(target[0]), float(target[1])),
            alt_error=float(laws.height_demand(self._ctl, self._par, self._legs, e.p, e.v) + e.p[2]),
            Va_error=float(commanded - e.Va),
            xtrack_error=self._xtrack(),
            seq=int(leg[legs_of.SEQ]),
            total=len(self.items),
            home=(self.origin.lat_e7, self.origin.lon_e7, self.origin.alt_mm),
            wind=self._believed,
        )

    def _xtrack(self) -> float:
        """Return the distance to the right of the line, or outside the circle [m]."""
        e, leg, ctl = self.now, self.leg, self._ctl
        centre = leg[legs_of.P_N : legs_of.P_D]
        if leg[legs_of.KIND] != legs_of.WAYPOINT:
            radius = abs(leg[legs_of.RADIUS])
            return float(np.hypot(*(e.p[:2] - centre)) - radius)
        a = ctl[[memory.PREV_N, memory.PREV_E]]
        line, way = centre - a, e.p[:2] - a
        return float((line[0] * way[1] - line[1] * way[0]) / max(np.hypot(*line), 1e-3))
