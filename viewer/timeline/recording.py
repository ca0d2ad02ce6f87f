"""Recording of one UAV for replay on the page: rows, predictions every 5 s, and states."""

import msgspec
import numpy as np

from fleet.contract import Array
from fleet.frames import wrap
from viewer.store.forecast import Forecast
from viewer.store.track import TRAIL_ROWS
from viewer.store.vehicle import JUMP_S, Vehicle
from viewer.theme.events import Event
from viewer.timeline.state_at import Stood, stood

KEPT_S = 600.0  # retention of a live flight; a recording is kept completely [s]
TOLD_S = 5.0  # between two recorded predictions [s]
THIN_S, NEAR_S, FAR_S = 1.0, 20.0, 2.5  # step up to NEAR_S of look-ahead, and step beyond; drawn as cubic splines [s]
AFTER_S = 20.0  # look-ahead recorded beyond the horizon [s]
GAP_S, SPARE_S, MOST_FILLED = (
    1.6,
    0.4,
    100,
)  # gaps filled from the trail, margin at their ends, most rows [s]
ROOM = 64  # initial capacity, and rows between two checks for expired rows
MAX_ROWS = 8_000  # rows of one UAV; beyond it every second row is dropped
MAX_STOOD = 500  # state changes of one UAV; the oldest are dropped first
MAX_TOLD = 1_500  # predictions of one UAV; beyond it every second one is dropped
BARE_BYTES = 850  # approximate size of a prediction without its arrays
WORDS = ("sentence", "calibration", "law", "method", "origin", "event_said")  # rarely change between predictions
COLUMNS = 7  # east north up [10 m], phi theta psi [rad], Va [m/s]


class Tape:
    """Rows of one UAV in the order of data time, in growing arrays."""

    def __init__(self) -> None:
        self.told: list[Forecast] = []  # oldest first, reduced by `_reduced`
        self.stood: list[Stood] = []
        self.events: tuple[Event, ...] = ()
        self._t, self._x = np.empty(ROOM), np.empty((ROOM, COLUMNS), np.float32)
        self._n, self._step = 0, 0.0
        self._told_bytes = 0
        self._asked: Forecast | None = None

    def __len__(self) -> int:
        return self._n

    @property
    def t(self) -> np.ndarray:
        """Return the times of the rows, increasing, (n,) [s since 1970]."""
        return self._t[: self._n]

    @property
    def x(self) -> np.ndarray:
        """Return the rows, (n, 7): scene ENU [10 m], phi theta psi [rad], Va [m/s]."""
        return self._x[: self._n]

    def nbytes(self) -> int:
        """Return the size of all arrays [bytes]."""
        return self._t.nbytes + self._x.nbytes + self._told_bytes

    def take(self, vehicle: Vehicle, trail: np.ndarray, now: float, apart_s: float = TOLD_S) -> None:
        """Record the current state of a UAV.

        Args:
            vehicle: immutable snapshot
            trail: newest positions, (n, 5): time, scene ENU, Va; fills gaps since the last row
            now: monotonic time [s]
            step_s: shortest time between two recorded predictions [s]
        """
        if self._n and vehicle.t < self._t[self._n - 1] - JUMP_S:
            self.__init__()  # type: ignore[misc]  # clock step back: another flight
        if vehicle.at is not None and np.isfinite(vehicle.t) and (not self._n or vehicle.t > self._t[self._n - 1]):
            self._fill(vehicle, trail)
            if not self._n or vehicle.t >= self._t[self._n - 1] + self._step:
                self._append(vehicle.t, [*vehicle.at, *vehicle.attitude, vehicle.Va], vehicle.recorded)
        self._listen(vehicle, now, apart_s)

    def _fill(self, vehicle: Vehicle, trail: np.ndarray) -> None:
        """Insert positions between two records, as for a fast replay; heading is the course."""
        last = self._t[self._n - 1] if self._n else -np.inf
        if vehicle.t - last < GAP_S or len(trail) < 2:
            return
        between = trail[(trail[:, 0] > last + SPARE_S) & (trail[:, 0] < vehicle.t - SPARE_S)]
        between = between[:: max(1, len(between) // MOST_FILLED)]
        step = np.gradient(between[:, 1:3], axis=0) if len(between) > 1 else np.zeros((len(between), 2))
        for row, psi in zip(between, np.arctan2(*step.T), strict=True):
            self._append(float(row[0]), [*row[1:4], 0.0, 0.0, psi, row[4]], vehicle.recorded)

    def _append(self, t: float, row: list[float], recorded: bool) -> None:
        if self._n and self._n % ROOM == 0:
            self._let_go(recorded)
        if self._n == len(self._t):
            self._make_room()
        self._t[self._n], self._x[self._n] = t, row
        self._n += 1

    def _let_go(self, recorded: bool) -> None:
        """Drop expired rows of a live flight once they are an eighth of all."""
        old = 0 if recorded else int(np.searchsorted(self.t, self._t[self._n - 1] - KEPT_S))
        if old > self._n // 8:
            self._keep(slice(old, self._n))

    def _make_room(self) -> None:
        """Grow the arrays, or drop every second row."""
        if self._n >= MAX_ROWS:
            self._step = 2 * float(np.median(np.diff(self.t)))
            self._keep(slice(self._n % 2, self._n, 2))
        else:
            self._t = np.concatenate([self._t, np.empty(self._n)])
            self._x = np.concatenate([self._x, np.empty((self._n, COLUMNS), np.float32)])

    def _keep(self, rows: slice) -> None:
        t, x = self.t[rows].copy(), self.x[rows].copy()
        self._n = len(t)
        self._t[: self._n], self._x[: self._n] = t, x

    def _listen(self, vehicle: Vehicle, now: float, apart_s: float) -> None:
        """Record the newest prediction if due, and the state if it changed."""
        at = vehicle.clock(now)
        if not np.isfinite(at):
            return
        told, self.events = vehicle.forecast, vehicle.events
        if told is not None and (not self.told or told.t >= self.told[-1].t + apart_s):
            self.told.append(_slim(told, self.told[-1] if self.told else None))
            self._told_bytes += _size(self.told[-1])
        how = stood(vehicle, at, now)
        if not self.stood or how[1:] != self.stood[-1][1:]:
            self.stood.append(how)
        del self.stood[:-MAX_STOOD]
        if not vehicle.recorded:
            self._forget(at - KEPT_S)
        if len(self.told) > MAX_TOLD:
            self.told = self.told[::2]
            self._told_bytes = sum(map(_size, self.told))

    def _forget(self, before: float) -> None:
        """Drop the oldest prediction and state if earlier than a time [s since 1970]."""
        if self.told and self.told[0].t < before:
            self._told_bytes -= _size(self.told.pop(0))
        if len(self.stood) > 1 and self.stood[1].t < before:  # the first is valid until the second
            del self.stood[0]

    def row(self, t: float) -> np.ndarray:
        """Interpolate a row at a time: (7,); angles the short way round, constant beyond both ends."""
        k = int(np.clip(np.searchsorted(self.t, t), 1, max(self._n - 1, 1)))
        if self._n == 1:
            return self.x[0].astype(float)
        (t0, t1), (a, b) = self.t[k - 1 : k + 1], self.x[k - 1 : k + 1].astype(float)
        step = b - a
        step[3:6] = wrap(step[3:6])
        return a + step * float(np.clip((t - t0) / (t1 - t0), 0.0, 1.0))

    def path(self, begin: float, end: float) -> np.ndarray:
        """Return the flown path between two times, both ends interpolated: (n, 4) time [s], scene ENU [10 m]."""
        end, begin = min(end, float(self.t[-1])), max(begin, float(self.t[0]))
        if end <= begin:
            return np.zeros((0, 4))
        inner = (self.t > begin) & (self.t < end)
        at = np.concatenate([[begin], self.t[inner], [end]])
        return np.column_stack([at, *(np.interp(at, self.t, self.x[:, k]) for k in range(3))])

    def flown(self, begin: float, end: float) -> np.ndarray:
        """Return the last trail rows between two times: (n, 5) time, scene ENU [10 m], Va [m/s]."""
        path = self.path(begin, end)[-TRAIL_ROWS:]
        return np.column_stack([path, np.interp(path[:, 0], self.t, self.x[:, 6])]) if len(path) else np.zeros((0, 5))

    def told_by(self, t: float) -> Forecast | None:
        """Return the newest prediction at a time; release the scene arrays of the last one returned."""
        found = next((one for one in reversed(self.told) if one.t <= t + 0.5), None)
        if self._asked is not None and self._asked is not found:
            vars(self._asked).pop("_scene_arrays", None)
        self._asked = found
        return found

    def stood_at(self, t: float) -> Stood | None:
        """Return the state at a time; None before the first."""
        return next((one for one in reversed(self.stood) if one.t <= t), None)


def _size(told: Forecast) -> int:
    """Return the approximate size of a recorded prediction [bytes]."""
    return len(told.message.path.data) + len(told.message.tube.data) + BARE_BYTES


def _slim(told: Forecast, before: Forecast | None) -> Forecast:
    """Reduce a prediction to what is drawn: look-aheads up to `AFTER_S` past the horizon, shared texts."""
    message = told.message
    ahead = message.ahead.numpy()
    n = max(int(np.searchsorted(ahead, told.until + AFTER_S)) + 1, 2)
    last = before.message if before is not None else None
    same = {name: getattr(last, name) for name in WORDS if getattr(last, name, None) == getattr(message, name)}
    first, last_s = float(ahead[0]), float(ahead[:n][-1])
    near = min(first + NEAR_S, last_s)
    wanted = np.concatenate([np.arange(first, near, THIN_S), np.arange(near, last_s, FAR_S), [last_s]])
    keep = np.unique(np.searchsorted(ahead[:n], wanted))
    cut = {name: Array.of(getattr(message, name).numpy()[keep]) for name in ("ahead", "path", "tube")}
    if last is not None and last.ahead == cut["ahead"]:
        cut["ahead"] = last.ahead
    return Forecast(msgspec.structs.replace(message, controller=None, **cut, **same), told.place, told.heard)
