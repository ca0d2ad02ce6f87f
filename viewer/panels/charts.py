"""Charts of the selected UAV: errors, fit and altitude of the last minute, the prediction, the profile ahead."""

from typing import Any

import numpy as np
from viser import uplot

from viewer.store.forecast import LOOK_AHEADS_S, prediction_errors, rms_by_look_ahead
from viewer.store.place import UNIT_M
from viewer.store.profile import AltitudeProfile
from viewer.store.store import FleetStore
from viewer.store.vehicle import Vehicle
from viewer.text.units import METRIC, Units
from viewer.text.words import is_located
from viewer.theme.palette import Palette

ERROR_AHEAD_S = 5.0  # look-ahead whose error is shown over time [s]
PAST_S = 60.0  # length of the histories [s]


class Charts:
    """Five charts of the selected UAV; created once, then updated."""

    def __init__(self, gui: Any, palette: Palette) -> None:
        self._gui, p = gui, palette
        placeholder = np.array([0.0, 1.0])
        self._band = self._chart(
            "Error by look-ahead, m",
            (("measured", p.actual), ("band", p.tube), ("horizon", p.horizon)),
            (placeholder,) * 4,
        )
        self._error = self._chart(
            f"Error {ERROR_AHEAD_S:.0f} s ahead, m",
            (("measured", p.muted), ("located mismatch", p.mismatch)),
            (placeholder,) * 3,
        )
        self._fit = self._chart("Mean fit per verdict, %", (("fit", p.verified),), (placeholder, placeholder))
        self._alt_lines, self._units = (("flown", p.actual), ("predicted", p.predicting)), METRIC
        self._alt = self._chart("Altitude, m", self._alt_lines, (placeholder,) * 3)
        self._profile_lines = (
            *(("ground", p.verified), ("route", p.route)),
            *(("low", p.tube), ("predicted", p.predicting), ("high", p.tube)),
        )
        self._profile = self._chart("Altitude along the route", self._profile_lines, (placeholder,) * 6, _BAND)

    def _chart(self, title: str, lines: tuple, data: tuple, more: dict[str, Any] | None = None) -> tuple[Any, Any]:
        head = self._gui.add_html(_heading(title, lines))
        series = tuple(
            uplot.Series(
                label=name,
                stroke=colour,
                width=2,
                points={"show": False},
                **({"dash": (6, 4)} if name == "route" else {"fill": f"{colour}30"} if name == "ground" else {}),
            )
            for name, colour in lines
        )
        plot = self._gui.add_uplot(
            data,
            (uplot.Series(label="s"), *series),
            scales={"x": {"time": False}},
            axes=({"size": 32}, {"size": 54}),
            legend={"show": False},
            padding=(10, 16, 0, 0),
            height=108,
            **(more or {}),
        )
        return head, plot

    def draw_profile(self, profile: AltitudeProfile | None, units: Units = METRIC) -> None:
        """Update the altitude profile; hide it without one."""
        if profile is None:
            return _show(self._profile, None)
        if self._profile[0].content != (heading := profile_heading(profile, self._profile_lines, units)):
            self._profile[0].content = heading
        altitudes = (x * units.per_m for x in profile[1:6])
        _show(self._profile, (profile.distance_m * units.per_m_far, *altitudes), step=0.5)

    def draw(self, vehicle: Vehicle | None, store: FleetStore, now: float, units: Units = METRIC) -> None:
        """Update the data; hide a chart without data."""
        if units != self._units:
            self._units, self._alt[0].content = units, _heading(f"Altitude, {units.height}", self._alt_lines)
        if vehicle is None:
            for chart in (self._band, self._error, self._fit, self._alt, self._profile):
                _show(chart, None)
            return
        trail = store.trail(vehicle)
        issued, distances = prediction_errors(store.past(vehicle), trail)
        _show(self._band, band(vehicle, distances, now), from_zero=True)
        _show(self._error, over_time(issued, distances, vehicle), from_zero=True)
        _show(self._fit, _history(store.fits(vehicle), 1))
        altitude = _altitude(vehicle, trail, now)
        _show(self._alt, altitude and (altitude[0], *(metres * units.per_m for metres in altitude[1:])))


_BAND: dict[str, Any] = {"bands": (uplot.Band(series=(5, 3), fill="rgba(86, 180, 233, 0.25)"),)}  # high to low


def profile_heading(profile: AltitudeProfile, lines: tuple, units: Units) -> str:
    """Return the heading of the altitude profile as HTML, with the least clearance of the prediction region."""
    ground = "ground" if profile.is_terrain else "level of home (no terrain file)"
    legend = tuple((ground if name == "ground" else name, c) for name, c in lines if name not in ("low", "high"))
    title = f"Altitude along the route, {units.height} over {units.distance}"
    least = profile.clearance_m
    if least is None:
        return _heading(title, legend)
    text = f"Prediction region at least {units.height_text(least[0])} above it, {units.distance_text(least[1])} ahead."
    return _heading(title, legend) + f'<div class="uav soft" style="padding-block:0">{text}</div>'


def _heading(title: str, lines: tuple) -> str:
    legend = " ".join(
        f'<span class="soft" style="white-space:nowrap"><span style="color:{colour}">━</span> {name}</span>'
        for name, colour in lines
    )
    return f'<div class="uav" style="padding-bottom:0"><b>{title}</b> {legend}</div>'


def _show(
    chart: tuple[Any, Any], data: tuple[np.ndarray, ...] | None, *, from_zero: bool = False, step: float = 10.0
) -> None:
    """Show data, x first, in multiples of `step`. The y range is explicit: NaN gaps break automatic scaling."""
    for part in chart:
        part.visible = data is not None
    if data is None:
        return
    zero = [np.zeros(1)] if from_zero else []
    x0, x1 = np.floor(data[0][0] / step) * step, np.ceil(data[0][-1] / step) * step
    scales = {
        "x": {"time": False, "range": (float(x0), float(x1))},
        "y": {"range": axis_range(np.concatenate([*data[1:], *zero]))},
    }
    if chart[1].scales != scales:  # a new scale recreates the chart
        chart[1].scales = scales
    chart[1].data = data


def axis_range(y: np.ndarray) -> tuple[float, float]:
    """Return a y range over the finite values in multiples of 1, 2 or 5 times 10^k, so that it rarely changes."""
    y = y[np.isfinite(y)]
    low, high = (float(y.min()), float(y.max())) if len(y) else (0.0, 1.0)
    rough_step = max(high - low, 0.02 * abs(high), 1e-3) / 2
    power = 10.0 ** np.floor(np.log10(rough_step))
    step = float(power * next(m for m in (1, 2, 5, 10) if m * power >= rough_step * 0.999))
    return float(np.floor(low / step) * step), float((np.floor(high / step) + 1) * step)


def band(vehicle: Vehicle | None, distances: np.ndarray, now: float) -> tuple[np.ndarray, ...] | None:
    """Return measured error and largest half-axis of the band against look-ahead, and a vertical horizon line.

    `distances` is (k, 30) from `prediction_errors`; `now` monotonic [s]. Returns x [s], measured, band, horizon [m].
    Without a horizon its line is NaN.
    """
    if vehicle is None or (forecast := vehicle.forecast) is None:
        return None
    horizon_s = vehicle.record(now).horizon_s
    last = min(float(forecast.ahead[-1]), max(1.4 * horizon_s, 10.0))
    horizon = [horizon_s, horizon_s + 1e-3]
    x = np.unique(np.concatenate([LOOK_AHEADS_S[last >= LOOK_AHEADS_S], np.linspace(0, last, 40), horizon]))
    half_axis = forecast.half_axes_at(x).max(axis=1) * UNIT_M
    measured = rms_by_look_ahead(distances)
    valid = np.isfinite(measured)
    line = np.full(len(x), np.nan)
    if valid.any():
        ends = LOOK_AHEADS_S[valid][[0, -1]]
        inside = (x >= ends[0]) & (x <= ends[1])
        line[inside] = np.interp(x[inside], LOOK_AHEADS_S[valid], measured[valid])
    horizon_line = np.full(len(x), np.nan)
    if horizon_s:
        horizon_line[np.searchsorted(x, horizon)] = [0.0, half_axis.max()]
    return x, line, half_axis, horizon_line


def over_time(issued: np.ndarray, distances: np.ndarray, vehicle: Vehicle) -> tuple[np.ndarray, ...] | None:
    """Return the error at one look-ahead over time, and separately where a mismatch was located."""
    at = int(ERROR_AHEAD_S - LOOK_AHEADS_S[0])
    valid = np.isfinite(distances[:, at])
    if valid.sum() < 2:
        return None
    due, error = issued[valid] + ERROR_AHEAD_S, distances[valid, at]
    mismatched = np.where(is_located(due, vehicle.mismatch), error, np.nan)
    return due - due[-1], error, mismatched


def _history(rows: np.ndarray, column: int) -> tuple[np.ndarray, ...] | None:
    """Return the last minute of one column over time: (x, y); None for fewer than two points."""
    if len(rows) < 2:
        return None
    x = rows[:, 0] - rows[-1, 0]
    recent = (x >= -PAST_S) & np.concatenate([np.diff(x) > 0, [True]])
    return (x[recent], rows[recent, column]) if recent.sum() > 1 else None


def _altitude(vehicle: Vehicle | None, trail: np.ndarray, now: float) -> tuple[np.ndarray, ...] | None:
    """Return flown and predicted altitude: (x, flown, predicted) [s from now, m above mean sea level]."""
    history = _history(trail, 3)
    if vehicle is None or history is None:
        return None
    base = vehicle.alt_m - trail[-1, 3] * UNIT_M
    x, up = history[0], history[1] * UNIT_M + base
    if vehicle.forecast is None:
        return x, up, np.full(len(x), np.nan)
    forecast = vehicle.forecast
    start = max(float(trail[-1, 0]) - forecast.t, 0.0)
    ahead = np.linspace(0.1, max(vehicle.record(now).horizon_s - start, 0.2), 40)
    predicted = forecast.position_at(ahead + start)[:, 2] * UNIT_M + base
    blank = np.full(len(ahead), np.nan), np.full(len(x), np.nan)
    return np.concatenate([x, ahead]), np.concatenate([up, blank[0]]), np.concatenate([blank[1], predicted])
