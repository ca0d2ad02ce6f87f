"""Estimate wind and airspeed scale from ground velocity, airspeed and heading: Kalman filter on the wind triangle."""

from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass
from math import asin, atan2, cos, exp, hypot, inf, isfinite, log, sin, sqrt

import numpy as np

from fleet.autopilots.control_law import eas2tas
from fleet.frames import G, air_direction, wrap
from fleet.physics.kernel import kernel
from twin_worker.telemetry.history import TelemetryHistory

DRIFT_S = 60.0  # correlation time of slow changes of the wind [s]
GUST, GUST_S = 0.8, 7.0  # turbulence along the flight: standard deviation, correlation time [m/s, s]
_DRIFTS = np.array([0.15, 0.6, 2.4])  # hypotheses on their standard deviation [m/s]
_TYPICAL = 1  # index of the hypothesis whose state is used
_DRIFT_EVIDENCE_S = 300.0  # time constant of their log-likelihoods: weather changes within minutes
_RANDOM_WALK = 0.01  # random walk of the mean [m/s per sqrt(s)]
_HEADING_WALKS = (
    0.0,
    0.02,
)  # random walk of the heading bias: constant, drifting [rad per sqrt(s)]
_EVIDENCE_S = 60.0  # time constant of the log-likelihood ratio of the two walks [s]
_EVIDENCE = 3.0  # log-likelihood ratio from which the bias drifts: 20 to 1
_AIRSPEED_S = 30.0  # time constant of the mean airspeed: longer than gusts [s]
_SIGMA = 1.0  # sideslip and sensors in one ground-velocity component [m/s]
_YAW_LAG_S = 1.0  # between bank and turn of the nose [s]
_GATE = 25.0  # normalised innovation squared (NIS) from which a row is rejected
_NIS_AVERAGE_S = 60.0  # time constant of the mean NIS [s]
_MIN_NIS, _MAX_NIS = 0.05, 10.0  # bounds of the mean NIS [-]
_MAX_SPEED = 1e3  # larger airspeeds and ground speeds are noise [m/s]
_MAX_WIND = 150.0  # a larger wind is invalid: the filter restarts [m/s]
_INITIAL_SIGMA = np.array([0.03, 0.03, 6.0, 6.0, 0.0, 0.0, GUST, GUST])  # without the drift


@kernel
def _predict_and_correct(
    x: np.ndarray,
    P: np.ndarray,
    readings: tuple[float, ...],
    variance: float,
    gate: float,
    drift: float,
    heading_walk: float,
) -> tuple[float, float]:
    """Predict state and covariance by dt and correct them with one ground velocity that passes the gate.

    Args:
        x, P: state (8,) and covariance (8, 8), changed in place
        readings: time since the previous row [s]; reported air velocity by the attitude, north, east; mean reported
            airspeed of the last half minute; ground velocity of the previous row and of this one, north, east [m/s]
        variance: of sideslip and sensors in each of its components [m2/s2]
        gate: NIS from which the correction is skipped
        drift: standard deviation of the slow changes of the wind [m/s]
        heading_walk: random walk of the heading bias [rad per sqrt(s)]
    Returns:
        the normalised innovation squared (NIS); the log-likelihood of the row without its constant

    A gust changes the readings of airspeed and heading at once and the ground velocity late: corrections weighted with
    these readings reduce the scale by 1 to 3 %. Instruments that a gust does not change weigh them: the mean airspeed,
    and the direction of the previous ground velocity minus the wind.
    Source: Bar-Shalom 2001, 5.2.4 (Joseph form); Söderström & Stoica 1983 (instrumental variables).
    """
    dt, c, s, mean_airspeed, north_before, east_before, north, east = readings
    decay, H, HP, y = np.ones(8), np.zeros((2, 8)), np.zeros((2, 8)), np.empty(2)
    for i in range(2):
        decay[4 + i], decay[6 + i] = exp(-dt / DRIFT_S), exp(-dt / GUST_S)
        H[i, 2 + i] = H[i, 4 + i] = H[i, 6 + i] = 1.0
    y[0], y[1] = north - c * x[0] + s * x[1], east - s * x[0] - c * x[1]
    for i in range(8):
        x[i] *= decay[i]
        for j in range(8):
            P[i, j] *= decay[i] * decay[j]
        sigma = drift if i < 6 else GUST
        walk = 1e-8 if i < 2 else _RANDOM_WALK**2 * dt if i < 4 else sigma**2 * (1.0 - decay[i] ** 2)
        P[i, i] += walk
    P[0, 0] += (heading_walk * x[1]) ** 2 * dt  # the walk turns (a, b)
    P[1, 1] += (heading_walk * x[0]) ** 2 * dt
    P[0, 1] -= heading_walk**2 * x[0] * x[1] * dt
    P[1, 0] -= heading_walk**2 * x[0] * x[1] * dt
    n, e = north_before - x[2] - x[4], east_before - x[3] - x[5]
    calm_speed = sqrt((n * n + e * e) * (x[0] * x[0] + x[1] * x[1]))
    if calm_speed > 3.0:  # the instruments; else the readings themselves
        c, s = mean_airspeed * (n * x[0] + e * x[1]) / calm_speed, mean_airspeed * (e * x[0] - n * x[1]) / calm_speed
    H[0, 0], H[0, 1], H[1, 0], H[1, 1] = c, -s, s, c
    for k in range(2):
        for i in range(8):
            if i > 1:
                y[k] -= H[k, i] * x[i]
            for j in range(8):
                HP[k, i] += H[k, j] * P[j, i]
    S00 = S01 = S11 = 0.0
    for i in range(8):
        S00, S01, S11 = S00 + HP[0, i] * H[0, i], S01 + HP[0, i] * H[1, i], S11 + HP[1, i] * H[1, i]
    S00, S11 = S00 + variance, S11 + variance
    det = S00 * S11 - S01 * S01
    a, b = (S11 * y[0] - S01 * y[1]) / det, (S00 * y[1] - S01 * y[0]) / det
    nis = y[0] * a + y[1] * b
    if nis < gate:
        _correct(x, P, H, HP, np.array((a, b)), np.array((S11 / det, -S01 / det, S00 / det)), variance)
    return nis, -0.5 * (min(nis, _GATE) + log(det))


@kernel
def _correct(
    x: np.ndarray,
    P: np.ndarray,
    H: np.ndarray,
    HP: np.ndarray,
    weighted: np.ndarray,
    S_inv: np.ndarray,
    variance: float,
) -> None:
    K, A, AP = np.empty((8, 2)), np.eye(8), np.zeros((8, 8))
    for i in range(8):
        x[i] += HP[0, i] * weighted[0] + HP[1, i] * weighted[1]
        K[i, 0], K[i, 1] = HP[0, i] * S_inv[0] + HP[1, i] * S_inv[1], HP[0, i] * S_inv[1] + HP[1, i] * S_inv[2]
        for j in range(8):
            A[i, j] -= K[i, 0] * H[0, j] + K[i, 1] * H[1, j]
    for i in range(8):
        for k in range(8):
            for j in range(8):
                AP[i, j] += A[i, k] * P[k, j]
    for i in range(8):
        for j in range(8):
            P[i, j] = variance * (K[i, 0] * K[j, 0] + K[i, 1] * K[j, 1])
            for k in range(8):
                P[i, j] += AP[i, k] * A[j, k]


@kernel
def _update_hypotheses(
    x: np.ndarray,
    P: np.ndarray,
    mean_nis: np.ndarray,
    walk_evidence: np.ndarray,
    drift_evidence: np.ndarray,
    readings: tuple[float, ...],
    variance: float,
    gate: float,
) -> bool:
    """Update the state of every hypothesis, and the evidence of each; return whether all winds are plausible.

    Args:
        x, P, mean_nis, walk_evidence, drift_evidence: as in `WindFilter`, changed in place
        readings, variance, gate: see `_predict_and_correct`
    """
    dt = readings[0]
    plausible, likeliest, mean = True, np.empty(len(_DRIFTS)), 0.0
    for i in range(len(_DRIFTS)):
        constant = likelihood = 0.0
        for j in range(len(_HEADING_WALKS)):
            walk = _HEADING_WALKS[j]
            nis, likelihood = _predict_and_correct(x[i, j], P[i, j], readings, variance, gate, _DRIFTS[i], walk)
            mean_nis[i, j] += dt / _NIS_AVERAGE_S * (min(nis, _GATE) / 2 - mean_nis[i, j])
            if j == 0:
                constant = likelihood
            wind_n, wind_e = x[i, j, 2] + x[i, j, 4], x[i, j, 3] + x[i, j, 5]
            total = 0.0
            for k in range(8):
                for m in range(8):
                    total += abs(P[i, j, k, m])
            plausible = plausible and wind_n * wind_n + wind_e * wind_e < _MAX_WIND**2 and total < inf  # false for nan
        walk_evidence[i] += likelihood - constant - min(dt / _EVIDENCE_S, 1.0) * walk_evidence[i]
        likeliest[i] = likelihood if walk_evidence[i] > _EVIDENCE else constant
        mean += likeliest[i] / len(_DRIFTS)
    for i in range(len(_DRIFTS)):
        drift_evidence[i] += likeliest[i] - mean - min(dt / _DRIFT_EVIDENCE_S, 1.0) * drift_evidence[i]
    return plausible


@dataclass(init=False, eq=False)
class WindFilter:
    """Estimate a, b, mean, drift, gust of  v = Va cos(gamma) (a e(psi) + b e(psi + 90 deg)) + mean + drift + gust.

    psi is the direction by the attitude (`fleet.frames.air_direction`); a, b are airspeed scale times cosine and sine
    of the heading bias. The mean is a random walk. Drift and gust are first-order Gauss-Markov processes, which
    separates gusts from wind. The heading bias is constant, or drifts as that
    of an attitude estimate in a long turn does: both hypotheses are filtered, and the likelihood of the flight selects.
    How much the wind drifts depends on the weather: three standard deviations are filtered, and their posterior mean
    variance tells how much the wind may change in the next minutes. The state is that of the middle one.
    Source: Beard & McLain 2012, sec. 2.4 (wind triangle); Bar-Shalom 2001, 5.4 (gating), 8.2 (coloured noise), 11.6.2
    (static multiple-model estimator).
    """

    t: float
    _x: np.ndarray  # of each hypothesis: drift, heading walk, (3, 2, 8)
    _P: np.ndarray  # (3, 2, 8, 8)
    _walk_evidence: np.ndarray  # log-likelihood ratio of the drifting over the constant heading bias, (3,)
    _drift_evidence: np.ndarray  # log-likelihood of each drift, without their mean, (3,)
    _row_count: int
    _mean_nis: np.ndarray  # (3, 2)
    _mean_airspeed: float  # reported [m/s]
    _ground: tuple[float, float]  # ground velocity of the newest row, north, east [m/s]
    _scale: float  # true over reported airspeed, expected at the first row [-]

    def __init__(self) -> None:
        self.t, self._scale = -np.inf, 1.0
        self._reset()

    @property
    def _selected_walks(self) -> np.ndarray:
        """Return the selected hypothesis on the heading bias for each drift, (3,)."""
        return (self._walk_evidence > _EVIDENCE).astype(int)

    @property
    def _selected(self) -> tuple[int, int]:
        return _TYPICAL, int(self._selected_walks[_TYPICAL])

    @property
    def x(self) -> np.ndarray:
        """Return the state of typical drift and the likelier heading bias, (8,)."""
        return self._x[self._selected]

    @property
    def P(self) -> np.ndarray:
        """Return its covariance, (8, 8)."""
        return self._P[self._selected]

    def update(self, t: float, ground: Iterable[float], Va: float, psi: float, p: float = 0.0) -> None:
        """Update with one row.

        Args:
            t: time [s since 1970]
            ground: ground velocity NED, (3,) [m/s]
            Va: reported airspeed [m/s]
            psi: direction of the velocity through the air by the reported attitude [rad]
            p: roll rate; the nose follows the turn late, which is sideslip while the bank changes [rad/s]
        """
        dt = min(t - self.t, 5.0) if isfinite(self.t) else 0.2
        north, east, down = map(float, ground)
        if dt <= 0 or not 3.0 <= Va < _MAX_SPEED or not hypot(north, east, down) < _MAX_SPEED:
            return
        self.t = t
        self._mean_airspeed += min(dt / _AIRSPEED_S, 1.0) * (Va - self._mean_airspeed) if self._row_count else Va
        level = Va * sqrt(max(1 - (down / Va) ** 2, 0.25))
        self._row_count += 1
        gate = inf if self._row_count < 50 else _GATE
        readings = (dt, level * cos(psi), level * sin(psi), self._mean_airspeed, *self._ground, north, east)
        self._ground = north, east
        variance = _SIGMA**2 + (_YAW_LAG_S * G * p) ** 2
        evidence = self._walk_evidence, self._drift_evidence
        if not _update_hypotheses(self._x, self._P, self._mean_nis, *evidence, readings, variance, gate):  # type: ignore[call-arg]
            self._reset()

    def expect_scale(self, altitude: float) -> None:
        """Begin with the scale of the standard atmosphere at an altitude [m]; ignored after the first row.

        Most autopilots report equivalent, some true airspeed: half of the difference is a standard deviation.
        """
        if not self._row_count:
            self._scale = eas2tas(altitude)
            self._begin_scale()

    def _begin_scale(self) -> None:
        self._x[..., 0] = self._scale
        self._P[..., 0, 0] = _INITIAL_SIGMA[0] ** 2 + (0.5 * (self._scale - 1.0)) ** 2

    def _reset(self) -> None:
        """Reset the estimates to zero wind; the time stays."""
        drifts, walks = len(_DRIFTS), len(_HEADING_WALKS)
        self._x = np.zeros((drifts, walks, 8))
        self._P = np.tile(np.diag(_INITIAL_SIGMA**2), (drifts, walks, 1, 1))
        self._begin_scale()
        self._P[..., [4, 5], [4, 5]] = (_DRIFTS**2)[:, None, None]
        self._row_count, self._mean_nis = 0, np.ones((drifts, walks))
        self._mean_airspeed, self._ground = 0.0, (0.0, 0.0)
        self._walk_evidence, self._drift_evidence = np.zeros(drifts), np.zeros(drifts)

    def reset_wind(self, t: float, wind: np.ndarray) -> None:
        """Set the wind at time `t` [s since 1970], NED, (3,) [m/s]; ignore an implausible wind."""
        if not hypot(*wind[:2]) < _MAX_WIND:
            return
        self.t = t
        self._x[..., 2:6] = *wind[:2], 0.0, 0.0  # mean; zero drift

    def inflate_after_step(self, wind: np.ndarray, scale: float, relative_sigma: float) -> None:
        """Apply a step of wind and airspeed scale and inflate the covariance by `relative_sigma` of the step.

        Args:
            wind: added wind, NED, (3,) [m/s]
            scale: factor on true over reported airspeed [-]
            relative_sigma: standard deviation as a fraction of the step

        An implausible step is ignored.
        """
        if not (hypot(*wind[:2]) < _MAX_WIND and 0.0 < scale < inf):
            return
        for x, P in zip(self._x.reshape(-1, 8), self._P.reshape(-1, 8, 8), strict=True):  # views
            x[2:4] += wind[:2]
            P[[2, 3], [2, 3]] += (relative_sigma * wind[:2]) ** 2
            P[[0, 1], [0, 1]] += (relative_sigma * (scale - 1.0) * x[:2]) ** 2
            x[:2] *= scale

    @property
    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a, b, mean, drift and gust, north before east, (8,) [-, m/s], and their covariance, (8, 8)."""
        return self.x.copy(), self.P.copy()

    @property
    def wind(self) -> np.ndarray:
        """Return the wind without gusts, NED, the direction it blows to, (3,) [m/s]."""
        x = self.x
        return np.array([x[2] + x[4], x[3] + x[5], 0.0])

    @property
    def present_wind(self) -> tuple[np.ndarray, float]:
        """Return the wind with gust, north and east, (2,) [m/s], and the mean variance of a component [m2/s2]."""
        total = np.tile(np.eye(2), (1, 3))
        cov = total @ self.P[2:, 2:] @ total.T
        return total @ self.x[2:], float(cov.trace() / 2)

    @property
    def drift_sigma(self) -> float:
        """Return the standard deviation of slow changes of the wind: root of the posterior mean variance [m/s]."""
        weight = np.exp(self._drift_evidence - self._drift_evidence.max())
        return sqrt(float(weight @ _DRIFTS**2 / weight.sum()))

    @property
    def innovation_ratio(self) -> float:
        """Return the root of the mean NIS of the last minute: measured over assumed innovation [-]."""
        return sqrt(min(max(float(self._mean_nis[self._selected]), _MIN_NIS), _MAX_NIS))

    @property
    def scale(self) -> float:
        """Return true over reported airspeed [-]."""
        return hypot(self.x[0], self.x[1])

    @property
    def heading_bias(self) -> float:
        """Return air-velocity direction minus reported heading [rad]."""
        return atan2(self.x[1], self.x[0])

    @property
    def sigma(self) -> float:
        """Return the standard deviation of the larger component of the wind without gusts [m/s]."""
        P = self.P
        total = P[2:4, 2:4] + P[2:4, 4:6] + P[4:6, 2:4] + P[4:6, 4:6]
        return sqrt(max(total[0, 0], total[1, 1]))


_ROW_INTERVAL_S = 0.199  # interval of the rows used [s]
_STALE_S = 0.5  # older airspeed and heading are not combined with a velocity [s]
_MIN_AIRSPEED, _MAX_PATH_SINE, _MAX_BANK = 3.0, 0.5, 1.2  # bounds of the direction by attitude [m/s, -, rad]


def reported_direction(phi: float, theta: float, psi: float, down: float, Va: float) -> float:
    """Return the direction through the air by reported attitude [rad], sink rate and airspeed [m/s], [rad]."""
    gamma = -asin(min(max(down / max(Va, _MIN_AIRSPEED), -_MAX_PATH_SINE), _MAX_PATH_SINE))
    return float(air_direction(min(max(phi, -_MAX_BANK), _MAX_BANK), theta, psi, gamma))


def update_from_history(
    wind_filter: WindFilter, history: TelemetryHistory, last_t: float, since: float, until: float = inf
) -> float:
    """Update the filter with five ground velocities a second; return the time of the newest [s since 1970].

    Args:
        wind_filter: changed in place
        history: telemetry
        last_t: time of the newest row used so far [s since 1970]
        since, until: rows before and after are skipped [s since 1970]
    """
    times, velocity = history.rows_since("velocity", since)
    air_times, air = history.rows_since("air", since - 1.0)
    att_times, attitude = history.rows_since("attitude", since - 1.0)
    position_times, position = history.rows_since("position", since - 1.0)
    if len(position_times):
        wind_filter.expect_scale(float(position[-1, 2]) * 1e-3)
    t_air, t_att = air_times.tolist(), att_times.tolist()  # bisect on a short list is faster than on an array
    for t, ground in zip(times.tolist(), velocity.tolist(), strict=True):
        if t - last_t < _ROW_INTERVAL_S or t >= until:
            continue
        i, j = bisect_left(t_air, t), bisect_left(t_att, t)
        if i == len(t_air) or j == len(t_att):
            break  # not received yet
        if i and j and t - t_air[i - 1] < _STALE_S and t - t_att[j - 1] < _STALE_S:
            last_t = t
            Va = _between(air_times, air[:, 0], i, t)
            phi, theta = _between(att_times, attitude[:, 0], j, t), _between(att_times, attitude[:, 1], j, t)
            turned = wrap(attitude[j, 2] - attitude[j - 1, 2])
            psi = attitude[j - 1, 2] + (t - t_att[j - 1]) / (t_att[j] - t_att[j - 1]) * turned
            p = (attitude[j, 0] - attitude[j - 1, 0]) / (t_att[j] - t_att[j - 1])
            wind_filter.update(t, ground, Va, reported_direction(phi, theta, psi, ground[2], Va), float(p))
    return last_t


def _between(times: np.ndarray, values: np.ndarray, k: int, t: float) -> float:
    """Interpolate linearly between rows k - 1 and k."""
    return float(values[k - 1] + (t - times[k - 1]) / (times[k] - times[k - 1]) * (values[k] - values[k - 1]))
