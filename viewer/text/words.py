"""Texts of the page as HTML. Received texts are escaped here."""

from collections import Counter
from html import escape
from math import isfinite
from typing import NamedTuple

from fleet.contract import State
from viewer.store.received.datatime import moment, stamp, times
from viewer.store.store import Feed
from viewer.store.vehicle import Vehicle
from viewer.text.clicks import click
from viewer.text.mismatch_text import in_force, short
from viewer.theme.events import Kind
from viewer.theme.palette import GLYPH, MARK, WORD, Palette

SEVERITY = (State.LINK_LOST, State.UNCLAIMED, State.WAITING, State.IDENTIFYING, State.PREDICTING, State.VERIFIED)
MAX_ROWS = 50
CLAIMS_S = 0.5  # a shorter horizon counts as none [s]
BAR_S = 10.0  # smallest horizon of a full bar in the table [s]


class Standing(NamedTuple):
    """Status of a UAV as glyph, text and colour."""

    glyph: str
    word: str
    colour: str


def standing(vehicle: Vehicle, palette: Palette, now: float) -> Standing:
    """Return the status of a UAV: state of its twin, mismatch, alert or end of recording."""
    if vehicle.ended:
        return Standing(MARK[Kind.END], "recording ended", palette.event(Kind.END))
    state = vehicle.state(now)
    if state is not State.LINK_LOST and in_force(vehicle.mismatch):
        return Standing("▲", "mismatch", palette.mismatch)
    if state is not State.LINK_LOST and vehicle.alerts:
        return Standing("▲", next(iter(vehicle.alerts.values())).kind.value.replace("_", " "), palette.mismatch)
    return Standing(GLYPH[state], WORD[state], palette.state(state))


def severity(vehicle: Vehicle, now: float) -> tuple[bool, int, float, int]:
    """Return a sort key: alerts first, then worst state, then shortest horizon; ended recordings last."""
    rank = len(SEVERITY) if vehicle.ended else SEVERITY.index(vehicle.state(now))
    return (not (vehicle.alerts or in_force(vehicle.mismatch)), rank, horizon_s(vehicle), vehicle.uav)


def horizon_s(vehicle: Vehicle) -> float:
    """Return the current horizon [s]; 0 without a prediction."""
    return vehicle.forecast.until if vehicle.forecast is not None else 0.0


def fit(vehicle: Vehicle) -> float | None:
    """Return the mean fit over the states of the active model [%]; None before the first."""
    source = (
        (vehicle.model.in_force or vehicle.model.verdict).fit
        if vehicle.model is not None
        else vehicle.row.fit
        if vehicle.row is not None
        else {}
    )
    values = [value for value in source.values() if isfinite(value)]
    return sum(values) / len(values) if values else None


def empty(feed: Feed, now: float) -> str:
    """Return the page text without UAVs: subscribed key and what to check."""
    n, strange = sum(tuple(feed.counts.values())) - feed.counts["strange"], feed.counts["strange"]
    odd = f" {strange} malformed." if strange else ""
    said = "".join(f"<br>{escape(text)}" for text in feed.said())
    return (
        f'<div class="uav"><h1>No vehicles yet</h1><div class="soft">Listening on <code>{escape(feed.listening)}'
        f"</code> for {now - feed.since:.0f} s. {n} messages.{odd}{said}<br>Check that a gateway "
        "is running on this router and that aircraft send to it: <code>fleet status</code>, "
        "<code>fleet up --uavs 8</code>.</div></div>"
    )


def summary(fleet: list[Vehicle], feed: Feed, palette: Palette, now: float) -> str:
    """Count the fleet by state, with the median horizon and the measured coverage."""
    worst = sorted(fleet, key=lambda vehicle: severity(vehicle, now)[:2])
    chips = "".join(
        f'<span class="chip"><b style="color:{one.colour}">{one.glyph}</b><b>{n}</b>'
        f'<span class="soft">{one.word}</span></span>'
        for one, n in Counter(standing(vehicle, palette, now) for vehicle in worst).items()
    )
    horizons = sorted(h for vehicle in fleet if (h := horizon_s(vehicle)) >= CLAIMS_S)
    median = f" · median horizon {horizons[len(horizons) // 2]:.0f} s" if horizons else ""
    said = "".join(f'<div class="soft">{escape(text)}</div>' for text in feed.said())
    plural = "UAV" if len(fleet) == 1 else "UAVs"
    head = f"<h1>{len(fleet)} {plural}<small>{median}{_fleet_coverage(fleet)}</small></h1>"
    return f'<div class="uav">{head}{chips}{_recording(fleet, now)}{said}</div>'


def _recording(fleet: list[Vehicle], now: float) -> str:
    """Return the replay status: data time and rate of recordings."""
    played = [vehicle for vehicle in fleet if vehicle.recorded]
    if not played:
        return ""
    newest = max(played, key=lambda vehicle: (not vehicle.ended, vehicle.clock(now)))
    pace = "ended" if newest.ended else f"played {times(newest.time.pace)}" if newest.time.pace else "paused"
    return f'<div class="soft">Recording · <span class="now">{stamp(newest.clock(now))}</span> · {pace}</div>'


def _fleet_coverage(fleet: list[Vehicle]) -> str:
    n, held, quantile = held_so_far(fleet)
    return f" · cov. {held * 100:.0f}/{quantile * 100:.0f} %" if n else ""


def table(fleet: list[Vehicle], palette: Palette, now: float, *, total: int, pick: str, selected: int | None) -> str:
    """Return the table of up to 50 UAVs, most severe first; `pick` is the click handler with `{}` for the UAV."""
    worst = sorted(fleet, key=lambda vehicle: severity(vehicle, now))[:MAX_ROWS]
    longest = max((horizon_s(vehicle) for vehicle in worst), default=0.0)
    longest = max(longest, BAR_S)
    rows = "".join(_row(vehicle, palette, now, pick, on=vehicle.uav == selected, longest=longest) for vehicle in worst)
    return (
        '<div class="uav list"><table><tr><th></th><th>UAV</th><th>status</th><th class="num">fit %</th>'
        f'<th class="num">horizon</th></tr>{rows}</table>'
        f'<div class="foot">{len(worst)} of {total} · alerts and worst state first, then shortest horizon</div></div>'
    )


def _row(vehicle: Vehicle, palette: Palette, now: float, pick: str, *, on: bool, longest: float) -> str:
    one, horizon, mean = standing(vehicle, palette, now), horizon_s(vehicle), fit(vehicle)
    word = f"{one.word} {ago(vehicle.age(now))}" if one.word == WORD[State.LINK_LOST] else one.word
    bar = f'<i><i style="width:{min(horizon / longest, 1) * 100:.0f}%;background:{one.colour}"></i></i>'
    percent, seconds = "–" if mean is None else f"{mean:.0f}", f"{horizon:.0f} s" if horizon >= CLAIMS_S else "–"
    return (
        f'<tr class="pick{" on" if on else ""}" data-uav="{vehicle.uav}" title="{escape(_finding(vehicle))}" '
        f'onpointerdown="{pick.format(vehicle.uav)}">'
        f'<td style="color:{one.colour}">{one.glyph}</td><td>{vehicle.name}</td>'
        f'<td style="color:{one.colour}">{word}</td><td class="num">{percent}</td>'
        f'<td><div class="bar">{bar}<span class="num" style="width:30px">{seconds}</span>'
        "</div></td></tr>"
    )


def _finding(vehicle: Vehicle) -> str:
    """Return mismatch and alert texts of a UAV for the tooltip of its row; not escaped."""
    said = [short(vehicle.mismatch)] if vehicle.mismatch is not None and in_force(vehicle.mismatch) else []
    return "; ".join([*said, *(alert.sentence[:200] for alert in vehicle.alerts.values())])


def alerts(fleet: list[Vehicle], feed: Feed, palette: Palette, pick: str = "") -> str:
    """Return active mismatches and alerts, newest first, at most 50 each; `pick` is the click handler."""
    strange = [(v, v.mismatch) for v in fleet if v.mismatch is not None and in_force(v.mismatch)]
    told = [(v, "mismatch", one.t, short(one)) for v, one in sorted(strange, key=lambda one: -one[1].t)[:MAX_ROWS]]
    found = [(v, kind.value.replace("_", " "), a.t, a.sentence) for v, kind, a in feed.alerts()[:MAX_ROWS]]
    cards = "".join(
        f'<div class="say pick" style="border-color:{palette.mismatch}" '
        f'onpointerdown="{pick.format(click(vehicle.uav, t))}">'
        f'<b>▲ {vehicle.name}</b> <span class="soft">{escape(kind)}</span>'
        f'<span class="soft when">{moment(t)}</span><br>{escape(text[:300])}</div>'
        for vehicle, kind, t, text in [*told, *found]
    )
    return f'<div class="uav">{cards or "<div class=soft>No active alerts.</div>"}</div>'


def legend(fleet: list[Vehicle], palette: Palette) -> str:
    """Return the legend of the lines and the measured coverage of the band; it is always visible."""
    n, held, quantile = held_so_far(fleet)
    said = f"coverage {held * 100:.0f} %, n = {n}" if n else "not measured yet"
    parts = (
        f'<i class="line" style="background:{palette.flown}"></i>flown',
        f'<i class="line dash" style="color:{palette.ink}"></i>predicted',
        f'<i class="band" style="background:{palette.tube}"></i>{quantile * 100:.0f} % band: <b>{said}</b>',
        f'<i class="ring" style="border-color:{palette.horizon}"></i>horizon: error reaches 10 %',
        f'<i class="line dash" style="color:{palette.muted}"></i>beyond the horizon',
    )
    return f'<div class="legend">{"".join(f"<span>{part}</span>" for part in parts)}</div>'


def held_so_far(fleet: list[Vehicle]) -> tuple[int, float, float]:
    """Return the number of evaluated predictions, their coverage and the nominal coverage."""
    told = [v.prediction for v in fleet if v.prediction is not None]
    sure = [p for p in told if p.held_n > 0 and isfinite(p.held)]
    n = sum(p.held_n for p in sure)
    return n, sum(p.held * p.held_n for p in sure) / n if n else 0.0, told[0].quantile if told else 0.9


def ago(seconds: float) -> str:
    """Format an age."""
    if not isfinite(seconds):
        return "never received"
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
