"""Fleet as arrays, shared by all pages: ids, positions, statuses and one minute of trail."""

import numpy as np

from fleet.contract import TwinState
from viewer.store.inbox import LARGE_FLEET
from viewer.store.place import UNIT_M, scene_quat
from viewer.store.store import FleetStore
from viewer.store.vehicle import Vehicle
from viewer.text.words import in_force, state_style
from viewer.theme.palette import STATUS_COLOURS

CHUNKS, STEPS = 5, 12  # the trail: chunks of 12 s and a head of up to 12 s, one point per second
TRAIL_AGES_S = np.arange(float(CHUNKS + 1) * STEPS, -1.0, -1.0)  # age of each trail point, (73,) [s]
TRAIL_STRIDES = ((60, 1), (LARGE_FLEET, 2))  # (most UAVs, seconds between drawn trail points); else 4
READ_PARTS = 5  # calls in which all positions of a large fleet are decoded once
COAST_S, STALE_S = 1.5, 2.5  # longest extrapolation; longest interval for a velocity [s]
MAX_SPEED = 30.0  # a higher speed is a jump [10 m/s]
JUMP_M = 1_000.0  # a larger step in one second restarts the trail, as for a restarted recording [m]
ROTORCRAFT = ("multirotor", "helicopter")  # vehicle types drawn with rotors
WAITING, LOST, MISMATCH = (STATUS_COLOURS.index(name) for name in ("muted", "lost", "mismatch"))  # display statuses


def display_status(vehicle: Vehicle, now: float) -> int:
    """Return the display status of a UAV; a mismatch or an alert takes precedence over all but a lost link."""
    record = vehicle.record(now)
    if vehicle.ended:
        return WAITING
    if record.state is not TwinState.LINK_LOST and (vehicle.alerts or in_force(vehicle.mismatch)):
        return MISMATCH
    return STATUS_COLOURS.index(state_style(record)[1])


class FleetArrays:
    """Drawn UAVs in the order of their ids; arrays of length n."""

    def __init__(self) -> None:
        self.fleet: list[Vehicle] = []  # snapshots of the last second
        self._shown: list[Vehicle] = []  # drawn UAVs
        self.now = 0.0  # time of the snapshots, monotonic [s]
        self.uavs: tuple[int, ...] = ()
        self._rows: dict[int, int] = {}  # row of each UAV
        self.statuses = np.zeros(0, int)  # indices into STATUS_COLOURS
        self.has_rotors = np.zeros(0, bool)  # rotors instead of wings
        self.at = np.zeros((0, 3))  # scene ENU [10 m]
        self.quat = np.zeros((0, 4))  # orientation, scalar first
        self.revision = 0  # counts changes of the drawn UAVs and restarted trails
        self.trail_steps = 0  # seconds of trail
        self.trails = np.zeros((0, len(TRAIL_AGES_S), 3))  # a minute of trail, newest last
        self._predicted_only: list[tuple[int, Vehicle]] = []  # without telemetry: at a predicted or last position
        self._read_part = 0  # part of a large fleet decoded last
        self._read_positions = np.zeros((0, 3))  # large fleet: last decoded positions [10 m]
        self._read_times = np.zeros(0)  # their arrival, monotonic [s]
        self._velocities = np.zeros((0, 3))  # velocities at that time [10 m/s]

    @property
    def large_fleet(self) -> bool:
        """Return whether the fleet is large: then only exceptional UAVs have predicted paths."""
        return len(self.uavs) > LARGE_FLEET

    @property
    def stride(self) -> int:
        """Return the seconds between the drawn points of a trail."""
        return next((step for limit, step in TRAIL_STRIDES if len(self.uavs) <= limit), 4)

    @property
    def chunks(self) -> int:
        """Return the number of closed trail chunks to draw."""
        return CHUNKS if len(self.uavs) <= TRAIL_STRIDES[0][0] else 2 if self.large_fleet else 3

    @property
    def exceptions(self) -> np.ndarray:
        """Return a mask of UAVs with an alert, mismatch or lost link, (n,)."""
        return (self.statuses == MISMATCH) | (self.statuses == LOST)

    @property
    def exceptional(self) -> list[tuple[Vehicle, int]]:
        """Return UAVs with an alert, mismatch or lost link, and their rows."""
        return [(self._shown[i], i) for i in np.flatnonzero(self.exceptions).tolist()]

    def index(self, uav: int | None) -> int | None:
        """Return the row of a UAV; None when it is not drawn."""
        return self._rows.get(uav) if uav is not None else None

    def position(self, uav: int) -> np.ndarray | None:
        """Return the drawn position of a UAV, (3,) [10 m]; None when it is not drawn."""
        row = self.index(uav)
        return None if row is None else self.at[row]

    def update_fleet(self, fleet: list[Vehicle], now: float) -> None:
        """Update UAVs and statuses; call it once per second."""
        self.fleet, self.now = fleet, now
        shown = [(vehicle, at) for vehicle in fleet if (at := vehicle.position(now)) is not None]
        self._shown = [vehicle for vehicle, _ in shown]
        uavs = tuple(vehicle.uav for vehicle in self._shown)
        self.statuses = np.array([display_status(vehicle, now) for vehicle, _ in shown], int)
        has_rotors = np.array([v.status is not None and v.status.vehicle in ROTORCRAFT for v, _ in shown], bool)
        if uavs != self.uavs or not np.array_equal(has_rotors, self.has_rotors):
            self._set_uavs(uavs, np.array([at for _, at in shown]).reshape(-1, 3))
            self.has_rotors = has_rotors
        self._predicted_only = [
            (i, v) for i, (v, _) in enumerate(shown) if v.ended or v.at is None or self.statuses[i] == LOST
        ]
        for i, _ in self._predicted_only:
            self.at[i] = shown[i][1]
            if self.large_fleet:
                self._read_positions[i] = shown[i][1]

    def _set_uavs(self, uavs: tuple[int, ...], at: np.ndarray) -> None:
        """Replace the set of UAVs; remaining UAVs keep their trails."""
        trails = np.repeat(at[:, None], len(TRAIL_AGES_S), axis=1)
        for i, uav in enumerate(uavs):
            if uav in self._rows:
                trails[i] = self.trails[self._rows[uav]]
        self.trails, self.uavs, self.at, self.revision = trails, uavs, at, self.revision + 1
        self._rows = {uav: i for i, uav in enumerate(uavs)}
        self.quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(uavs), 1))
        self._read_positions, self._velocities = at.copy(), np.zeros_like(at)
        self._read_times = np.full(len(uavs), -np.inf)

    def update_poses(self, store: FleetStore, now: float) -> None:
        """Update positions and attitudes; call it once per frame.

        Of a large fleet each call decodes a part and extrapolates the others; exceptional and selected UAVs are
        decoded every time.
        """
        if not self.uavs:
            return
        if not self.large_fleet:
            return self._read_all(store, now)
        self._read_part = (self._read_part + 1) % READ_PARTS
        selected = np.zeros(len(self.uavs), bool)
        selected[self._read_part :: READ_PARTS] = True
        immediate = [row for uav in store.immediate_uavs if (row := self._rows.get(uav)) is not None]
        selected[immediate] = True
        self._read_some(store, np.flatnonzero(selected))
        self._velocities[immediate] = 0.0
        self._velocities[[i for i, _ in self._predicted_only]] = 0.0
        self.at = self._read_positions + self._velocities * np.clip(now - self._read_times, 0.0, COAST_S)[:, None]

    def _read_all(self, store: FleetStore, now: float) -> None:
        """Read all poses; UAVs without telemetry use the predicted position."""
        positions, attitudes, _ = store.poses(self.uavs)
        received = np.isfinite(positions[:, 0])
        received[[i for i, _ in self._predicted_only]] = False
        self.at = np.where(received[:, None], positions, self.at)
        for i, vehicle in self._predicted_only:
            if (point := vehicle.position(now)) is not None:
                self.at[i] = point
        self.quat = scene_quat(*attitudes.T)

    def _read_some(self, store: FleetStore, rows: np.ndarray) -> None:
        """Read the poses of some rows (k,) and update their velocities."""
        positions, attitudes, received = store.poses(tuple(self.uavs[i] for i in rows))
        new = np.isfinite(positions[:, 0]) & (received > self._read_times[rows])
        self.quat[rows] = scene_quat(*attitudes.T)
        rows, positions, received = rows[new], positions[new], received[new]
        velocities = (positions - self._read_positions[rows]) / (received - self._read_times[rows])[:, None]
        valid = (np.linalg.norm(velocities, axis=1) < MAX_SPEED) & (received - self._read_times[rows] < STALE_S)
        self._velocities[rows] = np.where(valid[:, None], velocities, 0.0)
        self._read_positions[rows], self._read_times[rows] = positions, received

    def extend_trails(self, played: dict[int, np.ndarray]) -> None:
        """Append the positions, once per second; `played`: whole trails (73, 3) [10 m] of UAVs not in real time."""
        if not self.uavs:
            return
        self.trails = np.concatenate([self.trails[:, 1:], self.at[:, None]], axis=1)
        jumped = np.linalg.norm(self.trails[:, -1] - self.trails[:, -2], axis=1) > JUMP_M / UNIT_M
        self.trails[jumped] = self.trails[jumped, -1:]
        for uav, trail in played.items():
            if (row := self.index(uav)) is not None:
                self.trails[row] = trail
        self.trail_steps += 1
        self.revision += bool(jumped.any() or played)

    def chunk(self, age: int) -> np.ndarray:
        """Return the points of one closed chunk of trail, (n, k, 3); `age` 0 is the newest."""
        last = len(TRAIL_AGES_S) - 1 - self.trail_steps % STEPS - age * STEPS
        return self.trails[:, last - STEPS : last + 1 : self.stride]

    def head(self) -> np.ndarray:
        """Return the newest stretch of trail up to the current position, (n, k, 3), k constant."""
        newest_steps = self.trail_steps % STEPS
        points = self.trails[:, len(TRAIL_AGES_S) - 1 - newest_steps :: self.stride]
        missing = STEPS // self.stride + 2 - points.shape[1]
        return np.concatenate([points, np.repeat(self.at[:, None], missing, axis=1)], axis=1)
