"""Resample telemetry to a `Window`: one time grid, Lagrange interpolation of lost samples, long gaps marked.

Source: Huang 2021, section 3.2 (time-stamp calibration, eq. 18; Lagrange interpolation, eq. 19).
"""

from dataclasses import dataclass, field
from math import ceil, cos, floor, pi, sin

import numba as nb
import numpy as np

from fleet.airframes.airframe import ServoMap
from fleet.compiled_frames import wrap
from fleet.frames import Origin, to_ned
from fleet.window import INPUTS, LONGEST_GAP, STATES, Window, longest_gap
from twin_worker.telemetry.history import TelemetryHistory

DT = 0.04  # grid of every window [s]
_FINAL_AFTER_S = 1.5  # rows older than this no longer arrive [s]
_SPARSE_S = 0.2  # attitude with longer intervals is interpolated with its measured rates [s]
_CONTEXT_S = 4.0  # rows before a segment that its interpolation uses [s]
_MIN_ROWS = 4, 8  # minimum of every kind, to continue and to start
_MIN_WINDOW_ROWS = 50  # minimum grid times of a window
_MAX_CUBIC_GAPS = 8.0  # largest span of the four points of a cubic, in median gaps [-]
_LOST_GAP_RATIO = 1.6  # gap that indicates lost samples, in median gaps [-]
_INPUTS_AT, _TRIG_AT, _N_COLUMNS = 12, 16, 22  # first column of inputs, first of cosines and sines, number of columns
_SPARE_S = 20.0  # spare capacity on growth [s]


def lagrange(t: np.ndarray, y: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Interpolate with the cubic Lagrange polynomial through the four samples around each grid time.

    Args:
        t: sample times, rising, (m,) [s]
        y: samples, (m, k)
        grid: requested times within the samples, rising, (n,) [s]
    Returns:
        values on the grid, (n, k)
    """
    out, flags = np.empty((len(grid), y.shape[1])), np.empty((2, len(grid)), bool)
    rows = np.ascontiguousarray(y, float)
    _interpolate_each(t, rows, np.ascontiguousarray(grid), (0.0, np.inf, np.inf), 0, out, flags[0], flags[1])
    return out


def interpolate_samples(
    t: np.ndarray, y: np.ndarray, grid: np.ndarray, max_gap: float, max_cubic_gaps: float = _MAX_CUBIC_GAPS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Interpolate samples on the grid: cubic where dense, linear across a short gap, invalid across a long gap.

    Args:
        t, y, grid: as for `lagrange`
        max_gap: longer gaps are not filled, except across one lost row at low rates, see `longest_gap` [s]
        max_cubic_gaps: largest span of a cubic in median gaps; near a wide gap a cubic amplifies noise [-]
    Returns:
        values (n, k), measured or filled (n,) bool, filled across lost samples (n,) bool
    """
    out, ok, lost = np.zeros((len(grid), y.shape[1])), np.ones(len(grid), bool), np.zeros(len(grid), bool)
    _interpolate_into((out, ok, lost), 0, (t, y), grid, (max_gap, max_cubic_gaps))
    return out, ok, lost


def _interpolate_into(
    out: tuple[np.ndarray, np.ndarray, np.ndarray],
    at: int,
    samples: tuple[np.ndarray, np.ndarray],
    grid: np.ndarray,
    limits: tuple[float, float],
) -> float:
    """Write the result of `interpolate_samples` to some columns; return the median gap [s], nan with too few samples.

    Args:
        out: values, (n, m) from column `at` on; mask of valid rows, which it restricts; mask of filled rows, extended
        at: first column
        samples: times and values, (m,) [s] and (m, k)
        grid: requested times, rising, (n,) [s]
        limits: longest gap [s], largest span of a cubic in median gaps [-]
    """
    t, y = samples
    if len(t) < 4:
        out[1][:] = False
        return float("nan")
    median_gap = _median_gap(t, np.empty(len(t) - 1))
    spans = median_gap, longest_gap(limits[0], median_gap), limits[1] * median_gap
    _interpolate_each(t, np.ascontiguousarray(y, float), np.ascontiguousarray(grid), spans, at, *out)
    return float(median_gap)


@nb.njit(cache=True, nogil=True, _nrt=False)  # type: ignore[call-overload]
def _median_gap(t: np.ndarray, gaps: np.ndarray) -> float:
    """Return the median of the differences of rising times, (m,); `gaps`, (m - 1,), is overwritten.

    Source: Hoare 1961, algorithm 65 (find).
    """
    n = len(gaps)
    for k in range(n):
        gaps[k] = t[k + 1] - t[k]
    middle, low, high = n // 2, 0, n - 1
    while low < high:
        pivot, i, j = gaps[middle], low, high
        while i <= j:
            while gaps[i] < pivot:
                i += 1
            while pivot < gaps[j]:
                j -= 1
            if i <= j:
                gaps[i], gaps[j] = gaps[j], gaps[i]
                i, j = i + 1, j - 1
        if j < middle:
            low = i
        if middle < i:
            high = j
    below = gaps[middle]
    if n % 2 == 0:  # all before the middle are at most the middle
        below = gaps[0]
        for k in range(1, middle):
            below = max(below, gaps[k])
    return 0.5 * (below + gaps[middle])  # type: ignore[no-any-return]


@nb.njit(cache=True, nogil=True)  # no fastmath: a gap exactly as long as the limit is filled
def _interpolate_each(
    t: np.ndarray,
    y: np.ndarray,
    grid: np.ndarray,
    limits: tuple[float, float, float],
    at: int,
    out: np.ndarray,
    ok: np.ndarray,
    lost: np.ndarray,
) -> None:
    """Compute the result of `_interpolate_into`; limits: median gap, longest gap, longest span of a cubic [s].

    L(a) = sum_i b_i prod_(j != i) (a - a_j) / (a_i - a_j).  Source: Huang 2021 eq. 19.
    """
    (median_gap, max_gap, max_span), n, right = limits, len(t), 1
    weight = np.empty(4)
    for g in range(len(grid)):
        while right < n - 1 and t[right] < grid[g]:
            right += 1
        gap, t_clamped = t[right] - t[right - 1], min(max(grid[g], t[0]), t[n - 1])
        valid = t[0] - median_gap <= grid[g] <= t[n - 1] + median_gap and gap <= max_gap
        ok[g] = ok[g] and valid
        lost[g] = lost[g] or (valid and gap > _LOST_GAP_RATIO * median_gap)
        first, count = max(min(right - 2, n - 4), 0), 4
        if n < 4 or t[min(right + 1, n - 1)] - t[max(right - 2, 0)] > max_span:
            first, count = right - 1, 2
        for i in range(count):
            weight[i] = 1.0
            for j in range(count):
                if j != i:
                    weight[i] *= (t_clamped - t[first + j]) / (t[first + i] - t[first + j])
        for k in range(y.shape[1]):
            out[g, at + k] = 0.0
            for i in range(count):
                out[g, at + k] += weight[i] * y[first + i, k]


@dataclass(eq=False)
class Resampler:
    """Resample telemetry of one aircraft on multiples of `DT`; final rows are computed once, the tail every time."""

    keep_s: float = 160.0
    _origin: Origin | None = None
    _servos: ServoMap | None = None
    _first: int = 0  # range in use of the three arrays below
    _stop: int = 0
    _k: np.ndarray = field(default_factory=lambda: np.empty(0, np.int64))  # grid times in steps of DT
    # attitude, velocity, position, inputs, cosines and sines
    _values: np.ndarray = field(default_factory=lambda: np.empty((0, _N_COLUMNS)))
    _ok: np.ndarray = field(default_factory=lambda: np.empty((0, 2), bool))  # measured or filled; filled

    def clear(self) -> None:
        """Discard all rows, for example after a clock jump."""
        self._first, self._stop = 0, 0

    def window(
        self,
        history: TelemetryHistory,
        origin: Origin,
        servos: ServoMap,
        wind: np.ndarray,
        *,
        until: float,
        seconds: float,
    ) -> Window | None:
        """Resample new telemetry and return the newest `seconds` before `until`.

        Args:
            history: telemetry as received
            origin: origin of the twin's NED frame
            servos: map from pulse widths to inputs
            wind: wind, NED, the direction it blows to, (3,) [m/s]
            until: newest grid time [s since 1970]
            seconds: requested length [s]
        Returns:
            the window, or None while a required kind of row is missing
        """
        if self._origin != origin or self._servos is None or not servos.equals(self._servos):
            self.clear()
        self._origin, self._servos = origin, servos
        if not self._extend(history, until):
            return None
        used = slice(self._first, self._stop)
        k, values, flags = self._k[used], self._values[used], self._ok[used]
        first = k.searchsorted(ceil((until - seconds) / DT - 1e-3))
        stop = k.searchsorted(floor(until / DT + 1e-3), side="right")
        rows = slice(first, stop)
        if stop - first < _MIN_WINDOW_ROWS:
            return None
        x, u, p, v = (np.empty((stop - first, width)) for width in (len(STATES), len(INPUTS), 3, 3))
        _fill_window(values[rows], np.asarray(wind, float), x, u, p, v)
        ok, filled = flags[rows].T.copy()
        return Window(k[rows] * DT, x, u, p, v, ok, filled)

    def _extend(self, history: TelemetryHistory, until: float) -> bool:
        """Resample the tail that may still receive rows; return whether every kind is available."""
        started = self._stop > self._first
        final_t = self._k[self._stop - 1] * DT - _FINAL_AFTER_S if started else max(until - self.keep_s, 0.0)
        rows = {name: history.rows_since(name, final_t - _CONTEXT_S) for name in LONGEST_GAP}
        if any(len(t) < _MIN_ROWS[not started] for t, _ in rows.values()):
            return started
        start = final_t if started else max(final_t, *(float(t[0]) for t, _ in rows.values()))
        stop = min(until, *(float(t[-1]) for t, _ in rows.values()))
        k = np.arange(ceil(start / DT), floor(stop / DT) + 1)
        if not len(k):
            return started
        assert self._origin is not None
        values, ok, filled = _resample_rows(rows, k * DT, self._origin)
        self._append(k, values, ok, filled)
        return True

    def _append(self, k: np.ndarray, values: np.ndarray, ok: np.ndarray, filled: np.ndarray) -> None:
        """Replace all rows from `k[0]` on with these rows, (n,), (n, 20), (n,), (n,)."""
        bounds = [k[0] - int(self.keep_s / DT), k[0]]
        first, stop = (self._first + int(row) for row in self._k[self._first : self._stop].searchsorted(bounds))
        if self._stop > self._first:  # angles continue without a jump of 2 pi
            previous = self._values[stop - 1, :3] if stop > first else np.zeros(3)
            values[:, :3] += 2 * np.pi * np.round((previous - values[0, :3]) / (2 * np.pi))
        if stop + len(k) > len(self._k):
            self._grow(first, stop, len(k))
            first, stop = 0, stop - first
        new = slice(stop, stop + len(k))
        assert self._servos is not None
        self._k[new], self._values[new, :_INPUTS_AT] = k, values[:, :_INPUTS_AT]
        self._ok[new, 0], self._ok[new, 1] = ok, filled
        self._values[new, _INPUTS_AT:_TRIG_AT] = self._servos.inputs(values[:, _INPUTS_AT:])
        _fill_trig(self._values[new])
        self._first, self._stop = first, new.stop

    def _grow(self, first: int, stop: int, n_new: int) -> None:
        """Move rows `first` to `stop` to larger arrays with space for `n_new` rows and a reserve."""
        size = stop - first + n_new + int(_SPARE_S / DT)
        for name in ("_k", "_values", "_ok"):
            old = getattr(self, name)
            new = np.empty((size, *old.shape[1:]), old.dtype)
            new[: stop - first] = old[first:stop]
            setattr(self, name, new)


@nb.njit(cache=True, nogil=True)  # no fastmath: as `fleet.frames.ned_to_body` has it
def _fill_trig(values: np.ndarray) -> None:
    """Compute cosines and sines of the angles of every row, which every new wind reuses."""
    for k in range(len(values)):
        for i in range(3):
            values[k, _TRIG_AT + 2 * i], values[k, _TRIG_AT + 2 * i + 1] = cos(values[k, i]), sin(values[k, i])


@nb.njit(cache=True, nogil=True)  # no fastmath: as `fleet.frames.ned_to_body` has it
def _fill_window(
    values: np.ndarray, wind: np.ndarray, x: np.ndarray, u: np.ndarray, p: np.ndarray, v: np.ndarray
) -> None:
    """Compute states, (n, 9), inputs, (n, 4), positions and velocities, (n, 3), from rows of `Resampler`."""
    for k in range(len(values)):
        row = values[k]
        cf, sf, ct, st, cp, sp = row[16], row[17], row[18], row[19], row[20], row[21]
        for i in range(4):
            u[k, i] = row[_INPUTS_AT + i]
        for i in range(3):
            v[k, i], p[k, i] = row[6 + i], row[9 + i]
            x[k, 6 + i], x[k, 3 + i] = row[i], row[3 + i]
        n, e, d = row[6] - wind[0], row[7] - wind[1], row[8] - wind[2]
        ahead, right = cp * n + sp * e, cp * e - sp * n
        x[k, 0] = ct * ahead - st * d
        x[k, 1] = sf * st * ahead + cf * right + sf * ct * d
        x[k, 2] = cf * st * ahead - sf * right + cf * ct * d


def _resample_rows(
    rows: dict[str, tuple[np.ndarray, np.ndarray]], grid: np.ndarray, origin: Origin
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Interpolate every kind on the grid; return columns of `Resampler`, mask of valid rows, mask of filled rows."""
    t, attitude = rows["attitude"]
    unwrapped = np.empty(attitude.shape)
    _unwrap_angles(attitude, unwrapped)
    t_p, position = rows["position"]
    values = np.zeros((len(grid), _INPUTS_AT + rows["servo"][1].shape[1]))
    ok, filled = np.ones(len(grid), bool), np.zeros(len(grid), bool)
    for name, at, samples in (
        ("attitude", 0, (t, unwrapped)),
        ("velocity", 6, rows["velocity"]),
        ("position", 9, (t_p, to_ned(origin, *position.T))),
        ("servo", _INPUTS_AT, rows["servo"]),
    ):
        cubic_gaps = 0.0 if name == "servo" else _MAX_CUBIC_GAPS  # a cubic would overshoot, a servo does not
        median_gap = _interpolate_into((values, ok, filled), at, samples, grid, (LONGEST_GAP[name], cubic_gaps))
        if name == "attitude" and median_gap > _SPARSE_S and unwrapped[:, 3:].any():
            values[:, :6] = _sparse_attitude(t, unwrapped, grid)
    return values, ok, filled


@nb.njit(cache=True, nogil=True, _nrt=False)  # type: ignore[call-overload]  # no fastmath: as `numpy.unwrap`
def _unwrap_angles(x: np.ndarray, out: np.ndarray) -> None:
    """Copy rows, (m, 6), with their first three columns unwrapped."""
    for j in range(x.shape[1]):
        correction = 0.0
        for k in range(len(x)):
            if k > 0 and j < 3:
                step = x[k, j] - x[k - 1, j]
                if not abs(step) < pi:  # a nan spreads to all later rows
                    correction += wrap(step) - step
            out[k, j] = x[k, j] + correction


def _sparse_attitude(t: np.ndarray, attitude: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Interpolate angles with the cubic Hermite polynomial of measured angles and rates; rates are its derivative.

    phi_dot = p + tan(theta) (q sin(phi) + r cos(phi)); theta_dot, psi_dot likewise, and their inverse.
    Source: Beard & McLain 2012, eq. 3.3.

    Args:
        t: sample times, rising, (m,) [s]
        attitude: unwrapped phi theta psi p q r, (m, 6) [rad, rad/s]
        grid: requested times, rising, (n,) [s]
    Returns:
        phi theta psi p q r on the grid, (n, 6)
    """
    phi, theta, _, p, q, r = attitude.T
    yawing = q * np.sin(phi) + r * np.cos(phi)
    slope = np.column_stack([p + np.tan(theta) * yawing, q * np.cos(phi) - r * np.sin(phi), yawing / np.cos(theta)])
    k = np.clip(np.searchsorted(t, grid, side="right") - 1, 0, len(t) - 2)
    h = (t[k + 1] - t[k])[:, None]
    s = np.clip((grid - t[k])[:, None] / h, 0.0, 1.0)
    first, last, change = h * slope[k], h * slope[k + 1], attitude[k + 1, :3] - attitude[k, :3]
    c_2, c_3 = 3 * change - 2 * first - last, first + last - 2 * change
    angles = attitude[k, :3] + s * (first + s * (c_2 + s * c_3))
    phi_dot, theta_dot, psi_dot = ((first + s * (2 * c_2 + s * 3 * c_3)) / h).T
    phi, theta, _ = angles.T
    p = phi_dot - psi_dot * np.sin(theta)
    q = theta_dot * np.cos(phi) + psi_dot * np.sin(phi) * np.cos(theta)
    r = -theta_dot * np.sin(phi) + psi_dot * np.cos(phi) * np.cos(theta)
    return np.column_stack([angles, p, q, r])


def preprocess(
    history: TelemetryHistory, origin: Origin, servos: ServoMap, wind: np.ndarray, *, until: float, seconds: float
) -> Window | None:
    """Resample the newest `seconds` before `until` on one grid; arguments as for `Resampler.window`."""
    return Resampler(seconds).window(history, origin, servos, wind, until=until, seconds=seconds)
