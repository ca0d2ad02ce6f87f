"""One simulated aircraft: flight dynamics, sensors, autopilot and MAVLink interface."""

from collections.abc import Mapping, Sequence
from math import atan2, sin
from types import MappingProxyType

import numpy as np

from fleet import mission as legs_of
from fleet.autopilots import control_law as memory
from fleet.autopilots import laws
from fleet.autopilots.arduplane import l1, params
from fleet.autopilots.control_law import W_E, W_N
from fleet.autopilots.modes import TARGET_MODES, ModeSituation, mode_route
from fleet.contract import Item
from fleet.frames import G, Origin, to_geodetic, to_ned
from fleet.simulator.faults.carried import FaultSet
from fleet.simulator.faults.physics import Fault
from fleet.simulator.flight.mavlink import (
    MAX_AIRCRAFT,
    TICK_HZ,
    ItemRequest,
    MavlinkEndpoint,
    ModeRequest,
    SpeedRequest,
    ground_requests,
)
from fleet.simulator.flight.mavlink_messages import DIALECTS, ONBOARD_DIALECT, TelemetryState
from fleet.simulator.flight.modes import FlightMode
from fleet.simulator.flight.tuning import tuned_parameters
from fleet.simulator.vehicle.altered import instrumented_type
from fleet.simulator.vehicle.jsbsim import Aircraft
from fleet.simulator.vehicle.missions import HOME, StartState, draw_mission
from fleet.simulator.vehicle.sensors import Estimate, Sensors, servo_commands, servo_pulses
from fleet.simulator.vehicle.types import TYPES, FlightSetup, Weather
from fleet.simulator.vehicle.weather import GaussMarkov, fleet_wind_direction
from fleet.simulator.vehicle.wind_field import CoherentWind, LocalWind

DT = 1 / TICK_HZ
_INNER, _OUTER = 2, 10  # attitude loop at 50 Hz, guidance at 10 Hz [ticks]
_LEGS_AHEAD = 200
_LAWS = {"ardupilot": "arduplane", "px4": "px4"}
JITTER_S = 0.001  # jitter of onboard time stamps [s]
_WIND_STD, _WIND_S = np.full(2, 0.4), np.full(2, 60.0)  # error of the wind estimate, north and east [m/s, s]
_MIN_HEIGHT_M = 3.0  # height above home below which the flight ends


class SimulatedUav:
    """Simulated aircraft on a mission; `step` advances it and returns telemetry, `receive` returns replies.

    It enters another mode by command (DO_SET_MODE, SET_MODE, DO_REPOSITION) or by a failsafe while `link_lost`.
    """

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
        plan: tuple[tuple[Item, ...], StartState] | None = None,
        extra_params: Mapping[str, float] = MappingProxyType({}),
        faults: Sequence[Fault] = (),
        setup: FlightSetup | None = None,
        wind_field: CoherentWind | None = None,
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
            wind_field: wind of the whole fleet; None: mean wind and a drift of its own, as in the setup
        Raises:
            ValueError: when `uav_id` is outside the MAVLink range.
        """
        if not 0 <= uav_id < MAX_AIRCRAFT:
            max_id = MAX_AIRCRAFT - 1
            raise ValueError(f"uav-{uav_id}: found id {uav_id}, expected 0..{max_id} (MAVLink ids); fly fewer aircraft")
        aircraft_seed = int(np.random.SeedSequence((seed, uav_id)).generate_state(1)[0])
        if setup is None:
            kind = instrumented_type(aircraft) if faults else TYPES[aircraft]
            weather = Weather(wind, fleet_wind_direction(seed), turbulence)
            plan = plan or draw_mission(aircraft_seed, kind.cruise, origin, kind.geometry, autopilot)
            setup = FlightSetup(aircraft_seed, kind, plan, weather)
        rng = np.random.default_rng((setup.flight_seed, 4))
        self.uav_id, self.origin, self.setup = uav_id, origin, setup
        self._law = _LAWS[autopilot]
        self._first_item = legs_of.FIRST_ITEM.get(autopilot, 1)
        self.items, start = setup.mission
        self.params = {**tuned_parameters(aircraft_seed, autopilot, aircraft), **extra_params}
        self.boot_s = float(rng.uniform(60, 600))  # time since boot at simulation start [s]
        self.tick = 0
        self.crashed = False  # reached the ground
        self.silent = False  # sends no telemetry, which saves most of the time of a flight
        self.link_lost = False  # no link to the ground in any direction, the remote control included
        self.mode = FlightMode(autopilot, self.params)
        self._mission_seq = start.seq  # current mission item
        self._target: np.ndarray | None = None  # commanded point, NED, (3,) [m]
        self._speed: tuple[float, float] | None = None  # commanded airspeed, and that of the mission then [m/s]
        drift = setup.weather.wind(rng, DT * _OUTER)
        self._wind = drift if wind_field is None else LocalWind(wind_field, origin, DT * _OUTER)
        scale_rng = altitude_rng = self._jitter = None
        dialect = DIALECTS[autopilot]
        if setup.is_exam:
            scale_rng = np.random.default_rng((aircraft_seed, 9))
            altitude_rng = np.random.default_rng((setup.flight_seed, 10))
            self._jitter = np.random.default_rng((setup.flight_seed, 11))
            dialect = ONBOARD_DIALECT
        self._sensors = Sensors(rng, DT * _INNER, scale_rng, altitude_rng)
        wind_rng = np.random.default_rng((setup.flight_seed, 8))
        self._wind_error = GaussMarkov(wind_rng, _WIND_STD, _WIND_S, DT * _OUTER)
        self._endpoint = MavlinkEndpoint(uav_id + 1, self.items, self.params, dialect)
        gusts = (setup.flight_seed, setup.weather.w20_fps)
        self.aircraft = Aircraft(origin, aircraft_seed, setup.weather.severity, setup.kind, gusts)
        mean_wind = self._wind.step(start.p)
        self._wind_estimate = self._estimate_wind(mean_wind)
        self._phi_c = 0.0
        self._theta_c, delta_e, self._delta_t = self.aircraft.start(start.p, start.psi, setup.kind.cruise, mean_wind)
        self.fault_set = FaultSet(faults, self.aircraft, DT, DT * _INNER) if faults else None
        self.pulses = servo_pulses(0.0, delta_e, 0.0, self._delta_t)
        self.estimate: Estimate = self._measure()
        self._newest_state: TelemetryState | None = None
        self._engage(start.seq)

    def _engage(self, seq: int) -> None:
        """Initialise the autopilot on item `seq`."""
        par, _ = laws.parameters(self._law, self.params, self.origin.alt_mm * 1e-3 - self.estimate.p[2])
        self._par = laws.with_wind(par, *self._wind_estimate)
        self._legs, start = self._route(seq)
        e = self.estimate
        self._ctl = laws.init(self._par, self._legs, 0, start, e.p, e.v, e.euler, e.Va, self._theta_c, self._delta_t)

    def _route(self, seq: int) -> tuple[np.ndarray, np.ndarray]:
        """Convert the mission from item `seq` to legs; return them and the start of the first."""
        options = {"params": self.params, "limit": _LEGS_AHEAD, "first": self._first_item}
        route = legs_of.unroll_route(self.items, seq=seq, origin=self.origin, **options)  # type: ignore[arg-type]
        return route.legs, route.start

    def step(self, t: float) -> list[bytes]:
        """Advance to `t` [s] since simulation start and return the frames sent meanwhile."""
        frames: list[bytes] = []
        while self.tick < round(t * TICK_HZ) and not self.crashed:
            frames += self._tick()
        return frames

    def receive(self, data: bytes) -> list[bytes]:
        """Process bytes from the ground and return the replies; none arrive while the link is lost."""
        if self.link_lost:
            return []
        replies = self._endpoint.receive(data, self.boot_s + self.tick * DT)
        while self._endpoint.requests:
            request = self._endpoint.requests.popleft()
            if isinstance(request, ModeRequest):
                self._target = None if request.target is None else self._commanded_point(request.target)
                self.mode.command(request.mode)
                self._enter_mode()
            elif isinstance(request, SpeedRequest):
                self._speed = (request.speed, float(self.leg[legs_of.VA_C]))
                self._override_speed()
            elif isinstance(request, ItemRequest):
                self._begin_item(request.seq)
            else:
                self.items = request.items
                if self._first_item == 0:  # PX4 goes to the marked item
                    self._begin_item(request.seq or 0)
                elif self.mode.follows_mission:  # ArduPlane stays at its item
                    self._legs, start = self._route(self._mission_seq)
                    self._begin_legs(start if np.isfinite(start).all() else self.estimate.p)
        return replies

    def _begin_legs(self, start: np.ndarray) -> None:
        """Start the route at its first leg, from a point, NED, (3,) [m]."""
        self._ctl[memory.LEG] = 0
        laws.begin(self._ctl, self._par, self._legs, 0, start)
        self._override_speed()

    def _begin_item(self, seq: int) -> None:
        """Fly to mission item `seq` from here, now or when the mission mode is entered."""
        self._mission_seq = seq
        if self.mode.follows_mission:
            self._enter_mode()

    def _override_speed(self) -> None:
        """Apply a commanded airspeed to the legs before the next change of speed in the mission."""
        if self._speed is None or not self.mode.follows_mission:
            return
        k = int(self._ctl[memory.LEG])
        changes = np.flatnonzero(self._legs[k:, legs_of.VA_C] != self._speed[1])
        self._legs[k : k + int(changes[0]) if len(changes) else None, legs_of.VA_C] = self._speed[0]
        if len(changes):
            self._speed = None  # the mission changes it

    def _commanded_point(self, target: tuple[int, int, float]) -> np.ndarray:
        """Return a commanded point, latitude, longitude [1e-7 deg] and height above home [m], NED, (3,) [m]."""
        lat, lon, height = target
        alt_mm = self.origin.alt_mm + 1e3 * height
        return to_ned(self.origin, *(np.array([x], float) for x in (lat, lon, alt_mm)))[0]

    def _enter_mode(self) -> None:
        """Start the route of the present mode from here; speed and height controllers continue."""
        p, v = self.estimate.p, self.estimate.v
        if self.mode.follows_mission:
            self._legs, _ = self._route(self._mission_seq)
        else:
            home = np.zeros(3)
            situation = ModeSituation(self.origin, p, atan2(v[1], v[0]), p, home, self._target, self.items)
            route = mode_route(self._law, self.mode.name, situation, self.params, failsafe=self.mode.by_failsafe)
            if route is None:
                raise ValueError(f"uav-{self.uav_id}: mode {self.mode.name} is not simulated; choose another failsafe")
            self._legs = route.legs
        self._begin_legs(p)

    def initial_frames(self) -> list[bytes]:
        """Return the frames for the start of a recording: version, mission, parameters."""
        requests = ground_requests(self.uav_id + 1, len(self.items))
        replies = [frame for request in requests for frame in self.receive(request)]
        return replies + self._endpoint.stream_parameters(len(self.params))

    @property
    def controller(self) -> tuple[np.ndarray, np.ndarray]:
        """Return state and route of the autopilot's controller."""
        return self._ctl.copy(), self._legs

    @property
    def leg(self) -> np.ndarray:
        """Current leg, columns as in `fleet.mission`."""
        return self._legs[int(self._ctl[memory.LEG])]

    def _tick(self) -> list[bytes]:
        if self.tick % _OUTER == 0:
            self._update_wind()
        if self.tick % _INNER == 0:
            self._control()
        if self.fault_set is not None:
            self.fault_set.apply_to_physics(self.tick * DT)
            self.aircraft.set_controls(*self.fault_set.apply_to_commands(self.tick * DT, servo_commands(self.pulses)))
        frames = [] if self.silent or self.link_lost else self._endpoint.telemetry(self.tick, self._telemetry_state)
        self.aircraft.step()
        self.tick += 1
        return frames

    def _update_wind(self) -> None:
        """Update the wind and its estimate."""
        height = -float(self.estimate.p[2])
        wind = (*self._wind.step(self.estimate.p), 0.0)
        if self.fault_set is not None:
            w_n, w_e, w_d = wind + self.fault_set.wind(self.tick * DT, height)
            wind = float(w_n), float(w_e), float(w_d)
        self._wind_estimate = self._estimate_wind(wind[:2])
        self.aircraft.set_wind(*wind)

    def _estimate_wind(self, wind: tuple[float, float]) -> tuple[float, float]:
        error = self._wind_error.step()
        return wind[0] + float(error[0]), wind[1] + float(error[1])

    def _measure(self) -> Estimate:
        """Return the state estimate including faults."""
        e = self._sensors.measure(self.aircraft.truth())
        return e if self.fault_set is None else self.fault_set.apply_to_estimate(self.tick * DT, e)

    def _control(self) -> None:
        """Measure, run the autopilot, set the servos."""
        e = self.estimate = self._measure()
        self.crashed = not -e.p[2] > _MIN_HEIGHT_M
        if self.tick % _OUTER == 0:
            self._update_mode()
            Va_dot = float(e.force[0]) - G * sin(e.euler[1])
            self._par[[W_N, W_E]] = self._wind_estimate
            self._phi_c, self._theta_c, self._delta_t = laws.guide(
                self._ctl, self._par, self._legs, e.p, e.v, e.euler, e.Va, Va_dot, DT * _OUTER
            )
            if self.mode.follows_mission:
                self._mission_seq = int(self.leg[legs_of.SEQ])
                if self._ctl[memory.LEG] >= len(self._legs) - 2:
                    self._legs, _ = self._route(self._mission_seq)  # the mission is endless
                    self._ctl[memory.LEG] = 0
                    self._override_speed()
        delta_a, delta_e, delta_r = laws.stabilise(
            self._ctl, self._par, self._phi_c, self._theta_c, e.euler, e.rates, e.Va, DT * _INNER
        )
        delta_t = self._delta_t
        if self.setup.pilot is not None:
            a, b, r, t = self.setup.pilot(self.tick * DT)
            delta_a, delta_e, delta_r, delta_t = delta_a + a, delta_e + b, delta_r + r, delta_t + t
        self.pulses = servo_pulses(delta_a, delta_e, delta_r, delta_t)
        self.aircraft.set_controls(*servo_commands(self.pulses))

    def _update_mode(self) -> None:
        """Run the failsafes."""
        if not self.link_lost:
            self.mode.contact(self.tick * DT)
        elif self.mode.update(self.tick * DT):
            self._target = None
            self._enter_mode()

    def _telemetry_state(self) -> TelemetryState:
        time_jitter = 0.0 if self._jitter is None else float(self._jitter.uniform(-JITTER_S, JITTER_S))
        t = self.boot_s + self.tick * DT + time_jitter
        if self._newest_state is not None and self._newest_state.estimate is self.estimate:  # no control step since
            return self._newest_state._replace(t=t, wind=self._wind_estimate)
        e, leg = self.estimate, self.leg
        target = leg[legs_of.P_N : legs_of.P_D + 1] - e.p
        commanded = leg[legs_of.VA_C] if leg[legs_of.VA_C] > 0 else self.setup.kind.cruise
        position = to_geodetic(self.origin, e.p)
        self._newest_state = TelemetryState(
            t=t,
            estimate=e,
            position=(int(position[0]), int(position[1]), int(position[2])),
            height=float(-e.p[2]),
            pulses=self.pulses,
            delta_t=self._delta_t,
            phi_c=self._phi_c,
            theta_c=self._theta_c,
            target=(float(target[0]), float(target[1])),
            alt_error=float(laws.height_demand(self._ctl, self._par, self._legs, e.p, e.v) + e.p[2]),
            Va_error=float(commanded - e.Va),
            xtrack_error=self._xtrack(),
            seq=self._mission_seq,
            n_items=len(self.items),
            home=(self.origin.lat_e7, self.origin.lon_e7, self.origin.alt_mm),
            wind=self._wind_estimate,
            mode=self.mode.name,
            destination=self._destination(),
        )
        return self._newest_state

    def _destination(self) -> tuple[int, int, int] | None:
        """Return the point that a mode without mission flies to [1e-7 deg, 1e-7 deg, mm]; None: there is none."""
        if self.mode.follows_mission or self.mode.name not in TARGET_MODES:
            return None
        lat, lon, alt = to_geodetic(self.origin, self.leg[legs_of.P_N : legs_of.P_D + 1])
        return int(lat), int(lon), int(alt)

    def _xtrack(self) -> float:
        """Return the distance to the right of the line, or outside the circle [m]."""
        e, leg, ctl = self.estimate, self.leg, self._ctl
        centre = leg[legs_of.P_N : legs_of.P_D]
        if leg[legs_of.KIND] != legs_of.WAYPOINT:
            radius = abs(leg[legs_of.RADIUS])
            if radius == 0.0 and self._law == "arduplane":
                speed = ctl[memory.V_DEM] / self._par[params.EAS2TAS]
                radius = l1.circle_radius(self._par, abs(self._par[params.LOITER_RAD]), speed)
            return float(np.hypot(*(e.p[:2] - centre)) - radius)
        a = ctl[[memory.PREV_N, memory.PREV_E]]
        line, offset = centre - a, e.p[:2] - a
        return float((line[0] * offset[1] - line[1] * offset[0]) / max(np.hypot(*line), 1e-3))
