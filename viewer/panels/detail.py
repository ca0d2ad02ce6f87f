"""Texts of the selected UAV: status, confidence, verdict, figures."""

from html import escape
from math import isfinite

from fleet.contract import Controller, Outcome, TwinState
from viewer.store.inbox import rate_text, timestamp
from viewer.store.vehicle import Vehicle
from viewer.text import words as mismatch_text
from viewer.text.words import MIN_HORIZON_S, age_text, fit, horizon_s, status_label
from viewer.theme.events import clip
from viewer.theme.palette import Palette

MAX_TEXT = 500  # characters of a received text
REFUSED_S = 10.0  # how long a rejected message is reported [s]


def status_html(vehicle: Vehicle, palette: Palette, now: float) -> str:
    """Return the status of the UAV and its twin as HTML. Received texts are escaped here."""
    label = status_label(vehicle, palette, now)
    return (
        f'<div class="uav"><div class="head"><h1>{vehicle.name}</h1><b style="color:{label.colour}">'
        f"{label.glyph} {label.text}</b></div>{_cards(vehicle)}{_sentences(vehicle, palette, now)}</div>"
    )


def figures_html(vehicle: Vehicle, now: float) -> str:
    """Return fits, figures and controller as HTML."""
    return f'<div class="uav">{_fits(vehicle)}{_facts(vehicle, now)}{law_html(vehicle.controller)}</div>'


def _cards(vehicle: Vehicle) -> str:
    forecast, mean = vehicle.forecast, fit(vehicle)
    horizon = "–"
    if forecast is not None and forecast.horizon_s >= MIN_HORIZON_S:
        horizon = f"{'≥ ' if forecast.message.horizon_open else ''}{horizon_s(vehicle):.0f} s"
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


def limitations(vehicle: Vehicle, now: float) -> list[str]:
    """Return why there is no prediction, or what limits it; plain text, not escaped."""
    state, texts = vehicle.state(now), []
    if vehicle.ended:
        texts.append("The recording has ended; the page shows its last instant.")
    elif state is TwinState.LINK_LOST:
        note = "the position shown is predicted by the twin" if vehicle.forecast is not None else "no twin yet"
        texts.append(f"No sample for {age_text(vehicle.sample_age_s(now))}: {note}.")
    elif state in (TwinState.WAITING, TwinState.UNCLAIMED) and vehicle.model is None:
        texts.append("No worker result for this UAV yet; check that `twin_worker` runs on this router.")
    elif state is TwinState.UNCLAIMED:
        texts.append(
            f"No worker result for this UAV for {age_text(now - vehicle.result_accepted)}; the page shows the "
            "last one; "
            "check that `twin_worker` runs on this router."
        )
    elif vehicle.forecast is None:
        rows = vehicle.track_rows()
        observed_s = vehicle.data_time(now) - float(rows[0, 0]) if len(rows) else 0.0
        texts.append(f"No horizon yet after {age_text(observed_s)} of telemetry; it needs a verified model.")
    if lag_s := vehicle.prediction_lag_s(now):
        replay_advice = "play the recording more slowly, or " if vehicle.recorded else ""
        advice = f": its worker is overloaded; {replay_advice}assign fewer UAVs to each worker"
        texts.append(f"The newest prediction is {age_text(lag_s)} old{'' if state is TwinState.LINK_LOST else advice}.")
    if vehicle.prediction is not None and vehicle.prediction.sentence:
        texts.append(vehicle.prediction.sentence)
    if vehicle.status is not None and vehicle.status.sentence:
        texts.append(vehicle.status.sentence)
    if vehicle.mission is not None and vehicle.mission.sentence:
        texts.append(vehicle.mission.sentence)
    if now - vehicle.refusal[0] < REFUSED_S:
        texts.append(vehicle.refusal[1])
    return texts


def _sentences(vehicle: Vehicle, palette: Palette, now: float) -> str:
    cards = [
        f'<div class="say" style="border-color:{palette.mismatch}">▲ {escape(clip(a.sentence, MAX_TEXT))}</div>'
        for a in vehicle.alerts.values()
    ]
    cards.insert(0, mismatch_text.mismatch_html(vehicle.mismatch, palette))
    texts = limitations(vehicle, now)
    cards += [f'<div class="say">{escape(clip(text, MAX_TEXT))}</div>' for text in texts]
    verdict = vehicle.model.verdict if vehicle.model is not None else None
    if verdict is not None:
        colour = palette.verified if verdict.outcome is Outcome.VERIFIED else palette.identifying
        least = f", threshold {verdict.threshold:.0f} %" if verdict.threshold > 0 else ""
        cards.append(
            f'<div class="say" style="border-color:{colour}"><b>{escape(verdict.outcome.value.replace("_", " "))}</b> '
            f'<span class="soft">newest verification, number {verdict.attempts}{least}</span><br>'
            f"{escape(clip(verdict.sentence, MAX_TEXT))}</div>"
        )
    elif vehicle.row is not None and not any(vehicle.row.verdict in text for text in ("", *texts)):
        cards.append(f'<div class="say">{escape(clip(vehicle.row.verdict, MAX_TEXT))}</div>')
    return "".join(cards)


def _fits(vehicle: Vehicle) -> str:
    if vehicle.model is None or not (vehicle.model.active_verdict or vehicle.model.verdict).fit:
        return ""
    verdict = vehicle.model.active_verdict or vehicle.model.verdict
    names = list(verdict.fit)[:12]
    head = "".join(f'<th class="num">{escape(name)}</th>' for name in names)
    fits = "".join(f'<td class="num">{verdict.fit[name]:.0f}</td>' for name in names)
    persistence = "".join(
        f'<td class="num soft">{verdict.fit_persistence[name]:.0f}</td>'
        if name in verdict.fit_persistence
        else "<td></td>"
        for name in names
    )
    return (
        f'<div class="soft">fit per state over {verdict.horizon_s:.1f} s, %</div><table><tr><th></th>{head}</tr>'
        f"<tr><td>model</td>{fits}</tr><tr class=soft><td>persistence</td>{persistence}</tr></table>"
    )


def coverage_text(vehicle: Vehicle) -> str:
    """Describe the measured coverage of the prediction region."""
    prediction = vehicle.prediction
    if prediction is None or prediction.coverage_n <= 0 or not isfinite(prediction.coverage):
        return "not measured yet"
    return (
        f"{prediction.quantile * 100:.0f} % region: coverage {prediction.coverage * 100:.0f} %, n = "
        f"{prediction.coverage_n}"
    )


PROVENANCE = {
    "received": "received from the autopilot",
    "identified": "identified in flight",
    "default": "assumed: autopilot default",
    "overridden": "what-if value",
}
MAX_PARAMETERS = 40  # parameters shown per provenance


def law_html(controller: Controller | None) -> str:
    """Return the active control law and its parameters by provenance as HTML."""
    if controller is None:
        return ""
    parts = [(source, getattr(controller, source)) for source in PROVENANCE]
    rows = "".join(
        f'<tr><td class="soft key">{PROVENANCE[source]}</td><td class="value">'
        + escape(", ".join(f"{name[:20]} {value:g}" for name, value in list(values.items())[:MAX_PARAMETERS]))
        + "</td></tr>"
        for source, values in parts
        if values
    )
    head = f'<div class="soft">active law: <b class="law">{escape(controller.law[:100])}</b></div>'
    return f'{head}<table class="law">{rows}</table>'


def _facts(vehicle: Vehicle, now: float) -> str:
    prediction, status, row = vehicle.prediction, vehicle.status, vehicle.row
    at = vehicle.data_time(now)
    figures = {
        "coverage": coverage_text(vehicle),
        "calibration": prediction.calibration or "–" if prediction is not None else "–",
        "method": f"{prediction.method} · {prediction.law or 'no law'}" if prediction is not None else "–",
        "mode": f"{status.mode or '–'} · {status.autopilot} · {'armed' if status.armed else 'disarmed'}"
        if status is not None
        else "–",
        "link": f"{status.received} received, {status.missed} missed, {status.rejected} rejected"
        if status is not None
        else "–",
        "recorded" if vehicle.recorded else "data time": timestamp(at)
        + (
            f", played {rate_text(vehicle.time.rate)}"
            if vehicle.recorded and vehicle.time.rate and not vehicle.ended
            else ""
        ),
        "sample": f"{age_text(vehicle.sample_age_s(now))} old" if isfinite(vehicle.sample_age_s(now)) else "none yet",
        "prediction": f"{age_text(max(at - vehicle.forecast.t, 0.0))} old, coasted {prediction.coast_s:.0f} s"
        if vehicle.forecast and prediction
        else "–",
        "within 10 %": f"{row.t10_s:.1f} s median, n = {row.t10_n}"
        if row is not None and row.t10_s is not None
        else "–",
        "worker": f"{row.worker} · epoch {row.epoch}" if row is not None else "–",
    }
    return (
        "<table>"
        + "".join(
            f'<tr><td class="soft key">{k}</td><td class="value">{escape(clip(v, MAX_TEXT))}</td></tr>'
            for k, v in figures.items()
        )
        + "</table>"
    )
