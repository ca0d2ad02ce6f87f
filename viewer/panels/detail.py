"""Texts of the selected UAV: status, confidence, verdict, figures."""

from collections.abc import Sequence
from html import escape
from math import isfinite

from fleet.contract import METHOD_TEXTS, AlertKind, Controller, Outcome, TwinState, Verdict
from viewer.store.inbox import rate_text, timestamp
from viewer.store.vehicle import StatusRecord, Vehicle, mean_fit
from viewer.text.units import METRIC, Units
from viewer.text.words import (
    LOW_FIT,
    SHORT_HORIZON_S,
    age_text,
    alert_sentence,
    fit_colour,
    fit_text,
    horizon_text,
    key_value_table,
    lag_text,
    mismatch_html,
    status_label,
)
from viewer.theme.events import clip
from viewer.theme.palette import Palette

MAX_TEXT = 500  # characters of a received text
REFUSED_S = 10.0  # how long a rejected message is reported [s]


def status_html(
    vehicle: Vehicle, palette: Palette, now: float, units: Units = METRIC, workers: Sequence[str] = ()
) -> str:
    """Return the status of the UAV and its twin as HTML; `workers`: their texts. Received texts are escaped here."""
    label = status_label(vehicle, palette, now)
    cards = _cards(vehicle, vehicle.record(now), units) + _sentences(vehicle, palette, now, workers)
    return (
        f'<div class="uav"><div class="head"><h1>{vehicle.name}</h1><b style="color:{label.colour}">'
        f"{label.glyph} {label.text}</b></div>{cards}</div>"
    )


def figures_html(vehicle: Vehicle, now: float, units: Units = METRIC) -> str:
    """Return fits, figures and controller as HTML."""
    return f'<div class="uav">{_fits(vehicle)}{_facts(vehicle, now, units)}{law_html(vehicle.controller)}</div>'


def _cards(vehicle: Vehicle, record: StatusRecord, units: Units) -> str:
    cards = {
        "fit": fit_text(record),
        "horizon": horizon_text(record),
        "airspeed": units.speed_text(vehicle.Va),
    }
    battery = vehicle.prediction.battery if vehicle.prediction is not None else None
    if battery is not None:
        cards["battery"] = f"{100 * battery.remaining:.0f} %"
    note = f'<div class="soft">Battery: {escape(battery.sentence[:200])}</div>' if battery is not None else ""
    html = "".join(f'<div class="card"><span class="soft">{k}</span><b>{v}</b></div>' for k, v in cards.items())
    return f'<div class="cards">{html}</div><div class="soft">{escape(fit_and_horizon(vehicle, record))}</div>{note}'


IDENTIFIED_METHODS = ("both", "hybrid", "dynamics", "paper")  # methods that roll out identified models


def fit_and_horizon(vehicle: Vehicle, record: StatusRecord) -> str:
    """State what fit and horizon measure, and how one can be low and the other high; plain text, not escaped."""
    verdict = (vehicle.model.active_verdict or vehicle.model.verdict) if vehicle.model is not None else None
    length = f" over {verdict.horizon_s:.0f} s" if verdict is not None and isfinite(verdict.horizon_s) else ""
    texts = [f"Fit: free run of the model alone{length}, without the route."] if record.fit is not None else []
    if not record.horizon_s or vehicle.prediction is None:
        return " ".join(texts)
    method = vehicle.prediction.method
    text = METHOD_TEXTS.get(method, method[:40])
    if method not in IDENTIFIED_METHODS:
        return " ".join([*texts, f"Horizon: {text}, which does not use the identified model."])
    texts.append(f"Horizon: {text} and control law in closed loop on the route, measured on past predictions.")
    if record.horizon_s < SHORT_HORIZON_S:
        risk = f"{100 * vehicle.prediction.early_exceedance:.0f} %"
        texts.append(f"The probability of an error of 10 % within 10 s is {risk}: a few metres of a path this short.")
    if record.fit is not None and record.fit < LOW_FIT and record.horizon_s >= SHORT_HORIZON_S:
        texts.append("The control law holds the route although the model alone is inaccurate.")
    elif record.fit is not None and record.fit >= LOW_FIT and record.horizon_s < SHORT_HORIZON_S:
        texts.append("The model alone is accurate; wind, route or control law are not.")
    return " ".join(texts)


def limitations(vehicle: Vehicle, now: float, workers: Sequence[str] = ()) -> list[str]:
    """Return why there is no prediction, or what limits it; `workers`: their texts. Plain text, not escaped."""
    record = vehicle.record(now)
    state, texts = record.state, []
    if vehicle.ended:
        texts.append("The recording has ended; the page shows its last instant.")
    elif state is TwinState.LINK_LOST:
        note = "the twin predicts the position shown" if vehicle.forecast is not None else "no twin yet"
        texts.append(f"No sample for {age_text(record.sample_age_s)}: {note}; check the radio link.")
    elif not isfinite(vehicle.result_accepted) and vehicle.model is None and workers:
        texts.append(f"Its twin is not ready: {'; '.join(workers)}.")
    elif not isfinite(vehicle.result_accepted) and vehicle.model is None:
        texts.append(
            "No twin yet: `twin_worker` compiles for a minute or more at its first start. "
            "If it takes longer, check that it runs on this router."
        )
    elif state is TwinState.UNCLAIMED:
        texts.append(
            f"No worker result for this UAV for {age_text(record.result_age_s)}; the page shows the "
            "last one; check that `twin_worker` runs on this router."
        )
    elif vehicle.forecast is None:
        rows = vehicle.track_rows()
        observed_s = record.t - float(rows[0, 0]) if len(rows) else 0.0
        texts.append(f"No horizon yet after {age_text(observed_s)} of telemetry; it needs a plausible model.")
    others = vehicle.forecast.message.alternatives if vehicle.forecast is not None else ()
    texts += [f"With a probability of {100 * one.probability:.0f} % it {one.sentence[:200]}." for one in others]
    if record.prediction_lag_s:
        replay_advice = "play the recording more slowly, or " if vehicle.recorded else ""
        advice = f": its worker is overloaded; {replay_advice}assign fewer UAVs to each worker"
        texts.append(f"Newest {lag_text(record)}{'' if state is TwinState.LINK_LOST else advice}.")
    gateway_text = vehicle.status if state is not TwinState.LINK_LOST else None  # else it repeats the age
    messages = (vehicle.prediction, gateway_text, vehicle.mission)
    texts += [message.sentence for message in messages if message is not None and message.sentence]
    if now - vehicle.refusal[0] < REFUSED_S:
        texts.append(vehicle.refusal[1])
    return texts


def _sentences(vehicle: Vehicle, palette: Palette, now: float, workers: Sequence[str]) -> str:
    alert = f'<div class="say" style="border-color:{palette.mismatch}">▲ '
    record, cards = vehicle.record(now), [mismatch_html(vehicle.mismatch, palette)]
    alerts = [a for a in vehicle.alerts.values() if a.kind is not AlertKind.LINK_LOST]  # said by `limitations`
    cards += [f"{alert}{escape(clip(alert_sentence(a, vehicle, now), MAX_TEXT))}</div>" for a in alerts]
    texts = limitations(vehicle, now, workers)
    cards += [f'<div class="say">{escape(clip(text, MAX_TEXT))}</div>' for text in texts]
    verdict = vehicle.model.verdict if vehicle.model is not None else None
    if vehicle.model is not None and verdict is not None:
        is_active = vehicle.model.active_verdict in (None, verdict) or record.fit is None
        active = (
            ""
            if is_active
            else f"; predictions use an earlier model, whose own verification had fit {fit_text(record)}"
        )
        accepted = {
            Outcome.VERIFIED: fit_colour(mean_fit(verdict.fit), palette),
            Outcome.PLAUSIBLE: palette.plausible,
        }
        colour = accepted.get(verdict.outcome, palette.identifying)
        least = f", threshold {verdict.threshold:.0f} %" if verdict.threshold > 0 else ""
        cards.append(
            f'<div class="say" style="border-color:{colour}"><b>{escape(verdict.outcome.value.replace("_", " "))}</b> '
            f'<span class="soft">newest verification{least}{active}</span><br>'
            f"{escape(clip(verdict.sentence, MAX_TEXT))}</div>"
        )
    elif vehicle.row is not None and not any(vehicle.row.verdict in text for text in ("", *texts)):
        cards.append(f'<div class="say">{escape(clip(vehicle.row.verdict, MAX_TEXT))}</div>')
    return "".join(cards)


def _fits(vehicle: Vehicle) -> str:
    verdict = (vehicle.model.active_verdict or vehicle.model.verdict) if vehicle.model is not None else None
    if verdict is None or not verdict.fit:
        return ""
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
        f'<div class="soft">fit per state over {verdict.horizon_s:.1f} s, %</div><table><tr><td></td>{head}</tr>'
        f"<tr><td>model</td>{fits}</tr><tr class=soft><td>persistence</td>{persistence}</tr></table>{_power(verdict)}"
    )


def _power(verdict: Verdict) -> str:
    """Describe the detectable error of each group of derivatives; empty without a stated power."""
    pairs = list(verdict.detectable_error.items())[:12]
    errors = ", ".join(f"{escape(name[:40].replace('_', ' '))} {value:.0f} %" for name, value in pairs)
    return f'<div class="soft">the verification would have detected an error of: {errors}</div>' if errors else ""


def coverage_text(vehicle: Vehicle) -> str:
    """Describe the measured coverage of the prediction region."""
    prediction = vehicle.prediction
    if prediction is None or prediction.coverage_n <= 0 or not isfinite(prediction.coverage):
        return "not measured yet"
    coverage = f"coverage {prediction.coverage * 100:.0f} %, n = {prediction.coverage_n}"
    return f"{prediction.quantile * 100:.0f} % region: {coverage}"


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
    rows = []
    for source, text in PROVENANCE.items():
        if values := list(getattr(controller, source).items())[:MAX_PARAMETERS]:
            rows.append((text, escape(", ".join(f"{name[:20]} {value:g}" for name, value in values))))
    head = f'<div class="soft">active law: <b class="law">{escape(controller.law[:100])}</b></div>'
    return head + key_value_table(rows, ' class="law"')


def _facts(vehicle: Vehicle, now: float, units: Units) -> str:
    prediction, status, row = vehicle.prediction, vehicle.status, vehicle.row
    record = vehicle.record(now)
    at, age_s, rate = record.t, record.sample_age_s, vehicle.time.rate
    time_name = "recorded" if vehicle.recorded else "data time"
    names = "calibration", "method", "mode", "link", time_name, "sample", "prediction", "error below 10 %", "worker"
    figures = {"coverage": coverage_text(vehicle)} | dict.fromkeys(names, "")
    figures |= {"altitude": f"{units.height_text(vehicle.alt_m)} above mean sea level"}
    figures[time_name] = timestamp(at)
    if vehicle.recorded and rate and not vehicle.ended:
        figures[time_name] += f", played {rate_text(rate)}"
    figures["sample"] = f"{age_text(age_s)} old" if isfinite(age_s) else "none yet"
    if prediction is not None:
        figures["calibration"] = prediction.calibration
        method = METHOD_TEXTS.get(prediction.method, prediction.method)
        figures["method"] = f"{method} · {prediction.law or 'no law'}"
        if record.prediction_age_s is not None:
            coasted = f", coasted {age_text(prediction.coast_s)}" if prediction.coast_s > 0 else ""
            figures["prediction"] = f"{age_text(record.prediction_age_s)} old{coasted}"
    if status is not None:
        armed = "armed" if status.armed else "disarmed"
        figures["mode"] = f"{status.mode or '–'} · {status.autopilot} · {armed}"
        figures["link"] = f"{status.received} received, {status.missed} missed, {status.rejected} rejected"
    if row is not None:
        figures["worker"] = f"{row.worker} · epoch {row.epoch}"
        if row.t10_s is not None:
            figures["error below 10 %"] = f"for {row.t10_s:.1f} s, median of {row.t10_n} predictions"
    return key_value_table((name, escape(clip(text, MAX_TEXT))) for name, text in figures.items() if text)
