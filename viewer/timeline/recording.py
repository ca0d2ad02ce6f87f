"""Recording of one UAV for replay on the page: rows, predictions every 5 s, and states at a time."""

from functools import lru_cache
from math import isfinite
from typing import Any, NamedTuple

import msgspec
import numpy as np

from fleet.contract import Alert, AlertKey, Array, Link, Mismatch, Status, TwinState
from fleet.frames import wrap
from viewer.store.forecast import ScenePrediction, look_aheads
from viewer.store.track import TRAIL_ROWS
from viewer.store.vehicle import JUMP_S, StatusRecord, Vehicle
from viewer.theme.events import TimelineEvent


class StateRecord(NamedTuple):
    """State of a UAV from a time until the next record."""

    t: float  # data time [s since 1970]
    state: TwinState
    link: Link
    mode: str
    armed: bool
    sentence: str  # of its status
    verdict: str  # of its newest identification
    fit: float | None  # mean over the states [%]
    alerts: dict[AlertKey, Alert]
    mismatch: Mismatch | None


def state_values(vehicle: Vehicle, record: StatusRecord) -> tuple[Any, ...]:
    """Return the fields of a `StateRecord` after its time, of a UAV and its record of the same instant."""
    status, model, fit = vehicle.status or _NO_STATUS, vehicle.model, record.fit
    return (
        record.state,
        status.link,
        status.mode,
        status.armed,
        status.sentence,
        model.verdict.sentence if model is not None else "",
        None if fit is None else float(round(fit)),
        vehicle.alerts,
        vehicle.mismatch,
    )


_NO_STATUS = Status(uav=-1, t=0.0)  # before the first
RETENTION_S = 600.0  # retention of a live flight; a recording is kept completely [s]
PREDICTION_STEP_S = 5.0  # between two recorded predictions [s]
NEAR_STEP_S, NEAR_S, FAR_STEP_S = 1.0, 20.0, 2.5  # step up to NEAR_S of look-ahead, and beyond; drawn as splines [s]
AFTER_S = 20.0  # look-ahead recorded beyond the horizon [s]
GAP_S, GAP_MARGIN_S, MAX_FILLED = 1.6, 0.4, 100  # gaps filled from the trail, margin at their ends [s], most rows
INITIAL_ROWS = 64  # initial capacity, and rows between two checks for expired rows
MAX_ROWS = 8_000  # rows of one UAV; beyond it every second row is dropped
MAX_STATES = 500  # state changes of one UAV; the oldest are dropped first
MAX_PREDICTIONS = 1_500  # predictions of one UAV; beyond it every second one is dropped
PREDICTION_BYTES = 850  # approximate size of a prediction without its arrays
TEXT_FIELDS = ("sentence", "calibration", "law", "method", "origin", "event_text")  # rarely change between predictions
COLUMNS = 7  # east north up [10 m], phi theta psi [rad], Va [m/s]


class UavRecording:
    """Rows of one UAV in the order of data time, in growing arrays."""

    def __init__(self) -> None:
        self.predictions: list[ScenePrediction] = []  # oldest first, reduced by `_reduced`
        self.states: list[StateRecord] = []
        self.events: tuple[TimelineEvent, ...] = ()
        self._t, self._x = np.empty(INITIAL_ROWS), np.empty((INITIAL_ROWS, COLUMNS), np.float32)
        self._n, self._step = 0, 0.0
        self._prediction_bytes = 0
        self._last_returned: ScenePrediction | None = None

    def __len__(self) -> int:
        return self._n

    @property
    def t(self) -> np.ndarray:
        """Return the times of the rows, increasing, (n,) [s since 1970]."""
        return self._t[: self._n]

    @property
    def first_t(self) -> float:
        """Return the time of the first row [s since 1970]; inf without rows."""
        return self._t.item(0) if self._n else np.inf

    @property
    def last_t(self) -> float:
        """Return the time of the last row [s since 1970]; -inf without rows."""
        return self._t.item(self._n - 1) if self._n else -np.inf

    @property
    def x(self) -> np.ndarray:
        """Return the rows, (n, 7): scene ENU [10 m], phi theta psi [rad], Va [m/s]."""
        return self._x[: self._n]

    def nbytes(self) -> int:
        """Return the size of all arrays [bytes]."""
        return self._t.nbytes + self._x.nbytes + self._prediction_bytes

    def record(self, vehicle: Vehicle, trail: np.ndarray, now: float, step_s: float = PREDICTION_STEP_S) -> None:
        """Record the current state of a UAV; `trail`, (n, 5), fills gaps since the last row.

        `now` is monotonic [s], `step_s` the shortest time between two recorded predictions [s].
        """
        t, at, last_t = vehicle.t, vehicle.at, self.last_t
        if t < last_t - JUMP_S:
            self.__init__()  # type: ignore[misc]  # clock step back: another flight
            last_t = self.last_t
        if at is not None and isfinite(t) and t > last_t:
            if len(trail) > 1:
                self._fill(vehicle, trail)
                last_t = self.last_t
            if t >= last_t + self._step:
                self._append(t, (*at.tolist(), *vehicle.attitude, vehicle.Va), recorded=vehicle.recorded)
        self._record_state(vehicle, now, step_s)

    def _fill(self, vehicle: Vehicle, trail: np.ndarray) -> None:
        """Insert positions between two records, as for a fast replay; heading is the course."""
        last = self.last_t
        if vehicle.t - last < GAP_S:
            return
        between = trail[(trail[:, 0] > last + GAP_MARGIN_S) & (trail[:, 0] < vehicle.t - GAP_MARGIN_S)]
        between = between[:: max(1, len(between) // MAX_FILLED)]
        step = np.gradient(between[:, 1:3], axis=0) if len(between) > 1 else np.zeros((len(between), 2))
        for row, psi in zip(between, np.arctan2(*step.T), strict=True):
            self._append(float(row[0]), (*row[1:4], 0.0, 0.0, psi, row[4]), recorded=vehicle.recorded)

    def _append(self, t: float, row: tuple[float, ...], *, recorded: bool) -> None:
        if self._n and self._n % INITIAL_ROWS == 0 and not recorded:
            old = int(np.searchsorted(self.t, self._t[self._n - 1] - RETENTION_S))
            if old > self._n // 8:  # expired rows of a live flight
                self._retain(slice(old, self._n))
        if self._n == len(self._t) and self._n >= MAX_ROWS:
            self._step = 2 * float(np.median(np.diff(self.t)))
            self._retain(slice(self._n % 2, self._n, 2))
        elif self._n == len(self._t):
            self._t = np.concatenate([self._t, np.empty(self._n)])
            self._x = np.concatenate([self._x, np.empty((self._n, COLUMNS), np.float32)])
        self._t[self._n], self._x[self._n] = t, row
        self._n += 1

    def _retain(self, rows: slice) -> None:
        t, x = self.t[rows].copy(), self.x[rows].copy()
        self._n = len(t)
        self._t[: self._n], self._x[: self._n] = t, x

    def _record_state(self, vehicle: Vehicle, now: float, step_s: float) -> None:
        """Record the newest prediction if due, and the state if it changed."""
        at = vehicle.data_time(now)
        if not isfinite(at):
            return
        forecast, self.events = vehicle.forecast, vehicle.events
        if forecast is not None and (not self.predictions or forecast.t >= self.predictions[-1].t + step_s):
            self.predictions.append(_reduced(forecast, self.predictions[-1] if self.predictions else None))
            self._prediction_bytes += _size_bytes(self.predictions[-1])
        values = state_values(vehicle, vehicle.record(now))
        if not self.states or self.states[-1][1:] != values:
            self.states.append(StateRecord(at, *values))
            del self.states[:-MAX_STATES]
        if not vehicle.recorded:
            if self.predictions and self.predictions[0].t < at - RETENTION_S:
                self._prediction_bytes -= _size_bytes(self.predictions.pop(0))
            if len(self.states) > 1 and self.states[1].t < at - RETENTION_S:  # the first is valid until the second
                del self.states[0]
        if len(self.predictions) > MAX_PREDICTIONS:
            self.predictions = self.predictions[::2]
            self._prediction_bytes = sum(map(_size_bytes, self.predictions))

    def row_at(self, t: float) -> np.ndarray:
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

    def trail_rows(self, begin: float, end: float) -> np.ndarray:
        """Return the last trail rows between two times: (n, 5) time, scene ENU [10 m], Va [m/s]."""
        path = self.path(begin, end)[-TRAIL_ROWS:]
        return np.column_stack([path, np.interp(path[:, 0], self.t, self.x[:, 6])]) if len(path) else np.zeros((0, 5))

    def prediction_at(self, t: float) -> ScenePrediction | None:
        """Return the newest prediction at a time; release the scene arrays of the last one returned."""
        prediction = next((candidate for candidate in reversed(self.predictions) if candidate.t <= t + 0.5), None)
        if self._last_returned is not None and self._last_returned is not prediction:
            self._last_returned.release_arrays()
        self._last_returned = prediction
        return prediction

    def state_at(self, t: float) -> StateRecord | None:
        """Return the state at a time; None before the first."""
        return next((record for record in reversed(self.states) if record.t <= t), None)


def _size_bytes(forecast: ScenePrediction) -> int:
    """Return the approximate size of a recorded prediction [bytes]."""
    return len(forecast.message.path.data) + len(forecast.message.prediction_region_half_axes.data) + PREDICTION_BYTES


def _reduced(forecast: ScenePrediction, previous: ScenePrediction | None) -> ScenePrediction:
    """Reduce a prediction to what is drawn: look-aheads up to `AFTER_S` past the horizon, shared texts."""
    message = forecast.message
    ahead = look_aheads(message.ahead).s
    indices, recorded = _recorded_look_aheads(
        message.ahead, max(int(np.searchsorted(ahead, forecast.horizon_s + AFTER_S)) + 1, 2)
    )
    last = previous.message if previous is not None else None
    same = {name: getattr(last, name) for name in TEXT_FIELDS if getattr(last, name, None) == getattr(message, name)}
    names = ("path", "prediction_region_half_axes")
    arrays = {name: Array.of(getattr(message, name).numpy()[indices]) for name in names}
    arrays["ahead"] = last.ahead if last is not None and last.ahead == recorded else recorded
    return ScenePrediction(
        msgspec.structs.replace(message, controller=None, **arrays, **same), forecast.scene_frame, forecast.received
    )


@lru_cache(maxsize=256)
def _recorded_look_aheads(ahead: Array, n: int) -> tuple[np.ndarray, Array]:
    """Return the indices of the look-aheads recorded of the first n, and these look-aheads."""
    s = look_aheads(ahead).s[:n]
    first, last_s = float(s[0]), float(s[-1])
    near_end = min(first + NEAR_S, last_s)
    near, far = np.arange(first, near_end, NEAR_STEP_S), np.arange(near_end, last_s, FAR_STEP_S)
    indices = np.unique(np.searchsorted(s, np.concatenate([near, far, [last_s]])))
    return indices, Array.of(s[indices])
