"""Texts of the selected UAV: status, confidence, verdict, figures."""

from html import escape
from math import isfinite

from fleet.contract import Controller, Outcome, State
from viewer.store.received.datatime import stamp, times
from viewer.store.vehicle import Vehicle
from viewer.text import mismatch_text
from viewer.text.words import CLAIMS_S, ago, fit, horizon_s, standing
from viewer.theme.palette import Palette

LETTERS = 500  # characters of a received text
REFUSED_S = 10.0  # how long a rejected message is reported [s]


def about(vehicle: Vehicle, palette: Palette, now: float) -> str:
    """Return the status of the UAV and its twin as HTML. Received texts are escaped here."""
    one = standing(vehicle, palette, now)
    return (
        f'<div class="uav"><div class="head"><h1>{vehicle.name}</h1><b style="color:{one.colour}">'
        f"{one.glyph} {one.word}</b></div>{_cards(vehicle)}{_sentences(vehicle, palette, now)}</div>"
    )


def facts(vehicle: Vehicle, now: float) -> str:
    """Return fits, figures and controller as HTML."""
    return f'<div class="uav">{_fits(vehicle)}{_facts(vehicle, now)}{law(vehicle.controller)}</div>'


def _cards(vehicle: Vehicle) -> str:
    told, mean = vehicle.forecast, fit(vehicle)
    horizon = "–"
    if told is not None and told.until >= CLAIMS_S:
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
    """Return why there is no prediction, or what limits it; plain text, not escaped."""
    state, said = vehicle.state(now), []
    if vehicle.ended:
        said.append("The recording has ended; the page shows its last instant.")
    elif state is State.LINK_LOST:
        ghost = "the position shown is predicted by the twin" if vehicle.forecast is not None else "no twin yet"
        said.append(f"No sample for {ago(vehicle.age(now))}: {ghost}.")
    elif state in (State.WAITING, State.UNCLAIMED) and vehicle.model is None:
        said.append("No worker result for this UAV yet; check that `twin_worker` runs on this router.")
    elif state is State.UNCLAIMED:
        said.append(
            f"No worker result for this UAV for {ago(now - vehicle.believed)}; the page shows the last one; "
            "check that `twin_worker` runs on this router."
        )
    elif vehicle.forecast is None:
        said.append(f"No horizon yet after {ago(_known_s(vehicle, now))} of telemetry; it needs a verified model.")
    if late := vehicle.late(now):
        slower = "play the recording more slowly, or " if vehicle.recorded else ""
        behind = f": its worker is overloaded; {slower}assign fewer UAVs to each worker"
        said.append(f"The newest prediction is {ago(late)} old{'' if state is State.LINK_LOST else behind}.")
    if vehicle.prediction is not None and vehicle.prediction.sentence:
        said.append(vehicle.prediction.sentence)
    if vehicle.status is not None and vehicle.status.sentence:
        said.append(vehicle.status.sentence)
    if vehicle.mission is not None and vehicle.mission.sentence:
        said.append(vehicle.mission.sentence)
    if now - vehicle.refused[0] < REFUSED_S:
        said.append(vehicle.refused[1])
    return said


def _known_s(vehicle: Vehicle, now: float) -> float:
    """Return the data time since the start of its track [s]."""
    rows = vehicle.track.rows()
    return vehicle.clock(now) - float(rows[0, 0]) if len(rows) else 0.0


def clip(text: str) -> str:
    """Truncate received text to `MAX_TEXT` characters."""
    return text if len(text) <= LETTERS else text[: LETTERS - 1] + "…"


def _sentences(vehicle: Vehicle, palette: Palette, now: float) -> str:
    cards = [
        f'<div class="say" style="border-color:{palette.mismatch}">▲ {escape(clip(a.sentence))}</div>'
        for a in vehicle.alerts.values()
    ]
    cards.insert(0, mismatch_text.card(vehicle.mismatch, palette))
    said = why(vehicle, now)
    cards += [f'<div class="say">{escape(clip(text))}</div>' for text in said]
    verdict = vehicle.model.verdict if vehicle.model is not None else None
    if verdict is not None:
        colour = palette.verified if verdict.outcome is Outcome.VERIFIED else palette.identifying
        least = f", threshold {verdict.threshold:.0f} %" if verdict.threshold > 0 else ""
        cards.append(
            f'<div class="say" style="border-color:{colour}"><b>{escape(verdict.outcome.value.replace("_", " "))}</b> '
            f'<span class="soft">newest verification, number {verdict.tries}{least}</span><br>'
            f"{escape(clip(verdict.sentence))}</div>"
        )
    elif vehicle.row is not None and not any(vehicle.row.verdict in text for text in ("", *said)):
        cards.append(f'<div class="say">{escape(clip(vehicle.row.verdict))}</div>')
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
        f"<tr><td>model</td>{ours}</tr><tr class=soft><td>persistence</td>{hold}</tr></table>"
    )


def coverage(vehicle: Vehicle) -> str:
    """Describe the measured coverage of the prediction region."""
    told = vehicle.prediction
    if told is None or told.held_n <= 0 or not isfinite(told.held):
        return "not measured yet"
    return f"{told.quantile * 100:.0f} % region: coverage {told.held * 100:.0f} %, n = {told.held_n}"


HOW = {
    "received": "received from the autopilot",
    "identified": "identified in flight",
    "default": "assumed: autopilot default",
    "asked": "what-if value",
}
MOST = 40  # parameters shown per provenance


def law(controller: Controller | None) -> str:
    """Return the active control law and its parameters by provenance as HTML."""
    if controller is None:
        return ""
    parts = [(how, getattr(controller, how)) for how in HOW]
    rows = "".join(
        f'<tr><td class="soft key">{HOW[how]}</td><td class="value">'
        + escape(", ".join(f"{name[:20]} {value:g}" for name, value in list(given.items())[:MOST]))
        + "</td></tr>"
        for how, given in parts
        if given
    )
    head = f'<div class="soft">active law: <b class="law">{escape(controller.law[:100])}</b></div>'
    return f'{head}<table class="law">{rows}</table>'


def _facts(vehicle: Vehicle, now: float) -> str:
    told, status, row = vehicle.prediction, vehicle.status, vehicle.row
    at = vehicle.clock(now)
    figures = {
        "coverage": coverage(vehicle),
        "calibration": told.calibration or "–" if told is not None else "–",
        "method": f"{told.method} · {told.law or 'no law'}" if told is not None else "–",
        "mode": f"{status.mode or '–'} · {status.autopilot} · {'armed' if status.armed else 'disarmed'}"
        if status is not None
        else "–",
        "link": f"{status.received} received, {status.missed} missed, {status.rejected} rejected"
        if status is not None
        else "–",
        "recorded" if vehicle.recorded else "data time": stamp(at)
        + (
            f", played {times(vehicle.time.pace)}"
            if vehicle.recorded and vehicle.time.pace and not vehicle.ended
            else ""
        ),
        "sample": f"{ago(vehicle.age(now))} old" if isfinite(vehicle.age(now)) else "none yet",
        "prediction": f"{ago(max(at - vehicle.forecast.t, 0.0))} old, coasted {told.coast_s:.0f} s"
        if vehicle.forecast and told
        else "–",
        "within 10 %": f"{row.t10_s:.1f} s median, n = {row.t10_n}"
        if row is not None and row.t10_s is not None
        else "–",
        "worker": f"{row.worker} · epoch {row.epoch}" if row is not None else "–",
    }
    return (
        "<table>"
        + "".join(
            f'<tr><td class="soft key">{k}</td><td class="value">{escape(clip(v))}</td></tr>'
            for k, v in figures.items()
        )
        + "</table>"
    )
