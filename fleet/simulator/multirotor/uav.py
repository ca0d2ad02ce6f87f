"""One simulated multirotor: flight dynamics, sensors, autopilot and MAVLink interface.

It arms a few seconds after the start, flies its mission, lands, disarms, and starts again.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import hypot
from types import MappingProxyType
from typing import Any

import numpy as np

from fleet.frames import Origin, to_geodetic, to_ned
from fleet.simulator.flight.mavlink import (
    MAX_AIRCRAFT,
    TICK_HZ,
    ItemRequest,
    ModeRequest,
    SpeedRequest,
    ground_requests,
)
from fleet.simulator.multirotor import tasks
from fleet.simulator.multirotor.airframes import TYPES, draw_airframe
from fleet.simulator.multirotor.attitude import AttitudeController, attitude_gains
from fleet.simulator.multirotor.copter_guidance import CopterGuidance
from fleet.simulator.multirotor.messages import (
    DIALECTS,
    FULL_CURRENT,
    ONBOARD_DIALECTS,
    MultirotorEndpoint,
    MultirotorState,
)
from fleet.simulator.multirotor.missions import MultirotorMission, draw_mission
from fleet.simulator.multirotor.position import PositionController, Reference, position_gains
from fleet.simulator.multirotor.px4_guidance import Px4Guidance
from fleet.simulator.multirotor.rigid_body import RotorBody
from fleet.simulator.multirotor.tasks import Task, TaskSequence
from fleet.simulator.multirotor.tuning import motor_inputs, motor_pulses, tuned_parameters
from fleet.simulator.vehicle.missions import HOME
from fleet.simulator.vehicle.sensors import Estimate, Sensors
from fleet.simulator.vehicle.types import Weather
from fleet.simulator.vehicle.weather import fleet_wind_direction
from fleet.simulator.vehicle.wind_field import CoherentWind, LocalWind

DT = 1 / TICK_HZ
_OUTER = 2  # position control at 50 Hz [ticks]
_ARM_S, _REST_S = (2.0, 8.0), 15.0  # time on the ground before the first and before a later take-off [s]
_ENDURANCE_S = (900.0, 1800.0)  # time of a full battery at a load of `_HOVER_LOAD` [s]
_HOVER_LOAD = 0.3  # power of hover over full power, typical [-]
_CAPACITY_ERROR = (0.95, 1.1)  # capacity in the parameters over the true one [-]
_CAPACITY_NAMES = {"ardupilot": "BATT_CAPACITY", "px4": "BAT1_CAPACITY"}
_MISSION_MODES = {"ardupilot": "AUTO", "px4": "MISSION"}
_MODE_TASKS = {"RTL": tasks.RETURN, "LAND": tasks.LAND, "LOITER": tasks.HOLD, "BRAKE": tasks.HOLD, "GUIDED": tasks.HOLD}


class SimulatedMultirotor:
    """Simulated multirotor on a mission, with the interface of `SimulatedUav`."""

    def __init__(
        self,
        uav_id: int,
        seed: int,
        *,
        wind: float = 4.0,
        turbulence: int = 2,
        origin: Origin = HOME,
        autopilot: str = "ardupilot",
        aircraft: str = "quad",
        mission: MultirotorMission | None = None,
        extra_params: Mapping[str, float] = MappingProxyType({}),
        wind_field: CoherentWind | None = None,
        flight_seed: int | None = None,
    ):
        """Place one aircraft at its home.

        Args:
            uav_id: from 0; the MAVLink system id is `uav_id` + 1
            seed: with `uav_id` the seed of all random draws; aircraft of one seed share the mean wind
            wind: mean wind at 100 m [m/s]
            turbulence: MIL-F-8785C severity, 0..7
            origin: near which the homes are
            autopilot: control law and MAVLink dialect, ardupilot or px4
            aircraft: name in `airframes.TYPES`
            mission: mission and home; None: random
            extra_params: autopilot parameters that override its own
            wind_field: wind of the whole fleet; None: mean wind and a drift of its own
            flight_seed: seed of mission, weather and sensor errors of one flight, which is then recorded with the
                rates of an onboard log; None: they follow from `seed` too
        Raises:
            ValueError: when `uav_id` is outside the MAVLink range.
        """
        if not 0 <= uav_id < MAX_AIRCRAFT:
            max_id = MAX_AIRCRAFT - 1
            raise ValueError(f"uav-{uav_id}: found id {uav_id}, expected 0..{max_id} (MAVLink ids); fly fewer aircraft")
        aircraft_seed = int(np.random.SeedSequence((seed, uav_id)).generate_state(1)[0])
        conditions_seed = aircraft_seed if flight_seed is None else flight_seed
        rng = np.random.default_rng((conditions_seed, 4))
        self.uav_id, self.tick = uav_id, 0
        self.crashed = self.silent = self.link_lost = False
        self.boot_s = float(rng.uniform(60, 600))
        battery = np.random.default_rng((aircraft_seed, 6))
        self._endurance_s = float(battery.uniform(*_ENDURANCE_S))
        capacity = FULL_CURRENT * _HOVER_LOAD * self._endurance_s / 3.6 * battery.uniform(*_CAPACITY_ERROR)  # [mAh]
        self.params = tuned_parameters(aircraft_seed, autopilot, aircraft)
        self.params |= {_CAPACITY_NAMES[autopilot]: round(capacity, -2)} | dict(extra_params)
        is_px4 = autopilot == "px4"
        cruise = self.params["MPC_XY_CRUISE"] if is_px4 else 0.01 * self.params["WPNAV_SPEED"]
        self.items, self.origin = mission or draw_mission(conditions_seed, autopilot, cruise, origin)
        kind, motors = draw_airframe(TYPES[aircraft], np.random.default_rng((aircraft_seed, 1)))
        weather = Weather(wind, fleet_wind_direction(seed if flight_seed is None else flight_seed), turbulence)
        self.vehicle = RotorBody(kind, motors, rng, weather.w20_fps * 0.3048)
        drift = weather.wind(rng, DT * 10)
        self._wind = drift if wind_field is None else LocalWind(wind_field, self.origin, DT * 10)
        altitude_rng = None if flight_seed is None else np.random.default_rng((flight_seed, 7))
        self._sensors = Sensors(rng, DT, altitude_rng=altitude_rng)
        dialects = DIALECTS if flight_seed is None else ONBOARD_DIALECTS
        self._endpoint = MultirotorEndpoint(uav_id + 1, self.items, self.params, dialects[autopilot])
        self._sequence = TaskSequence(self.items, self.origin, 0 if is_px4 else 1)
        self._guidance = Px4Guidance(self.params) if is_px4 else CopterGuidance(self.params)
        self._position = PositionController(position_gains(self.params, is_px4))
        self.estimate: Estimate = self._measure()
        self._attitude = AttitudeController(attitude_gains(self.params, is_px4), float(self.estimate.euler[2]))
        self.mission_mode = self.mode = _MISSION_MODES[autopilot]
        self.armed = False
        self._arm_t = float(rng.uniform(*_ARM_S))
        self._task: Task | None = None
        self._mission_seq, self._item_changed = 0 if is_px4 else 1, False
        self._command, self._throttle = (0.0, 0.0, float(self.estimate.euler[2])), 0.0
        self.reference = Reference(self.estimate.p.copy(), np.zeros(3), np.zeros(3))
        self.pulses, self._charge, self._down_s = motor_pulses(None, False, self.params), 1.0, 0.0

    def step(self, t: float) -> list[bytes]:
        """Advance to `t` [s] since simulation start and return the frames sent meanwhile."""
        frames: list[bytes] = []
        while self.tick < round(t * TICK_HZ):
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
                self._enter_mode(request.mode, request.target)
            elif isinstance(request, SpeedRequest):
                self._sequence.set_speed(request.speed)
                if self._task is not None and self.armed:
                    self._begin(replace(self._task, speed=request.speed))
            elif isinstance(request, ItemRequest):
                self._begin_item(request.seq)
            else:
                self.items = request.items
                self._sequence.set_items(self.items)
                if self.mission_mode == "MISSION":  # PX4 goes to the marked item; ArduCopter stays at its item
                    self._begin_item(request.seq or 0)
        return replies

    def _begin_item(self, seq: int) -> None:
        """Fly to mission item `seq` from here, now or when the mission mode is entered."""
        self._sequence.set_current(seq)
        self._mission_seq = seq
        if self.armed and self.mode == self.mission_mode:
            self._next_task()

    def initial_frames(self) -> list[bytes]:
        """Return the frames for the start of a recording: version, mission, parameters."""
        requests = ground_requests(self.uav_id + 1, len(self.items))
        replies = [frame for request in requests for frame in self.receive(request)]
        return replies + self._endpoint.stream_parameters(len(self.params))

    def _enter_mode(self, mode: str, target: tuple[int, int, float] | None = None) -> None:
        """Enter a flight mode by command; a target is latitude, longitude [1e-7 deg] and height above home [m]."""
        self.mode = mode
        if not self.armed:
            return
        e = self.estimate
        if mode == self.mission_mode:
            self._next_task()
        elif target is not None:
            alt_mm = self.origin.alt_mm + 1e3 * target[2]
            point = to_ned(self.origin, *(np.array([x], float) for x in (*target[:2], alt_mm)))[0]
            self._begin(Task(tasks.WAYPOINT, -1, point, hold_s=1e9))
        else:
            self._begin(Task(_MODE_TASKS[mode], -1, np.array([*e.p[:2], e.p[2]])))

    def _begin(self, task: Task) -> None:
        self._task = task
        self._guidance.start(task, self.estimate.p, self.estimate.v)
        if self.mode == self.mission_mode:
            self._item_changed |= self._mission_seq != task.seq
            self._mission_seq = task.seq

    def _next_task(self) -> None:
        task = self._sequence.advance()
        self._begin(task or Task(tasks.HOLD, self._mission_seq, self.estimate.p.copy()))

    def _tick(self) -> list[bytes]:
        if self.tick % 10 == 0:
            self.vehicle.set_wind(*self._wind.step(self.estimate.p))
        self._control()
        state: Callable[[], Any] = self._telemetry_state  # of this vehicle class
        frames = [] if self.silent or self.link_lost else self._endpoint.telemetry(self.tick, state)
        if self._item_changed and not (self.silent or self.link_lost):
            frames += self._endpoint.item_changed(state())
        self._item_changed = False
        self.vehicle.step()
        self._charge = max(self._charge - DT * self.vehicle.power / _HOVER_LOAD / self._endurance_s, 0.0)
        self.tick += 1
        return frames

    def _measure(self) -> Estimate:
        """Return the state estimate; without a pitot tube the airspeed is the ground speed."""
        e = self._sensors.measure(self.vehicle.truth())
        return e._replace(Va=float(hypot(e.v[0], e.v[1])))

    def _control(self) -> None:
        """Measure, run the autopilot, set the motors."""
        e = self.estimate = self._measure()
        if not self.armed:
            if self.tick * DT >= self._arm_t:
                self._arm()
            return
        if self.tick % _OUTER == 0:
            self._guide(e)
        airborne = not self.vehicle.on_ground
        spooling = not airborne and float(self.reference.v[2]) >= 0.0
        inputs = self._attitude.step(self._command, self._throttle, e, DT, flying=airborne)
        self.pulses = motor_pulses(None if spooling else inputs, True, self.params)
        self.vehicle.set_motors(motor_inputs(self.pulses, self.params))
        self._land_detection(spooling)

    def _arm(self) -> None:
        self.armed, self._down_s = True, 0.0
        self._position.reset()
        self._attitude.reset(float(self.estimate.euler[2]))
        self._command = (0.0, 0.0, float(self.estimate.euler[2]))
        self._sequence.restart()
        self.mode = self.mission_mode
        self._next_task()

    def _land_detection(self, spooling: bool) -> None:
        """Disarm after a second on the ground at the end of a landing."""
        self._down_s = self._down_s + DT if self.vehicle.on_ground and self._guidance.touches_down else 0.0
        if self._down_s > 1.0:
            self.armed, self._arm_t = False, self.tick * DT + _REST_S
            self._guidance.touches_down, self._throttle = False, 0.0
            self.pulses = motor_pulses(None, False, self.params)
            self.vehicle.set_motors(None)

    def _guide(self, e: Estimate) -> None:
        self.reference = self._guidance.step(DT * _OUTER, e.p, e.v, self._following)
        if self._guidance.finished and self.mode == self.mission_mode:
            self._next_task()
        if isinstance(self._guidance, CopterGuidance) and self._guidance.restarts:
            self._position.take_over(e)
            self._guidance.restarts = False
        phi_c, theta_c, throttle = self._position.step(self.reference, e, DT * _OUTER)
        heading = self._guidance.heading(e.p, self.reference)
        self._command = (phi_c, theta_c, self._command[2] if heading is None else heading)
        self._throttle = throttle

    def _following(self) -> Task | None:
        if self.mode != self.mission_mode:
            return None
        return self._sequence.following(with_position=isinstance(self._guidance, Px4Guidance))

    def _telemetry_state(self) -> MultirotorState:
        e = self.estimate
        lat, lon, alt = to_geodetic(self.origin, e.p)
        target = np.zeros(3) if self._task is None else self._task.target - e.p
        return MultirotorState(
            t=self.boot_s + self.tick * DT,
            estimate=e,
            position=(int(lat), int(lon), int(alt)),
            height=float(-e.p[2]),
            pulses=self.pulses,
            delta_t=self._throttle if self.armed else 0.0,
            command=self._command,
            reference=tuple(tuple(map(float, part)) for part in self.reference),
            target=(float(target[0]), float(target[1])),
            seq=self._mission_seq,
            n_items=len(self.items),
            home=(self.origin.lat_e7, self.origin.lon_e7, self.origin.alt_mm),
            mode=self.mode,
            armed=self.armed,
            landed=self.vehicle.on_ground,
            load=self.vehicle.power,
            charge=self._charge,
        )
