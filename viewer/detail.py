"""What the page says about the selected UAV: status, trust, verdict, and a few charts."""

from html import escape
from math import isfinite
from typing import Any

import numpy as np
from viser import uplot

from fleet.contract import Outcome, State
from viewer.feed import Feed
from viewer.palette import GLYPH, WORD, Palette
from viewer.place import UNIT_M
from viewer.vehicle import Vehicle
from viewer.words import ago, fit, horizon_s

PAST_S = 60.0  # how far the histories reach back [s]
REFUSED_S = 10.0  # how long a refused message is spoken of [s]


def about(vehicle: Vehicle, palette: Palette, now: float) -> str:
    """Say how the UAV and its twin stand. Strings of the bus are escaped here."""
    state = vehicle.state(now)
    return (
        f'<div class="uav"><div class="head"><h1>{vehicle.name}</h1><b style="color:{palette.state(state)}">'
        f"{GLYPH[state]} {WORD[state]}</b></div>{_cards(vehicle)}{_sentences(vehicle, palette, now)}"
        f"{_fits(vehicle)}{_facts(vehicle, now)}</div>"
    )


def _cards(vehicle: Vehicle) -> str:
    told, mean = vehicle.forecast, fit(vehicle)
    horizon = "–"
    if told is not None:
        horizon = f"{'≥ ' if told.message.horizon_open else ''}{horizon_s(vehicle):.0f} s"
    cards = {
        "fit": "–" if mean is None else f"{mean:.0f} %",
        "horizon": horizon,
        "airspeed": f"{vehicle.Va:.1f} m/s" if isfinite(vehicle.Va) else "–",
    }
    return (
        '<div class="cards">'
        + "".join(f'<div class="card"><span class="soft">{k}</span><b>{v}</b></div>' for k, v in cards.items())
        + "</div>"
    )


def why(vehicle: Vehicle, now: float) -> list[str]:
    """Say why there is no prediction, or what limits it; plain text, not yet escaped."""
    state, said = vehicle.state(now), []
    if state is State.LINK_LOST:
        ghost = (
            "the twin flies on alone; what moves is its prediction" if vehicle.forecast is not None else "no twin yet"
        )
        said.append(f"No sample for {ago(vehicle.age(now))}: {ghost}.")
    elif state in (State.WAITING, State.UNCLAIMED) and vehicle.model is None:
        said.append("No worker has judged this UAV yet; check that `twin_worker` runs on this router.")
    elif state is State.UNCLAIMED:
        said.append(
            f"No worker has spoken of this UAV for {ago(now - vehicle.believed)}: what is shown is its last word; "
            "check that `twin_worker` runs on this router."
        )
    elif vehicle.forecast is None:
        said.append("No horizon yet: nothing is claimed before a model is verified.")
    if vehicle.prediction is not None and vehicle.prediction.sentence:
        said.append(vehicle.prediction.sentence)
    if vehicle.status is not None and vehicle.status.sentence:
        said.append(vehicle.status.sentence)
    if vehicle.mission is not None and vehicle.mission.sentence:
        said.append(vehicle.mission.sentence)
    if now - vehicle.refused[0] < REFUSED_S:
        said.append(vehicle.refused[1])
    return said


def _sentences(vehicle: Vehicle, palette: Palette, now: float) -> str:
    cards = [
        f'<div class="say" style="border-color:{palette.mismatch}">▲ {escape(a.sentence)}</div>'
        for a in vehicle.alerts.values()
    ]
    cards += [f'<div class="say">{escape(text)}</div>' for text in why(vehicle, now)]
    verdict = vehicle.model.verdict if vehicle.model is not None else None
    if verdict is not None:
        colour = palette.verified if verdict.outcome is Outcome.VERIFIED else palette.identifying
        cards.append(
            f'<div class="say" style="border-color:{colour}"><b>{escape(verdict.outcome.value.replace("_", " "))}</b> '
            f'<span class="soft">newest try, number {verdict.tries}, threshold {verdict.threshold:.0f} %</span><br>'
            f"{escape(verdict.sentence)}</div>"
        )
    elif vehicle.row is not None and vehicle.row.verdict:
        cards.append(f'<div class="say">{escape(vehicle.row.verdict)}</div>')
    return "".join(cards)


def _fits(vehicle: Vehicle) -> str:
    if vehicle.model is None or not (vehicle.model.in_force or vehicle.model.verdict).fit:
        return ""
    verdict = vehicle.model.in_force or vehicle.model.verdict
    names = list(verdict.fit)[:12]
    head = "".join(f'<th class="num">{escape(name)}</th>' for name in names)
    ours = "".join(f'<td class="num">{verdict.fit[name]:.0f}</td>' for name in names)
    hold = "".join(
        f'<td class="num soft">{verdict.fit_hold[name]:.0f}</td>' if name in verdict.fit_hold else "<td></td>"
        for name in names
    )
    return (
        f'<div class="soft">fit per state over {verdict.horizon_s:.1f} s, %</div><table><tr><th></th>{head}</tr>'
        f"<tr><td>model</td>{ours}</tr><tr class=soft><td>hold</td>{hold}</tr></table>"
    )


def coverage(vehicle: Vehicle) -> str:
    """Say how often the tube held so far."""
    told = vehicle.prediction
    if told is None or told.held_n <= 0 or not isfinite(told.held):
        return "not measured yet"
    return f"{told.quantile * 100:.0f} % tube held {told.held * 100:.0f} %, n = {told.held_n}"


def _facts(vehicle: Vehicle, now: float) -> str:
    told, status, row = vehicle.prediction, vehicle.status, vehicle.row
    facts = {
        "coverage": coverage(vehicle),
        "method": f"{told.method} · {told.law or 'no law'}" if told is not None else "–",
        "mode": f"{status.mode or '–'} · {status.autopilot} · {'armed' if status.armed else 'disarmed'}"
        if status is not None
        else "–",
        "link": f"{status.received} received, {status.missed} missed, {status.rejected} refused"
        if status is not None
        else "–",
        "sample": f"{ago(vehicle.age(now))} old",
        "prediction": f"{ago(now - vehicle.forecast.heard)} old, coasted {told.coast_s:.0f} s"
        if vehicle.forecast and told
        else "–",
        "within 10 %": f"{row.t10_s:.1f} s median, n = {row.t10_n}"
        if row is not None and row.t10_s is not None
        else "–",
        "worker": f"{row.worker} · epoch {row.epoch}" if row is not None else "–",
    }
    return (
        "<table>"
        + "".join(f'<tr><td class="soft">{k}</td><td class="num">{escape(v)}</td></tr>' for k, v in facts.items())
        + "</table>"
    )


class Charts:
    """Four charts of the selected UAV; built once, their data replaced."""

    def __init__(self, gui: Any, palette: Palette) -> None:
        self._gui, p = gui, palette
        two = np.array([0.0, 1.0])
        self._tube = self._chart(
            "Band, m",
            (("along", p.predicting), ("cross", p.verified), ("vertical", p.identifying), ("horizon", p.horizon)),
            (two,) * 5,
        )
        self._fit = self._chart("Mean fit of each verdict, %", (("fit", p.verified),), (two, two))
        self._alt = self._chart("Altitude, m", (("flown", p.flown), ("predicted", p.predicting)), (two,) * 3)
        self._va = self._chart("Airspeed, m/s", (("Va", p.flown),), (two,) * 2)

    def _chart(self, title: str, lines: tuple, data: tuple) -> tuple[Any, Any]:
        legend = " ".join(f'<span style="color:{colour};white-space:nowrap">━ {name}</span>' for name, colour in lines)
        head = self._gui.add_html(f'<div class="uav" style="padding-bottom:0"><b>{title}</b> {legend}</div>')
        series = tuple(
            uplot.Series(label=name, stroke=colour, width=2, points={"show": False}) for name, colour in lines
        )
        plot = self._gui.add_uplot(
            data,
            (uplot.Series(label="s"), *series),
            scales={"x": {"time": False}},
            axes=({}, {"size": 44}),
            legend={"show": False},
            padding=(10, 16, 0, 0),
            height=126,
        )
        return head, plot

    def draw(self, vehicle: Vehicle | None, feed: Feed, now: float) -> None:
        """Replace the data; a chart without any is hidden."""
        trail = feed.trail(vehicle) if vehicle is not None else np.zeros((0, 5))
        _put(self._tube, band(vehicle))
        _put(self._fit, _history(feed.fits(vehicle), 1) if vehicle is not None else None)
        _put(self._va, _history(trail[np.isfinite(trail[:, 4])], 4))
        _put(self._alt, _altitude(vehicle, trail, now))


def _put(chart: tuple[Any, Any], data: tuple[np.ndarray, ...] | None) -> None:
    """Show data, x first. The y scale is given: a gap (not a number) would spoil the chart's own."""
    for part in chart:
        part.visible = data is not None
    if data is None:
        return
    x0, x1 = np.floor(data[0][0] / 10) * 10, np.ceil(data[0][-1] / 10) * 10
    scales = {"x": {"time": False, "range": (float(x0), float(x1))}, "y": {"range": scale(np.concatenate(data[1:]))}}
    if chart[1].scales != scales:  # a new scale builds the chart anew: rarely, please
        chart[1].scales = scales
    chart[1].data = data


def scale(y: np.ndarray) -> tuple[float, float]:
    """Choose a range for y that holds its finite values and seldom changes: whole multiples of 1, 2 or 5 times 10^k."""
    y = y[np.isfinite(y)]
    low, high = (float(y.min()), float(y.max())) if len(y) else (0.0, 1.0)
    rough = max(high - low, 0.02 * abs(high), 1e-3) / 2
    power = 10.0 ** np.floor(np.log10(rough))
    step = float(power * next(m for m in (1, 2, 5, 10) if m * power >= rough * 0.999))
    return float(np.floor(low / step) * step), float((np.floor(high / step) + 1) * step)


def band(vehicle: Vehicle | None) -> tuple[np.ndarray, ...] | None:
    """Give half-axes against look-ahead, and an upright line at the horizon: x, along, cross, vertical, horizon."""
    if vehicle is None or (told := vehicle.forecast) is None:
        return None
    x = np.sort(np.concatenate([np.linspace(0, told.ahead[-1], 60), [told.until, told.until + 1e-3]]))
    axes = told.width(x) * UNIT_M
    at = np.searchsorted(x, [told.until, told.until + 1e-3])
    upright = np.full(len(x), np.nan)
    upright[at] = [0.0, axes[:, :2].max()]
    return x, axes[:, 0], axes[:, 1], axes[:, 2], upright


def _history(rows: np.ndarray, column: int) -> tuple[np.ndarray, ...] | None:
    """Give the last minute of one column against seconds ago: (x, y); None where there are fewer than two points."""
    if len(rows) < 2:
        return None
    x = rows[:, 0] - rows[-1, 0]
    keep = (x >= -PAST_S) & np.concatenate([np.diff(x) > 0, [True]])
    return (x[keep], rows[keep, column]) if keep.sum() > 1 else None


def _altitude(vehicle: Vehicle | None, trail: np.ndarray, now: float) -> tuple[np.ndarray, ...] | None:
    """Join flown and predicted altitude: (x, flown, predicted) [s from now, m above mean sea level]."""
    flown = _history(trail, 3)
    if vehicle is None or flown is None:
        return None
    base = vehicle.alt_m - trail[-1, 3] * UNIT_M
    x, up = flown[0], flown[1] * UNIT_M + base
    if vehicle.forecast is None:
        return x, up, np.full(len(x), np.nan)
    told = vehicle.forecast
    ahead = np.linspace(0.1, max(told.until, 0.2), 40)
    predicted = told.at(ahead + max(float(trail[-1, 0]) - told.t, 0.0))[:, 2] * UNIT_M + base
    blank = np.full(len(ahead), np.nan), np.full(len(x), np.nan)
    return np.concatenate([x, ahead]), np.concatenate([up, blank[0]]), np.concatenate([blank[1], predicted])
