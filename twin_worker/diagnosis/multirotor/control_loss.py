"""Loss of control of a multirotor, from its attitude and motor outputs alone.

The moments of the outputs predict the angular acceleration over a short window: a regression on the rows of calm
flight, with its usual error. Control is lost where the rotation is fast, its acceleration deviates from this prediction
against what the outputs demand, and the aircraft falls over within two seconds. If the specific force shows an impact
then, the outputs had been answered until that impact. A motor without thrust turns the frame towards its place although
its output is raised; the working motors explain what follows.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import degrees

import numpy as np

from fleet.frames import G
from twin_worker.numerics.interpolation import zero_order_hold
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.telemetry.motors import RotorFrame, motor_inputs, rotor_frame

MIN_HZ = 8.0  # of attitude and motor outputs
_WINDOW_S = 0.3
_FAST = 2.0  # rate of rotation, beyond those of usual flight [rad/s]
_SIGMAS = 6.0  # deviation over its usual size
_IMPACT = 4 * G  # specific force that no rotor gives [m/s2]
_IMPACT_S = 0.4  # between an impact and the deviation
_MIN_COSINE = 0.7  # between the deviation and the direction to a motor
_COURSE_S = 0.8  # after the beginning, in which the working motors explain the rotation [s]
_MIN_ROWS, _MIN_CALM = 100, 50
_LEAN = 1.2  # beyond it the aircraft has fallen over [rad]
_FALL_S = 2.0  # from the deviation until then


@dataclass(frozen=True)
class ControlLoss:
    """Loss of control.

    Attributes:
        t: since the first attitude [s]
        motors: indices of the motors of which one gave no thrust; empty: not a motor, or undecided
        sentence: what happened, where and since when
    """

    t: float
    motors: tuple[int, ...]
    sentence: str


@dataclass(frozen=True)
class _Rotation:
    """Angular acceleration, moments of the outputs, rates and outputs at common times, since the first attitude."""

    t: np.ndarray
    acceleration: np.ndarray
    moments: np.ndarray
    rates: np.ndarray
    inputs: np.ndarray
    window_inputs: np.ndarray  # mean over the window, (n, m)
    lean: np.ndarray  # roll and pitch, (n, 2) [rad]
    upright: np.ndarray


def unjudged(history: TelemetryHistory, params: Mapping[str, float]) -> str:
    """Return why control cannot be judged, as a sentence; empty if it can be."""
    if rotor_frame(params) is None:
        return "the parameters name no frame whose motors are known"
    for kind, word in (("attitude", "attitude"), ("servo", "motor outputs")):
        t = history.rows(kind)[0]
        if len(t) < _MIN_ROWS:
            return f"no {word} recorded"
        if (hertz := 1.0 / float(np.median(np.diff(t)))) < 0.95 * MIN_HZ:
            return f"{word} at {hertz:.1f} Hz; below {MIN_HZ:.0f} Hz they do not show how the frame answers its motors"
    return ""


def find_control_loss(history: TelemetryHistory, params: Mapping[str, float]) -> ControlLoss | None:
    """Return the first loss of control; None without any, or where `unjudged` gives a reason."""
    frame = rotor_frame(params)
    if frame is None or unjudged(history, params):
        return None
    rotation = _rotation(history, params, frame)
    if rotation is None:
        return None
    deviation, usual = _deviation(rotation)
    quick = rotation.t[np.abs(rotation.rates).max(axis=1) > _FAST]
    fast = np.append(quick, np.inf)[np.searchsorted(quick, rotation.t)] - rotation.t < _WINDOW_S
    falls = rotation.t[~rotation.upright & (np.abs(rotation.lean) > _LEAN).any(axis=1)]
    later = np.searchsorted(falls, rotation.t)
    soon = np.append(falls, np.inf)[later] - rotation.t < _FALL_S
    lost = fast & soon & (np.linalg.norm(deviation / usual, axis=1) > _SIGMAS)
    if not lost.any():
        return None
    first = int(np.flatnonzero(lost)[0])
    begin = _beginning(rotation, deviation / usual, first)
    return _impact(history, begin) or _motor(rotation, deviation, frame, (begin, first))


def _rotation(history: TelemetryHistory, params: Mapping[str, float], frame: RotorFrame) -> _Rotation | None:
    attitude_t, attitude = history.rows("attitude")
    imu_t, imu = history.rows("imu")
    servo_t, servo = history.rows("servo")
    t_start = float(attitude_t[0])
    faster = len(imu_t) > _MIN_ROWS and np.median(np.diff(imu_t)) < np.median(np.diff(attitude_t))
    times, rates = (imu_t, imu[:, 3:5]) if faster else (attitude_t, attitude[:, 3:5])
    step = float(np.median(np.diff(times)))
    grid = np.arange(max(times[0], servo_t[0]), min(times[-1], servo_t[-1]), step)
    n = max(round(_WINDOW_S / step), 2)
    if len(grid) < _MIN_ROWS + n:
        return None
    on_grid = np.stack([np.interp(grid, times, column) for column in rates.T], axis=1)
    inputs = zero_order_hold(servo_t, motor_inputs(servo[:, : frame.places.shape[1]], params), grid, np.inf)
    sums = np.cumsum(np.vstack([np.zeros(inputs.shape[1]), inputs]), axis=0)
    window_inputs = (sums[n:-1] - sums[: -n - 1]) / n  # over the window before each row
    lean = np.stack([np.interp(grid, attitude_t, column) for column in attitude[:, :2].T], axis=1)
    return _Rotation(
        grid[n:] - t_start,
        (on_grid[n:] - on_grid[:-n]) / (n * step),
        window_inputs @ frame.mixer[:, :2],
        on_grid[n:],
        inputs[n:],
        window_inputs,
        lean[n:],
        (np.abs(lean[n:]) < _LEAN).all(axis=1) & (inputs[n:].mean(axis=1) > 0.5 * np.median(inputs.mean(axis=1))),
    )


def _deviation(rotation: _Rotation) -> tuple[np.ndarray, np.ndarray]:
    """Return the angular acceleration that the outputs do not give, (n, 2) [rad/s2], and its usual size, (2,)."""
    calm = rotation.upright & (np.abs(rotation.rates).max(axis=1) < 0.5 * _FAST)
    out, usual = np.zeros(rotation.acceleration.shape), np.ones(2)
    demanded = np.zeros(out.shape)
    for axis in range(2):
        x, y = rotation.moments[:, axis], rotation.acceleration[:, axis]
        rows = calm if calm.sum() >= _MIN_CALM else np.ones(len(x), bool)
        centred = x[rows] - x[rows].mean()
        gain = float(centred @ y[rows]) / max(float(centred @ centred), 1e-9)
        demanded[:, axis] = max(gain, 0.0) * (x - np.median(x[rows]))
        out[:, axis] = y - demanded[:, axis]
        usual[axis] = max(1.4826 * float(np.median(np.abs(out[rows, axis]))), float(np.std(out[rows, axis])), 1e-3)
    as_demanded = (rotation.acceleration * demanded / usual**2).sum(axis=1) > 0
    out[as_demanded] = 0.0  # it turns as demanded, however fast: the gain of calm flight is biased towards zero
    return out, usual


def _beginning(rotation: _Rotation, scaled: np.ndarray, first: int) -> float:
    """Return when the deviation that is sure at row `first` began [s]: half of it, at most a window earlier."""
    size = np.linalg.norm(scaled, axis=1)
    k = first
    while k > 0 and rotation.t[first] - rotation.t[k - 1] < 2 * _WINDOW_S and size[k - 1] > 0.5 * _SIGMAS:
        k -= 1
    return float(rotation.t[k] - _WINDOW_S)


def _impact(history: TelemetryHistory, begin: float) -> ControlLoss | None:
    imu_t, imu = history.rows("imu")
    if not len(imu_t):
        return None
    since = imu_t - history.rows("attitude")[0][0]
    force = np.linalg.norm(imu[:, :3], axis=1)
    near = np.flatnonzero((since > begin - _IMPACT_S) & (since < begin + _IMPACT_S + _WINDOW_S) & (force > _IMPACT))
    if not len(near):
        return None
    t, most = float(since[near[0]]), float(force[near].max())
    return ControlLoss(
        t,
        (),
        f"impact at {t:.1f} s: the specific force reaches {most / G:.0f} g; until then the frame turned as its motor "
        "outputs demand, so no motor failed before it; what follows cannot be distinguished from damage",
    )


def _motor(rotation: _Rotation, deviation: np.ndarray, frame: RotorFrame, event: tuple[float, int]) -> ControlLoss:
    """Return the motors that the first movement and the next `_COURSE_S` indicate; one if they agree."""
    begin, first = event
    direction = deviation[first]
    rate = degrees(float(np.abs(rotation.rates[first]).max()))
    towards = -frame.mixer[:, :2] / np.linalg.norm(frame.mixer[:, :2], axis=1)[:, None]
    cosine = towards @ direction / max(float(np.linalg.norm(direction)), 1e-9)
    motors = tuple(sorted({int(np.argmax(cosine)), _best_without(rotation, frame, begin)}))
    turns = f"it turns {_turned(direction)} at {rate:.0f} deg/s against its motor outputs"
    what = f"loss of control since {begin:.1f} s: {turns}"
    places = [f"motor {k + 1} ({frame.sides[k]})" for k in motors]
    rows = (rotation.t > begin) & (rotation.t < begin + _COURSE_S)
    raised = [f"{x:.0%}" for x in rotation.inputs[rows].max(axis=0)[list(motors)]]
    if cosine[list(motors)].max() < _MIN_COSINE:
        return ControlLoss(begin, (), f"{what}; no single motor explains this direction")
    cause = f"{' or '.join(places)} gives no thrust although raised to {' and '.join(raised)}"
    also = "" if len(motors) == 1 else "; which of them is not separable at this rate of the log"
    return ControlLoss(begin, motors, f"{what}: {cause}{also}; propeller, motor, ESC and arm are not separable")


def _best_without(rotation: _Rotation, frame: RotorFrame, begin: float) -> int:
    """Return the motor without whose thrust the other outputs explain the rotation after `begin` best."""
    rows = (rotation.t > begin) & (rotation.t < begin + _WINDOW_S + _COURSE_S)
    usual = np.median(rotation.window_inputs, axis=0) @ frame.mixer[:, :2]
    errors = []
    for motor in range(frame.places.shape[1]):
        working = np.arange(frame.places.shape[1]) != motor
        moments = (rotation.window_inputs[rows] * working) @ frame.mixer[:, :2] - usual
        acceleration = rotation.acceleration[rows]
        gain = np.maximum((moments * acceleration).sum(axis=0) / np.maximum((moments**2).sum(axis=0), 1e-9), 0.0)
        errors.append(float(((acceleration - gain * moments) ** 2).sum()))
    return int(np.argmin(errors))


def _turned(direction: np.ndarray) -> str:
    """Return the direction of a roll and pitch acceleration in words."""
    roll = "right" if direction[0] > 0 else "left"
    pitch = "nose up" if direction[1] > 0 else "nose down"
    share = np.abs(direction) / max(float(np.abs(direction).max()), 1e-9)
    return " and ".join([*([roll] if share[0] > 0.4 else []), *([pitch] if share[1] > 0.4 else [])])
