"""Check of a report's force prediction: error against the recording on held-out blocks, without and with the effects.

The report stores the specific force that its model predicts. The measured force comes from the recording alone: the
accelerometer, or below 18 Hz the derivative of velocity less gravity, with a zero-phase filter of 1.5 Hz. Held out are
the odd blocks of 10 s, which no effect is fitted to. The gain is 1 - rms(after) / rms(before); its interval comes from
resampling whole blocks, because the error within a block is correlated.
Source: Efron & Tibshirani 1993, ch. 8 (block bootstrap).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import butter, filtfilt

from fleet.contract import Sample
from fleet.frames import G, ned_to_body
from fleet.telemetry.recording.recordings import replay_messages

NOT_IN_FORCES = frozenset(
    {"baro_bias", "gps_latency", "gyro_bias", "accel_bias", "imu_misalignment", "heading_bias", "turbulence"}
)
"""Effects that a prediction of forces from the other sensors does not show."""
_STEP_S, _CUTOFF_HZ, _BLOCK_S = 0.04, 1.5, 10.0
_VANE_HZ, _MIN_SPEED, _MAX_GAP_S = 18.0, 6.0, 1.0
_MIN_ROWS, _MIN_BLOCKS = 50, 3
_RESAMPLES, _SEED = 500, 17
_LEVELS = 2.5, 97.5  # percentiles of the interval


@dataclass(frozen=True)
class ForceCheck:
    """Rms errors of specific force on held-out blocks [m/s2], and the 95 % interval of the gain.

    Attributes:
        before, after: predicted without and with the effects
        constant: the mean force of the other blocks as prediction
        low, high: limits of the gain [-]
    """

    before: float
    after: float
    constant: float
    low: float
    high: float

    @property
    def gain(self) -> float:
        """Return the relative drop of the error."""
        return 1.0 - self.after / self.before if self.before > 0.0 else 0.0

    @property
    def improves(self) -> bool:
        """Return whether the effects reduce the error."""
        return self.gain > 0.0

    @property
    def proven(self) -> bool:
        """Return whether the interval of the gain excludes zero."""
        return self.low > 0.0

    @property
    def predicts(self) -> bool:
        """Return whether the prediction with the effects is better than a constant."""
        return self.after < self.constant


def check_forces(recording: Path, predictions: Path) -> ForceCheck | None:
    """Evaluate stored predictions, t f_base f_model, against a recording; None with too few held-out blocks.

    Raises:
        ValueError: if a file is not readable; the text names it.
        OSError: if a file does not exist.
    """
    with np.load(predictions) as stored:
        t, before, after = (np.asarray(stored[name], float) for name in ("t", "f_base", "f_model"))
    measured, valid = measured_force(recording, t)
    valid &= np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    return held_out_gain(t, measured, (before, after), valid)


def held_out_gain(
    t: np.ndarray, measured: np.ndarray, predicted: tuple[np.ndarray, np.ndarray], valid: np.ndarray
) -> ForceCheck | None:
    """Compare two predictions, (n, 3) each, on the odd blocks; None with fewer than three of them."""
    block = np.floor(t / _BLOCK_S).astype(int)
    held_out = [np.flatnonzero(valid & (block == k)) for k in np.unique(block) if k % 2 == 1]
    held_out = [rows for rows in held_out if len(rows) >= 5]
    if len(held_out) < _MIN_BLOCKS:
        return None
    fitted = valid & (block % 2 == 0)
    constant = np.broadcast_to(measured[fitted if fitted.any() else valid].mean(axis=0), measured.shape)
    squares = np.array([[((x[rows] - measured[rows]) ** 2).sum() for x in (*predicted, constant)] for rows in held_out])
    count = 3.0 * np.array([len(rows) for rows in held_out])
    rms = np.sqrt(squares.sum(axis=0) / count.sum())
    drawn = np.random.default_rng(_SEED).integers(len(held_out), size=(_RESAMPLES, len(held_out)))
    before, after, _ = squares[drawn].sum(axis=1).T
    low, high = np.percentile(1.0 - np.sqrt(after / np.maximum(before, 1e-12)), _LEVELS)
    without, with_effects, mean = map(float, rms)
    return ForceCheck(without, with_effects, mean, float(low), float(high))


def measured_force(recording: Path, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the specific force FRD at times since the first attitude, (n, 3) [m/s2], and which rows are valid."""
    samples = [message for message in replay_messages(recording) if isinstance(message, Sample)]
    series: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for kind in ("attitude", "velocity", "imu"):
        rows = [r for sample in samples if (r := getattr(sample, kind)) is not None]
        if not rows:
            continue
        times = np.concatenate([r.t.numpy() for r in rows])
        x = np.concatenate([np.asarray(r.x.numpy(), float) for r in rows])
        times, first = np.unique(times, return_index=True)
        series[kind] = times, x[first]
    t_start = float(series["attitude"][0][0])
    grid = np.arange(t[0], t[-1] + _STEP_S, _STEP_S)

    def smooth(kind: str, columns: slice) -> np.ndarray:
        times, x = series[kind]
        on_grid = np.stack([np.interp(grid, times - t_start, column) for column in x[:, columns].T], axis=1)
        return np.asarray(filtfilt(*butter(3, _CUTOFF_HZ, fs=1.0 / _STEP_S), on_grid, axis=0))

    velocity = smooth("velocity", slice(0, 3))
    imu_t = series["imu"][0] if "imu" in series else np.zeros(0)
    if len(imu_t) > _MIN_ROWS and np.median(np.diff(imu_t)) <= 1.0 / _VANE_HZ:
        force, source_t = smooth("imu", slice(0, 3)), imu_t
    else:
        angles = np.unwrap(series["attitude"][1][:, :3], axis=0)
        series["attitude"] = series["attitude"][0], angles
        acceleration = np.gradient(velocity, _STEP_S, axis=0)
        acceleration[:, 2] -= G
        phi, theta, psi = smooth("attitude", slice(0, 3)).T
        force, source_t = ned_to_body(phi, theta, psi, acceleration), series["velocity"][0]
    gaps = np.diff(source_t)
    valid = np.hypot(*velocity[:, :2].T) > _MIN_SPEED
    for k in np.flatnonzero(gaps > max(_MAX_GAP_S, 3.0 * float(np.median(gaps)))):
        valid &= ~((grid > source_t[k] - t_start - 0.5) & (grid < source_t[k + 1] - t_start + 0.5))
    nearest = np.clip(np.searchsorted(grid, t), 0, len(grid) - 1)
    return np.stack([np.interp(t, grid, column) for column in force.T], axis=1), valid[nearest]
