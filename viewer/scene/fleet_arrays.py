"""Fleet as arrays, shared by all pages: ids, positions, statuses and one minute of trail."""

import numpy as np

from fleet.contract import State
from viewer.store.place import UNIT_M, scene_quat
from viewer.store.received.inbox import CROWD
from viewer.store.store import Feed
from viewer.store.vehicle import Vehicle
from viewer.text.mismatch_text import in_force

CHUNKS, STEPS = 5, 12  # the trail: chunks of 12 s and a head of up to 12 s, one point per second
MINUTE = np.arange(float(CHUNKS + 1) * STEPS, -1.0, -1.0)  # age of each trail point, (73,) [s]
COARSE = ((60, 1), (CROWD, 2))  # (most UAVs, seconds between drawn trail points); else 4
TURNS = 5  # calls in which all positions of a large fleet are decoded once
COAST_S, STALE_S = 1.5, 2.5  # longest extrapolation; longest interval for a velocity [s]
FASTEST = 30.0  # a higher speed is a jump [10 m/s]
LEAP_M = 1_000.0  # a larger step in one second restarts the trail, as for a restarted recording [m]
HOVER = ("multirotor", "helicopter")  # vehicle types drawn with rotors
LOOKS = ("muted", "predicting", "verified", "identifying", "lost", "mismatch")  # palette colour of each display status
WAITING, PREDICTING, VERIFIED, IDENTIFYING, LOST, MISMATCH = range(len(LOOKS))
_OF_STATE = {
    State.PREDICTING: PREDICTING,
    State.VERIFIED: VERIFIED,
    State.IDENTIFYING: IDENTIFYING,
    State.LINK_LOST: LOST,
}


def look(vehicle: Vehicle, now: float) -> int:
    """Return the display status of a UAV; a mismatch or an alert takes precedence over all but a lost link."""
    state = vehicle.state(now)
    if vehicle.ended:
        return WAITING
    if state is not State.LINK_LOST and (vehicle.alerts or in_force(vehicle.mismatch)):
        return MISMATCH
    return _OF_STATE.get(state, WAITING)


class Flock:
    """Drawn UAVs in the order of their ids; arrays of length n."""

    def __init__(self) -> None:
        self.fleet: list[Vehicle] = []  # snapshots of the last second
        self._shown: list[Vehicle] = []  # drawn UAVs
        self.now = 0.0  # time of the snapshots, monotonic [s]
        self.uavs: tuple[int, ...] = ()
        self._rows: dict[int, int] = {}  # row of each UAV
        self.looks = np.zeros(0, int)  # indices into STATUS_COLOURS
        self.hover = np.zeros(0, bool)  # rotors instead of wings
        self.at = np.zeros((0, 3))  # scene ENU [10 m]
        self.quat = np.zeros((0, 4))  # orientation, scalar first
        self.changes = 0  # counts changes of the drawn UAVs and restarted trails
        self.beats = 0  # seconds of trail
        self.ring = np.zeros((0, len(MINUTE), 3))  # a minute of trail, newest last
        self._ghosts: list[tuple[int, Vehicle]] = []  # UAVs without telemetry, drawn at a predicted or last position
        self._turn = 0  # part of a large fleet decoded last
        self._told = np.zeros((0, 3))  # large fleet: last decoded positions [10 m]
        self._heard = np.zeros(0)  # their arrival, monotonic [s]
        self._speed = np.zeros((0, 3))  # velocities at that time [10 m/s]

    @property
    def crowd(self) -> bool:
        """Return whether the fleet is large: then only exceptional UAVs have predicted paths."""
        return len(self.uavs) > CROWD

    @property
    def stride(self) -> int:
        """Return the seconds between the drawn points of a trail."""
        return next((step for most, step in COARSE if len(self.uavs) <= most), 4)

    @property
    def chunks(self) -> int:
        """Return the number of closed trail chunks to draw."""
        return CHUNKS if len(self.uavs) <= COARSE[0][0] else 2 if self.crowd else 3

    @property
    def exceptions(self) -> np.ndarray:
        """Return a mask of UAVs with an alert, mismatch or lost link, (n,)."""
        return (self.looks == MISMATCH) | (self.looks == LOST)

    @property
    def needy(self) -> list[tuple[Vehicle, int]]:
        """Return UAVs with an alert, mismatch or lost link, and their rows."""
        return [(self._shown[i], i) for i in np.flatnonzero(self.exceptions).tolist()]

    def index(self, uav: int | None) -> int | None:
        """Return the row of a UAV; None when it is not drawn."""
        return self._rows.get(uav) if uav is not None else None

    def meet(self, fleet: list[Vehicle], now: float) -> None:
        """Update UAVs and statuses; call it once per second."""
        self.fleet, self.now = fleet, now
        shown = [(vehicle, at) for vehicle in fleet if (at := vehicle.where(now)) is not None]
        self._shown = [vehicle for vehicle, _ in shown]
        uavs = tuple(vehicle.uav for vehicle in self._shown)
        self.looks = np.array([look(vehicle, now) for vehicle, _ in shown], int)
        hover = np.array([v.status is not None and v.status.vehicle in HOVER for v, _ in shown], bool)
        if uavs != self.uavs or not np.array_equal(hover, self.hover):
            self._enlist(uavs, np.array([at for _, at in shown]).reshape(-1, 3))
            self.hover = hover
        self._ghosts = [(i, v) for i, (v, _) in enumerate(shown) if v.ended or v.at is None or self.looks[i] == LOST]
        for i, _ in self._ghosts:
            self.at[i] = shown[i][1]
            if self.crowd:
                self._told[i] = shown[i][1]

    def _enlist(self, uavs: tuple[int, ...], at: np.ndarray) -> None:
        """Replace the set of UAVs; remaining UAVs keep their trails."""
        ring = np.repeat(at[:, None], len(MINUTE), axis=1)
        for i, uav in enumerate(uavs):
            if uav in self._rows:
                ring[i] = self.ring[self._rows[uav]]
        self.ring, self.uavs, self.at, self.changes = ring, uavs, at, self.changes + 1
        self._rows = {uav: i for i, uav in enumerate(uavs)}
        self.quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(uavs), 1))
        self._told, self._heard, self._speed = at.copy(), np.full(len(uavs), -np.inf), np.zeros_like(at)

    def pose(self, feed: Feed, now: float) -> None:
        """Update positions and attitudes; call it once per frame.

        Of a large fleet each call decodes a part and extrapolates the others; exceptional and selected UAVs are
        decoded every time.
        """
        if not self.uavs:
            return
        if not self.crowd:
            self._take_all(feed, now)
            return
        self._turn = (self._turn + 1) % TURNS
        chosen = np.zeros(len(self.uavs), bool)
        chosen[self._turn :: TURNS] = True
        close = [row for uav in feed.close if (row := self._rows.get(uav)) is not None]
        chosen[close] = True
        self._take(feed, np.flatnonzero(chosen))
        self._speed[close] = 0.0
        self._speed[[i for i, _ in self._ghosts]] = 0.0
        self.at = self._told + self._speed * np.clip(now - self._heard, 0.0, COAST_S)[:, None]

    def _take_all(self, feed: Feed, now: float) -> None:
        """Read all poses; UAVs without telemetry use the predicted position."""
        places, turns, _ = feed.poses(self.uavs)
        heard = np.isfinite(places[:, 0])
        heard[[i for i, _ in self._ghosts]] = False
        self.at = np.where(heard[:, None], places, self.at)
        for i, vehicle in self._ghosts:
            if (spot := vehicle.where(now)) is not None:
                self.at[i] = spot
        self.quat = scene_quat(*turns.T)

    def _take(self, feed: Feed, rows: np.ndarray) -> None:
        """Read the poses of some rows (k,) and update their velocities."""
        places, turns, heard = feed.poses(tuple(self.uavs[i] for i in rows))
        new = np.isfinite(places[:, 0]) & (heard > self._heard[rows])
        self.quat[rows] = scene_quat(*turns.T)
        rows, places, heard = rows[new], places[new], heard[new]
        speed = (places - self._told[rows]) / (heard - self._heard[rows])[:, None]
        sound = (np.linalg.norm(speed, axis=1) < FASTEST) & (heard - self._heard[rows] < STALE_S)
        self._speed[rows] = np.where(sound[:, None], speed, 0.0)
        self._told[rows], self._heard[rows] = places, heard

    def beat(self, played: dict[int, np.ndarray]) -> None:
        """Append the positions to the trails, once per second.

        Args:
            played: trails of UAVs that are not in real time, positions `TRAIL_AGES_S` ago, (n, 3) [10 m]
        """
        if not self.uavs:
            return
        self.ring = np.concatenate([self.ring[:, 1:], self.at[:, None]], axis=1)
        leapt = np.linalg.norm(self.ring[:, -1] - self.ring[:, -2], axis=1) > LEAP_M / UNIT_M
        self.ring[leapt] = self.ring[leapt, -1:]
        for i, uav in enumerate(self.uavs):
            if uav in played:
                self.ring[i] = played[uav]
        self.beats += 1
        self.changes += bool(leapt.any() or played)

    def chunk(self, age: int) -> np.ndarray:
        """Return the points of one closed chunk of trail, (n, k, 3); `age` 0 is the newest."""
        last = len(MINUTE) - 1 - self.beats % STEPS - age * STEPS
        return self.ring[:, last - STEPS : last + 1 : self.stride]

    def head(self) -> np.ndarray:
        """Return the newest stretch of trail up to the current position, (n, k, 3), k constant."""
        run = self.beats % STEPS
        points = self.ring[:, len(MINUTE) - 1 - run :: self.stride]
        missing = STEPS // self.stride + 2 - points.shape[1]
        return np.concatenate([points, np.repeat(self.at[:, None], missing, axis=1)], axis=1)
