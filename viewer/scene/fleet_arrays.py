"""The whole fleet as arrays, once for all who look: who, where, how each stands, and a minute of trail."""

import numpy as np

from fleet.contract import State
from viewer.store.place import UNIT_M, scene_quat
from viewer.store.received.inbox import CROWD
from viewer.store.store import Feed
from viewer.store.vehicle import Vehicle
from viewer.text.mismatch_text import in_force

CHUNKS, STEPS = 5, 12  # the trail: chunks of 12 s, and a head of up to 12 s, one point a second
MINUTE = np.arange(float(CHUNKS + 1) * STEPS, -1.0, -1.0)  # how long ago each point of the trail is, (73,) [s]
COARSE = ((60, 1), (CROWD, 2))  # of a fleet up to so many, seconds between the drawn points of a trail; else 4
TURNS = 5  # calls in which the places of a crowd are all read once
COAST_S, STALE_S = 1.5, 2.5  # so long one goes on unheard; a speed over a longer gap is none [s]
FASTEST = 30.0  # what went faster has leapt [10 m/s]
LEAP_M = 1_000.0  # farther within a second is no flight but another one (a recording begun anew): a new trail [m]
HOVER = ("multirotor", "helicopter")  # kinds of vehicle drawn with rotors
LOOKS = ("muted", "predicting", "verified", "identifying", "lost", "mismatch")  # names of colours
WAITING, PREDICTING, VERIFIED, IDENTIFYING, LOST, MISMATCH = range(len(LOOKS))
_OF_STATE = {
    State.PREDICTING: PREDICTING,
    State.VERIFIED: VERIFIED,
    State.IDENTIFYING: IDENTIFYING,
    State.LINK_LOST: LOST,
}


def look(vehicle: Vehicle, now: float) -> int:
    """Tell how a UAV looks: an index into `LOOKS`; a mismatch or an alert wins over all but a lost link."""
    state = vehicle.state(now)
    if vehicle.ended:
        return WAITING
    if state is not State.LINK_LOST and (vehicle.alerts or in_force(vehicle.mismatch)):
        return MISMATCH
    return _OF_STATE.get(state, WAITING)


class Flock:
    """Who is drawn, in the order of their ids; arrays of n."""

    def __init__(self) -> None:
        self.fleet: list[Vehicle] = []  # copies, as of the last second
        self._shown: list[Vehicle] = []  # those who are drawn
        self.now = 0.0  # when that was, monotonic [s]
        self.uavs: tuple[int, ...] = ()
        self._rows: dict[int, int] = {}  # the row of each
        self.looks = np.zeros(0, int)  # indices into LOOKS
        self.hover = np.zeros(0, bool)  # who has rotors instead of wings
        self.at = np.zeros((0, 3))  # scene ENU [10 m]
        self.quat = np.zeros((0, 4))  # orientation, scalar first
        self.changes = 0  # of who is drawn, and of trails begun anew
        self.beats = 0  # seconds of trail
        self.ring = np.zeros((0, len(MINUTE), 3))  # a minute of trail, newest last
        self._ghosts: list[tuple[int, Vehicle]] = []  # whose place is predicted, for they are not heard
        self._turn = 0  # which part of a crowd was read last
        self._told = np.zeros((0, 3))  # of a crowd: where each was when it was last read [10 m]
        self._heard = np.zeros(0)  # when that was heard, monotonic [s]
        self._speed = np.zeros((0, 3))  # how fast each went by then [10 m/s]

    @property
    def crowd(self) -> bool:
        """Return whether there are too many to draw everything of each: exceptions alone keep predicted paths."""
        return len(self.uavs) > CROWD

    @property
    def stride(self) -> int:
        """Return the seconds between the drawn points of a trail."""
        return next((step for most, step in COARSE if len(self.uavs) <= most), 4)

    @property
    def chunks(self) -> int:
        """Return how many closed chunks of trail are drawn."""
        return CHUNKS if len(self.uavs) <= COARSE[0][0] else 2 if self.crowd else 3

    @property
    def exceptions(self) -> np.ndarray:
        """Tell who needs an eye, (n,)."""
        return (self.looks == MISMATCH) | (self.looks == LOST)

    @property
    def needy(self) -> list[tuple[Vehicle, int]]:
        """Return who needs an eye, with their rows."""
        return [(self._shown[i], i) for i in np.flatnonzero(self.exceptions).tolist()]

    def index(self, uav: int | None) -> int | None:
        """Return the row of a UAV; None where it is not drawn."""
        return self._rows.get(uav) if uav is not None else None

    def meet(self, fleet: list[Vehicle], now: float) -> None:
        """Take over who is there and how they stand; call it once a second."""
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
        """Begin with another set of UAVs; those who stay keep their trails."""
        ring = np.repeat(at[:, None], len(MINUTE), axis=1)
        for i, uav in enumerate(uavs):
            if uav in self._rows:
                ring[i] = self.ring[self._rows[uav]]
        self.ring, self.uavs, self.at, self.changes = ring, uavs, at, self.changes + 1
        self._rows = {uav: i for i, uav in enumerate(uavs)}
        self.quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(uavs), 1))
        self._told, self._heard, self._speed = at.copy(), np.full(len(uavs), -np.inf), np.zeros_like(at)

    def pose(self, feed: Feed, now: float) -> None:
        """Take over where everybody is; call it as often as the picture moves.

        Of a crowd a part is read at each call, in between everybody goes on as before; who needs an eye or is selected
        is read every time.
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
        """Read where everybody is; whose place is predicted goes on by that."""
        places, turns, _ = feed.poses(self.uavs)
        heard = np.isfinite(places[:, 0])
        heard[[i for i, _ in self._ghosts]] = False
        self.at = np.where(heard[:, None], places, self.at)
        for i, vehicle in self._ghosts:
            if (spot := vehicle.where(now)) is not None:
                self.at[i] = spot
        self.quat = scene_quat(*turns.T)

    def _take(self, feed: Feed, rows: np.ndarray) -> None:
        """Read where some of a crowd are, rows (k,), and how fast they went since they were last read."""
        places, turns, heard = feed.poses(tuple(self.uavs[i] for i in rows))
        new = np.isfinite(places[:, 0]) & (heard > self._heard[rows])
        self.quat[rows] = scene_quat(*turns.T)
        rows, places, heard = rows[new], places[new], heard[new]
        speed = (places - self._told[rows]) / (heard - self._heard[rows])[:, None]
        sound = (np.linalg.norm(speed, axis=1) < FASTEST) & (heard - self._heard[rows] < STALE_S)
        self._speed[rows] = np.where(sound[:, None], speed, 0.0)
        self._told[rows], self._heard[rows] = places, heard

    def beat(self, played: dict[int, np.ndarray]) -> None:
        """Remember where everyone is, once a second.

        Args:
            played: of UAVs whose seconds are others than ours, the places `MINUTE` ago, (n, 3) [10 m]
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
        """Return the newest stretch of trail up to where each is now, (n, k, 3): an array of fixed size."""
        run = self.beats % STEPS
        points = self.ring[:, len(MINUTE) - 1 - run :: self.stride]
        missing = STEPS // self.stride + 2 - points.shape[1]
        return np.concatenate([points, np.repeat(self.at[:, None], missing, axis=1)], axis=1)
